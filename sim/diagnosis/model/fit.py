"""Bounded least squares on the simulated reading, and the sums by block that every later question is asked of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.chain import Model, Signals


@dataclass(frozen=True)
class Columns:
    """Derivatives of the reading by numbers of a model, kept from an earlier fit: rows by slot, scaled and masked."""

    rows: FloatArray
    slots: tuple[int, ...]


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

    def columns(self, less: slice | None = None) -> Columns | None:
        """Its columns for the fit of a model that has more causes, or has one cause (these slots) ``less``."""
        if self.rows is None:
            return None
        if less is None:
            return Columns(self.rows, self.row_slots)
        width = less.stop - less.start
        keep = [i for i, slot in enumerate(self.row_slots) if not less.start <= slot < less.stop]
        slots = tuple(s if s < less.start else s - width for s in (self.row_slots[i] for i in keep))
        return Columns(self.rows[keep], slots)

    def slim(self) -> Fit:
        """The fit to be kept for later: of what was simulated the drive and the reading are left."""
        none = np.empty(0)
        signals = replace(self.signals, h_um=none, w_um=none, static_um=none, moved_um=none, motion_um=none)
        return replace(self, signals=signals, rows=None, row_slots=())


def refreshed(fit: Fit, mask: BoolArray) -> Fit:
    """The fit with columns computed where it stands, for everything that is asked of them later."""
    slots = fit.model.slots
    chosen = [i for i in fit.free if slots[i].low < fit.p[i] < slots[i].high]
    rows = fit.model.jacobian(fit.p, fit.signals, chosen)
    rows *= np.array([slots[i].step for i in chosen])[:, None]
    rows *= mask
    return replace(fit, rows=rows, row_slots=tuple(chosen))


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


def calibrate(
    model: Model,
    start: FloatArray,
    mask: BoolArray,
    iterations: int = 12,
    tolerance: float = 1e-4,
    only: frozenset[int] | None = None,
    known: Columns | None = None,
) -> Fit:
    """Levenberg-Marquardt within bounds, from ``start``, on the samples of ``mask``; ``only`` these slots move.

    Stops when a step gains less than ``tolerance`` of the squared error. Differences start half way where the
    number acts, so a column costs a fraction of a simulation. Columns are computed anew only where a step gained
    other than they promised; ``known`` ones of a model that this one extends serve until then.
    """
    free = [i for i in free_slots(model) if only is None or i in only]
    slots = model.slots
    step = np.array([slots[i].step for i in free])
    low = np.array([slots[i].low for i in free])
    high = np.array([slots[i].high for i in free])
    now = evaluate(model, within(model, start), mask)
    damping = 1e-6
    rows = np.zeros((len(free), model.setting.n))
    stale = np.ones(len(free), dtype=np.bool_)
    if known is not None:
        at = {slot: row for row, slot in enumerate(known.slots)}
        for i, slot in enumerate(free):
            if slot in at:
                rows[i], stale[i] = known.rows[at[slot]], False
    borrowed = known is not None
    fresh = False
    kept: Columns | None = None
    for _ in range(iterations):
        if np.any(stale):
            wanted = np.flatnonzero(stale)
            new = model.jacobian(now.p, now.signals, [free[i] for i in wanted])
            new *= step[wanted, None]
            if not np.all(np.isfinite(new)):
                break
            rows[wanted] = new * mask
            fresh = not borrowed
            stale[:] = False
            gram = rows @ rows.T
        elif borrowed and kept is None:
            gram = rows @ rows.T
        slope = rows @ now.residual_um
        at_p = now.p[free]
        stuck = ((at_p <= low) & (slope < 0.0)) | ((at_p >= high) & (slope > 0.0))
        moving = np.flatnonzero(~stuck & (np.diag(gram) > 0.0))
        if moving.size == 0:
            break
        kept = Columns(rows, tuple(int(i) for i in moving))
        size = np.diag(gram)[moving]
        better = None
        ratio = 1.0
        for attempt in range(6):
            system = gram[np.ix_(moving, moving)] + np.diag(size * damping)
            move = np.linalg.lstsq(system, slope[moving], rcond=1e-13)[0]
            trial = now.p.copy()
            target = np.array(free)[moving]
            trial[target] = np.clip(at_p[moving] + move * step[moving], low[moving], high[moving])
            with np.errstate(over="ignore", invalid="ignore"):
                there = evaluate(model, trial, mask)
            if np.isfinite(there.sse_um2) and there.sse_um2 < now.sse_um2:
                better = there
                went = (trial[target] - at_p[moving]) / step[moving]
                promised = float(2.0 * went @ slope[moving] - went @ gram[np.ix_(moving, moving)] @ went)
                ratio = (now.sse_um2 - better.sse_um2) / max(promised, 1e-300)
                damping = max(damping * 0.2, 1e-9)
                break
            damping = max(damping * 10.0, 1e-5)
            if not fresh and attempt >= 1:
                break
        loose = np.array([not slots[i].steady for i in free])
        if better is None:
            if fresh or not np.any(loose):
                break
            # The columns may be too old to point downhill.
            stale, borrowed, damping = loose.copy(), False, 1e-6
            continue
        gained = (now.sse_um2 - better.sse_um2) / max(now.sse_um2, 1e-300)
        now = better
        was_fresh, fresh = fresh, False
        poor = not 0.7 < ratio < 1.4
        if gained < tolerance and (was_fresh or not poor):
            break
        if poor:
            stale, borrowed = loose.copy(), False
    if kept is None:
        return Fit(now.model, now.p, now.signals, now.residual_um, now.sse_um2, free)
    chosen = list(kept.slots)
    return Fit(
        now.model,
        now.p,
        now.signals,
        now.residual_um,
        now.sse_um2,
        free,
        rows[chosen],
        tuple(free[i] for i in chosen),
    )
