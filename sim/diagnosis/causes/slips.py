"""Slips: samples that one column lost or gained while the time went on, so that it runs ahead or late from there on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.causes.reading import Timing
from sim.diagnosis.causes.slip_dates import MOST, MOST_SLIPS, Found, dated, moved, pruned, slips_of
from sim.diagnosis.model.chain import Model
from sim.diagnosis.model.fit import Fit, calibrate, evaluate
from sim.diagnosis.model.forms import Form, Trial
from sim.diagnosis.model.loops_linear import resample_by
from sim.diagnosis.model.measured import At, Setting, Slot

#: Least share of the squared error that a slip must take off.
_LEAST_GAIN = 0.002
#: Share of the squared error that the first guess may leave: more, and something else is the cause.
_PROMISING = 0.6


@dataclass(frozen=True)
class Slips(Form):
    """Samples lost (or doubled) in one column while the time went on as if nothing had happened."""

    name: str = "timing"
    variant: str = "slips"
    of_one_recording: bool = True
    #: Where, as first samples, and by how many samples; found anew in every residual.
    found: Found = ()

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


def without_slips(fit: Fit, index: int) -> FloatArray:
    """The reading (n,) that the model would give had ``forms[index]`` lost no sample."""
    p = fit.p.copy()
    p[fit.model.where(index)] = 0.0
    return fit.model.simulate(p, At.READING, fit.signals).reading_um


def placed(form: Slips, bare: Model, base: Fit, mask: BoolArray, known: Found = ()) -> Fit:
    """Slips of whole samples beside everything else; a model that knows of some sees the others.

    ``known`` are those to begin with. Otherwise they are looked for beside ``base``, and beside a model that was
    fitted with a clock that runs wrong: many slips of one sign look like one, and bend the other numbers less so.
    """
    y_um, own, index = base.model.setting.y_um, base.p.size, len(bare.forms)

    def fitted(p: FloatArray, found: Found, iterations: int, sizes_too: bool = False) -> Fit:
        sizes = [float(size) for _, size in found]
        only = None if sizes_too else frozenset(range(own))
        model = bare.plus(replace(form, found=found))
        return calibrate(model, np.concatenate([p[:own], sizes]), mask, iterations, 1e-3, only)

    starts = [base.p]
    if not known:
        clock = calibrate(bare.plus(Timing()), np.append(base.p, 0.0), mask, 6, 1e-2)
        starts.append(clock.p[:own])
    fits: list[tuple[Fit, Found]] = []
    for p in starts:
        there = bare.simulate(p).reading_um
        found = dated(pruned(dated(known or slips_of(y_um, there, mask), y_um, there, mask)), y_um, there, mask)
        if found:
            fits.append((fitted(p, found, 4), found))
    fit, found = min(fits, key=lambda pair: pair[0].sse_um2, default=(base, ()))
    promising = bool(known) or fit.sse_um2 < _PROMISING * base.sse_um2
    for _ in range(2 * MOST_SLIPS if promising else 0):
        there = without_slips(fit, index) if found else fit.signals.reading_um
        after, gain = moved(found, y_um, there, mask)
        if gain < _LEAST_GAIN * fit.sse_um2 or len(after) > MOST_SLIPS:
            break
        found = pruned(dated(after, y_um, there, mask))
        fit = fitted(fit.p, found, 4)
    # That their sizes, let free, come out whole tells slips from what looks like them.
    return fitted(fit.p, found or form.found, 8, sizes_too=not known)


def redated(fit: Fit, mask: BoolArray) -> Fit:
    """The fit with its slips looked for anew beside all its causes: an earlier model that lacked some dated them
    worse, or overlooked one. The fit as it is where it has no slips or they stay."""
    index = next((i for i, form in enumerate(fit.model.forms) if isinstance(form, Slips)), -1)
    if index < 0:
        return fit
    form, y_um = fit.model.forms[index], fit.model.setting.y_um
    assert isinstance(form, Slips)
    bare = fit.model.less(index)
    where = fit.model.where(index)
    # To the end of the chain, where `placed` has them.
    base = evaluate(bare, np.concatenate([fit.p[: where.start], fit.p[where.stop :]]), mask)
    there = without_slips(fit, index)
    tried = placed(form, bare, base, mask, dated(form.found, y_um, there, mask))
    return tried if tried.sse_um2 < (1.0 - 1e-4) * fit.sse_um2 else fit
