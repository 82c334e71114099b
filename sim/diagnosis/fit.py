"""Bounded least squares on the simulated reading, and the sums by block that every later question is asked of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.chain import Model, Signals


@dataclass(frozen=True)
class Fit:
    """A calibrated model. ``sse_um2`` is over the samples of the mask; ``residual_um`` over all, (n,)."""

    model: Model
    p: FloatArray
    signals: Signals
    residual_um: FloatArray
    sse_um2: float
    free: list[int]
    #: Columns of the numbers that could still move, masked and scaled, (m, n), from the last step but one.
    rows: FloatArray | None = None
    #: The slots of these rows.
    row_slots: tuple[int, ...] = ()


def free_slots(model: Model) -> list[int]:
    """Indices of the numbers that may move: all but those that a cause pins."""
    pinned = {name for form in model.forms for name in form.pins}
    return [i for i, s in enumerate(model.slots) if not (i < model.n_nominal and s.name in pinned) and s.high > s.low]


def within(model: Model, p: FloatArray) -> FloatArray:
    """``p`` moved into its bounds, pinned numbers at their neutral values."""
    out = np.clip(p, [s.low for s in model.slots], [s.high for s in model.slots])
    free = set(free_slots(model))
    for i, slot in enumerate(model.slots):
        if i not in free:
            out[i] = slot.neutral
    return out


def evaluate(model: Model, p: FloatArray, mask: BoolArray) -> Fit:
    """The model at ``p``, nothing moved."""
    signals = model.simulate(p)
    residual = model.setting.y_um - signals.reading_um
    with np.errstate(over="ignore", invalid="ignore"):
        sse = float(np.sum(np.square(residual[mask])))
    return Fit(model, p, signals, residual, sse, free_slots(model))


def calibrate(model: Model, start: FloatArray, mask: BoolArray, iterations: int = 12, tolerance: float = 1e-4) -> Fit:
    """Levenberg-Marquardt within bounds, from ``start``, on the samples of ``mask``.

    Stops when a step gains less than ``tolerance`` of the squared error. Differences start half way where the
    number acts, so a column costs a fraction of a simulation.
    """
    free = free_slots(model)
    slots = model.slots
    step = np.array([slots[i].step for i in free])
    low = np.array([slots[i].low for i in free])
    high = np.array([slots[i].high for i in free])
    loose = [i for i, j in enumerate(free) if not slots[j].steady]
    now = evaluate(model, within(model, start), mask)
    damping = 1e-6
    weight = mask.astype(np.float64)
    whole = bool(mask.all())
    kept: FloatArray | None = None
    kept_slots: tuple[int, ...] = ()
    rows = np.empty((0, 0))
    for _ in range(iterations):
        if rows.size == 0:
            rows = model.jacobian(now.p, now.signals, free)
            rows *= step[:, None]
            if not whole:
                rows *= weight
        elif loose:
            fresh = model.jacobian(now.p, now.signals, [free[i] for i in loose]) * step[loose, None]
            rows[loose] = fresh if whole else fresh * weight
        if not np.all(np.isfinite(rows)):
            break
        gram = rows @ rows.T
        slope = rows @ now.residual_um
        at = now.p[free]
        stuck = ((at <= low) & (slope < 0.0)) | ((at >= high) & (slope > 0.0))
        moving = np.flatnonzero(~stuck & (np.diag(gram) > 0.0))
        if moving.size == 0:
            break
        kept, kept_slots = rows[moving], tuple(free[i] for i in moving)
        size = np.diag(gram)[moving]
        better = None
        for _ in range(6):
            system = gram[np.ix_(moving, moving)] + np.diag(size * damping)
            move = np.linalg.lstsq(system, slope[moving], rcond=1e-13)[0]
            trial = now.p.copy()
            target = np.array(free)[moving]
            trial[target] = np.clip(at[moving] + move * step[moving], low[moving], high[moving])
            with np.errstate(over="ignore", invalid="ignore"):
                there = evaluate(model, trial, mask)
            if np.isfinite(there.sse_um2) and there.sse_um2 < now.sse_um2:
                better = there
                damping = max(damping * 0.2, 1e-9)
                break
            damping = max(damping * 10.0, 1e-5)
        if better is None:
            break
        gained = (now.sse_um2 - better.sse_um2) / max(now.sse_um2, 1e-300)
        now = better
        if gained < tolerance:
            break
    return Fit(now.model, now.p, now.signals, now.residual_um, now.sse_um2, free, kept, kept_slots)
