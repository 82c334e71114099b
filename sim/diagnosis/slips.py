"""Slips: samples that one column lost or gained while the time went on, so that it runs ahead or late from there on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.chain import Model
from sim.diagnosis.fit import Fit, calibrate
from sim.diagnosis.forms import Form, Trial
from sim.diagnosis.loops_linear import resample_by
from sim.diagnosis.setting import At, Setting, Slot

#: Samples by which a column may come to run ahead or late.
MOST = 12
#: Slips beyond this number are no slips but another cause that looks like them.
MOST_SLIPS = 16
_BLOCK = 8


@compiled
def _path(cost: FloatArray, price: float) -> FloatArray:
    """The cheapest way through ``cost`` (blocks, shifts) where each step of one shift costs ``price`` (Viterbi)."""
    n, m = cost.shape
    back = np.zeros((n, m), dtype=np.int8)
    total = cost[0].copy()
    for b in range(1, n):
        for j in range(1, m):  # a change by more steps pays for each
            if total[j - 1] + price < total[j]:
                total[j] = total[j - 1] + price
                back[b, j] = back[b, j - 1] - 1
        for j in range(m - 2, -1, -1):
            if total[j + 1] + price < total[j]:
                total[j] = total[j + 1] + price
                back[b, j] = back[b, j + 1] + 1
        for j in range(m):
            total[j] += cost[b, j]
    out = np.empty(n)
    j = int(np.argmin(total))
    for b in range(n - 1, -1, -1):
        out[b] = j
        j += int(back[b, j])
    return out


def slips_of(y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> tuple[tuple[int, int], ...]:
    """Where the readings slip against the model, and by how many samples: ``((index, size), ...)``; positive is lost.

    Asked of first differences, so that slow errors of the model do not matter, in blocks of eight samples. A slip has
    to save far more than the typical error of a block.
    """
    n = y_um.size // _BLOCK * _BLOCK
    moved = np.diff(y_um, prepend=y_um[:1])
    there = np.diff(model_um, prepend=model_um[:1])
    inside = mask & np.append(mask[:1], mask[:-1])
    cost = np.empty((n // _BLOCK, 2 * MOST + 1))
    for j in range(2 * MOST + 1):
        shift = j - MOST
        ahead = np.roll(there, -shift)
        error = np.square(np.where(inside, moved - ahead, 0.0))
        cost[:, j] = np.add.reduceat(error[:n], np.arange(0, n, _BLOCK))
    least = cost.min(axis=1)
    if not np.all(np.isfinite(least)):
        return ()
    cost -= least[:, None]
    # A model that is still wrong pays for that in many blocks: the price rises until few slips are left.
    price = 12.0 * max(float(np.quantile(least, 0.9)), 1e-18)
    for _ in range(12):
        path = _path(np.ascontiguousarray(cost), price)
        at = np.flatnonzero(np.diff(path)) + 1
        if at.size <= MOST_SLIPS:
            return tuple((int(b * _BLOCK), int(path[b] - path[b - 1])) for b in at)
        price *= 3.0
    return ()


@dataclass(frozen=True)
class Slips(Form):
    """Samples lost (or doubled) in one column while the time went on as if nothing had happened."""

    name: str = "timing"
    variant: str = "slips"
    of_one_recording: bool = True
    #: Where, as first samples, and by how many samples; found anew in every residual.
    found: tuple[tuple[int, int], ...] = ()

    def applies(self, setting: Setting) -> str:
        return "" if self.found else "a lasting jump of the timing"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        """Whole samples, as a converter counts them."""
        return bool(np.all(np.abs(p - np.rint(p)) < 0.4) and np.all(np.abs(p) > 0.5))

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return tuple(
            Slot(f"slip{i + 1}_samples", "1", 0.0, -MOST - 1.0, MOST + 1.0, 0.2, At.READING)
            for i in range(len(self.found))
        )

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        return [[np.array([float(size) for _, size in self.found])]]

    def reading(self, y_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        if not np.any(p):
            return y_um
        shifts = np.zeros(setting.n)
        for (at, _), size in zip(self.found, p, strict=True):
            shifts[at:] += size
        return np.asarray(resample_by(y_um, shifts))

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        one = np.ones(p.size)
        still = np.zeros(p.size)
        return {
            "slips": (float(p.size), still),
            "lost_samples": (float(p.sum()), one),
            "first_slip_s": (self.found[0][0] * setting.dt_s, still),
            "clock_ppm": (0.0, still),
        }


def placed(form: Slips, bare: Model, base: Fit, mask: BoolArray) -> Fit:
    """Slips of whole samples, looked for again beside a model that knows most of them, until they stay."""
    setting = base.model.setting
    p = base.p
    for _ in range(6):
        model = bare.plus(form)
        start = np.concatenate([p[: base.p.size], form.trials(setting, base.residual_um)[0][0]])
        fit = calibrate(model, start, mask, 8, 1e-3, frozenset(range(base.p.size)))
        found = slips_of(setting.y_um, fit.signals.motion_um, mask)
        if not found or found == form.found:
            break
        form, p = replace(form, found=found), fit.p
    return calibrate(fit.model, fit.p, mask, 6, 1e-3)
