"""Calibration: bounded least squares of a stage model on its simulated reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.fit_data import ActsOn, ModelParameter
from dehyst.sim.fitting.stage_model import JacobianColumns, ModelFit, StageModel

IntArray = NDArray[np.int64]
T = TypeVar("T")


def with_new_columns(fit: ModelFit, mask: BoolArray) -> ModelFit:
    """The fit with its Jacobian computed at its own parameters."""
    parameters = fit.model.parameters
    chosen = [i for i in fit.free if parameters[i].low < fit.p[i] < parameters[i].high]
    rows = fit.model.jacobian(fit.p, fit.signals, chosen)
    rows *= np.array([parameters[i].step for i in chosen])[:, None]
    rows *= mask
    return replace(fit, rows=rows, row_indices=tuple(chosen))


def free_indices(model: StageModel) -> list[int]:
    """Indices of the parameters that may move: all but those that a cause pins."""
    pinned = {name for cause in model.causes for name in cause.pins}
    return [
        i for i, s in enumerate(model.parameters) if not (i < model.n_nominal and s.name in pinned) and s.high > s.low
    ]


def clipped_to_bounds(model: StageModel, p: FloatArray) -> FloatArray:
    """``p`` clipped to its bounds, with pinned parameters at their neutral values."""
    out = np.clip(p, [s.low for s in model.parameters], [s.high for s in model.parameters])
    free = set(free_indices(model))
    for i, parameter in enumerate(model.parameters):
        if i not in free:
            out[i] = parameter.neutral
    return out


def evaluate(model: StageModel, p: FloatArray, mask: BoolArray) -> ModelFit:
    """The model simulated with the parameters ``p``; nothing is fitted."""
    signals = model.simulate(p)
    residual = model.data.y_um - signals.reading_um
    with np.errstate(over="ignore", invalid="ignore"):
        sse = float(np.sum(np.square(residual[mask])))
    return ModelFit(model, p, signals, residual, sse, free_indices(model))


@dataclass(frozen=True)
class DampingRule:
    """How the damping of a Levenberg-Marquardt search follows its steps: / 5 after a success, x 10 after a failure.

    ``least`` and ``least_after_failure`` are lower limits; ``rcond`` is that of the least-squares solution.
    """

    least: float
    least_after_failure: float
    rcond: float


def damped_step(
    gram: FloatArray,
    slope: FloatArray,
    size: FloatArray,
    damping: float,
    rule: DampingRule,
    attempts: int,
    sse: float,
    trial: Callable[[FloatArray], tuple[float, T]],
) -> tuple[T | None, float]:
    """One Levenberg-Marquardt step: damp more until the squared error falls below ``sse``.

    ``gram`` (m, m) and ``slope`` (m,) belong to the scaled Jacobian, ``size`` (m,) to its diagonal. ``trial`` takes a
    move (m,) and returns its squared error with its result. Returns the first better result, or None after
    ``attempts``, and the damping for the next step.
    """
    for _ in range(attempts):
        solved = np.linalg.lstsq(gram + np.diag(size * damping), slope, rcond=rule.rcond)[0]
        move = np.asarray(solved, dtype=np.float64)
        there, result = trial(move)
        if np.isfinite(there) and there < sse:
            return result, max(damping * 0.2, rule.least)
        damping = max(damping * 10.0, rule.least_after_failure)
    return None, damping


_RULE = DampingRule(least=1e-9, least_after_failure=1e-5, rcond=1e-13)
#: Trials with fresh columns before a fit ends: from the least damping to 10. Fits far from their minimum, where only
#: short steps lower the error, gave up at 0.1.
_ATTEMPTS = 8


def calibrate(
    model: StageModel,
    start: FloatArray,
    mask: BoolArray,
    iterations: int = 12,
    tolerance: float = 1e-4,
    only: frozenset[int] | None = None,
    known: JacobianColumns | None = None,
) -> ModelFit:
    """Levenberg-Marquardt within bounds, from ``start``, on the samples of ``mask``; ``only``: these indices move.

    Stops when a step gains less than ``tolerance`` of the squared error. A difference quotient is simulated only from
    the block on which its parameter acts. Columns are computed again only after a step that gained more or less than
    they predicted; ``known`` columns of a model that this one extends are used until then.
    """
    free = [i for i in free_indices(model) if only is None or i in only]
    parameters = model.parameters
    step = np.array([parameters[i].step for i in free])
    low = np.array([parameters[i].low for i in free])
    high = np.array([parameters[i].high for i in free])
    nonlinear = np.array([not parameters[i].linear for i in free])
    now = evaluate(model, clipped_to_bounds(model, start), mask)
    damping = 1e-6
    rows = np.zeros((len(free), model.data.n))
    stale = np.ones(len(free), dtype=np.bool_)
    if known is not None:
        at = {index: row for row, index in enumerate(known.parameters)}
        for i, index in enumerate(free):
            if index in at:
                rows[i], stale[i] = known.rows[at[index]], False
    borrowed = known is not None
    fresh = False
    kept: JacobianColumns | None = None
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
        kept = JacobianColumns(rows, tuple(int(i) for i in moving))
        target = np.array(free)[moving]
        part = gram[np.ix_(moving, moving)]

        def moved(
            move: FloatArray, now: ModelFit = now, moving: IntArray = moving, target: IntArray = target
        ) -> tuple[float, ModelFit]:
            p = now.p.copy()
            p[target] = np.clip(now.p[target] + move * step[moving], low[moving], high[moving])
            with np.errstate(over="ignore", invalid="ignore"):
                there = evaluate(model, p, mask)
            return there.sse_um2, there

        better, damping = damped_step(
            part, slope[moving], np.diag(gram)[moving], damping, _RULE, _ATTEMPTS if fresh else 2, now.sse_um2, moved
        )
        if better is None:
            if fresh or not np.any(nonlinear):
                break
            # The columns may be too old to point downhill: compute them again.
            stale, borrowed, damping = nonlinear.copy(), False, 1e-6
            continue
        went = (better.p[target] - at_p[moving]) / step[moving]
        predicted = float(2.0 * went @ slope[moving] - went @ part @ went)
        ratio = (now.sse_um2 - better.sse_um2) / max(predicted, 1e-300)
        gained = (now.sse_um2 - better.sse_um2) / max(now.sse_um2, 1e-300)
        now = better
        was_fresh, fresh = fresh, False
        poor = not 0.7 < ratio < 1.4
        if gained < tolerance and (was_fresh or not poor):
            break
        if poor:
            stale, borrowed = nonlinear.copy(), False
    if kept is None:
        return replace(now, free=free)
    chosen = list(kept.parameters)
    return replace(now, free=free, rows=rows[chosen], row_indices=tuple(free[i] for i in chosen))


def own_dynamics(fit: ModelFit) -> list[tuple[int, ModelParameter]]:
    """The free numbers of the nominal mechanics, with their indices."""
    own = enumerate(fit.model.parameters[: fit.model.n_nominal])
    return [(i, s) for i, s in own if i in fit.free and s.acts_on == ActsOn.DYNAMICS]


def with_dynamics_anew(fit: ModelFit, mask: BoolArray) -> ModelFit:
    """The better of the fits with either hold in which the nominal mechanics begin at their neutral values.

    Lag, latch and hold imitate each other within a few samples, and a fit does not leave the wrong ones.
    """
    start = fit.p.copy()
    for i, s in own_dynamics(fit):
        start[i] = s.neutral
    models = (fit.model, replace(fit.model, nominal=fit.model.nominal.with_other_hold()))
    return min((calibrate(model, start, mask, 20, 1e-4) for model in models), key=lambda f: f.sse_um2)


def with_free_memory(fit: ModelFit, mask: BoolArray) -> ModelFit:
    """The fit with a free hysteresis memory at the start, where that explains more: a drive that begins at rest at
    0 V may have been elsewhere before."""
    nominal = fit.model.nominal.with_free_memory()
    if nominal is fit.model.nominal:
        return fit
    model, own = replace(fit.model, nominal=nominal), fit.model.n_nominal
    neutral = [p.neutral for p in model.parameters[own : model.n_nominal]]
    free = calibrate(model, np.concatenate([fit.p[:own], neutral, fit.p[own:]]), mask, 8, 1e-4)
    # A small gain is another cause, imitated at the start.
    return free if free.sse_um2 < 0.6 * fit.sse_um2 else fit
