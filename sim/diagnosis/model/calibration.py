"""Calibration: bounded least squares on the simulated reading, of a model, a nominal stage, and another recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.dynamics import respond
from sim.diagnosis.model.fit_data import FitData
from sim.diagnosis.model.nominal import BoucWenStage, LinearStage, NominalStage, file_stage
from sim.diagnosis.model.stage_model import Signals, StageModel
from sim.stage.config import StageConfig

IntArray = NDArray[np.int64]
T = TypeVar("T")


@dataclass(frozen=True)
class JacobianColumns:
    """Jacobian columns of an earlier fit: ``rows`` (m, n), scaled and masked; ``parameters`` are their indices."""

    rows: FloatArray
    parameters: tuple[int, ...]


@dataclass(frozen=True)
class ModelFit:
    """A calibrated model. ``sse_um2`` sums over the samples of the mask; ``residual_um`` is (n,), over all samples."""

    model: StageModel
    p: FloatArray
    signals: Signals
    residual_um: FloatArray
    sse_um2: float
    #: Indices of the parameters that may move.
    free: list[int]
    #: Jacobian columns (m, n), scaled and masked, of parameters away from their bounds; of the last step but one.
    rows: FloatArray | None = None
    #: Indices of the parameters of ``rows``.
    row_indices: tuple[int, ...] = ()

    def columns(self, without: slice | None = None) -> JacobianColumns | None:
        """The columns as a start for a model with one cause more, or with the parameters ``without`` left out."""
        if self.rows is None:
            return None
        if without is None:
            return JacobianColumns(self.rows, self.row_indices)
        width = without.stop - without.start
        keep = [i for i, index in enumerate(self.row_indices) if not without.start <= index < without.stop]
        indices = tuple(k if k < without.start else k - width for k in (self.row_indices[i] for i in keep))
        return JacobianColumns(self.rows[keep], indices)

    def without_signals(self) -> ModelFit:
        """The fit without what needs memory: of the simulated signals only drive and reading stay."""
        none = np.empty(0)
        signals = replace(self.signals, h_um=none, w_um=none, static_um=none, moved_um=none, motion_um=none)
        return replace(self, signals=signals, rows=None, row_indices=())

    def drive_at_samples(self) -> FloatArray:
        """(n,) voltage at the actuator at the sampling instants, just before the next command acts."""
        drive = self.signals.drive_V
        m = self.model.substeps
        if self.model.continuous:
            return np.ascontiguousarray(drive[::m])
        if m == 1:
            return np.concatenate([drive[:1], drive[:-1]])
        return np.concatenate([drive[:1], drive[m - 1 : -1 : m]])


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
            part, slope[moving], np.diag(gram)[moving], damping, _RULE, 6 if fresh else 2, now.sse_um2, moved
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


# Calibration of the nominal stage, before a cause is looked for.

#: Nominal stages with a name of their own. Any other one comes from a stage file.
NAMED = ("bouc_wen", "linear")


def begins_at_rest(data: FitData) -> bool:
    """True if the drive stays within 1 % of its swing about zero volts for the first 20 ms."""
    first = data.u_V[: max(3, round(0.02 / data.dt_s))]
    return bool(np.max(np.abs(first)) < 0.01 * data.swing_V)


def nominal_candidates(kind: str | StageConfig, data: FitData) -> list[NominalStage]:
    """The nominal stage with each hold between two samples: recorders differ in how they sample the drive."""
    if isinstance(kind, StageConfig):
        stage = file_stage(kind)
        return [stage, stage.with_other_hold()]
    if kind == "linear":
        return [LinearStage("zero"), LinearStage("first")]
    free = not begins_at_rest(data)
    return [BoucWenStage("zero", free_memory=free), BoucWenStage("first", free_memory=free)]


def with_nominal_kind(kind: str | StageConfig, data: FitData) -> FitData:
    """The data, marked with the kind of the nominal stage that they are compared with."""
    if not isinstance(kind, StageConfig):
        linear = kind == "linear"
        return replace(data, input_is_linear=linear, nominal_kind=kind, has_mode=linear)
    stage = file_stage(kind)
    known = tuple(f for f, damping in stage.modes_hz if damping < 0.5)
    return replace(
        data, input_is_linear=not stage.has_loop, nominal_kind="stage", known_modes_hz=known, has_mode=bool(known)
    )


def calibrate_nominal(kind: str | StageConfig, data: FitData, mask: BoolArray) -> ModelFit:
    """The best calibration of the nominal stage within its physical bounds, from several starts."""
    best: ModelFit | None = None
    for nominal in nominal_candidates(kind, data):
        model = StageModel(data, nominal)
        for start in nominal.starts(data):
            fit = calibrate(model, start, mask, 8, 1e-2)
            # Sub-steps cost time, and few recorders need them: they must reduce the error by 5 %.
            dearer = best is not None and nominal.substeps > best.model.nominal.substeps
            if best is None or fit.sse_um2 < best.sse_um2 * (0.95 if dearer else 1.0 - 1e-3):
                best = fit
    assert best is not None
    return _with_free_memory(calibrate(best.model, best.p, mask, 12, 1e-5), mask)


def _with_free_memory(fit: ModelFit, mask: BoolArray) -> ModelFit:
    """The fit with a free hysteresis memory at the start, where that explains more: a drive that begins at rest at
    0 V may have been elsewhere before."""
    nominal = fit.model.nominal
    if not isinstance(nominal, BoucWenStage) or nominal.free_memory:
        return fit
    model = StageModel(fit.model.data, replace(nominal, free_memory=True))
    start = np.concatenate([fit.p, [p.neutral for p in model.parameters[fit.p.size :]]])
    free = calibrate(model, start, mask, 8, 1e-4)
    # A small gain is another cause, imitated at the start.
    return free if free.sse_um2 < 0.6 * fit.sse_um2 else fit


def with_other_axis(fit: ModelFit, mask: BoolArray, *, refit: bool = True) -> ModelFit:
    """The same fit on data that include the displacement of the other axis.

    The displacement is the measured one, or, without a measurement, that of an equal stage driven by the other axis'
    voltage. The rate comes from that equal stage where possible: differences of readings are mostly noise.
    """
    data = fit.model.data
    modelled = None
    if data.u2_V is not None and float(np.ptp(data.u2_V)) > 1e-9:
        mine = fit.model.parameters_of(fit.p, -1)
        _, w = fit.model.nominal.static(data.u2_V, mine, data)
        modelled = respond(w, fit.model.dynamics(fit.p), data.dt_s)
    measured = data.y2_um
    if measured is not None and float(np.ptp(measured)) <= 0.0:
        measured = None
    other = measured if measured is not None else modelled
    if other is None:
        return fit
    other = other - float(np.mean(other[: max(1, data.n // 500)]))
    source = modelled if modelled is not None else other
    known = replace(data, other_um=other, other_um_per_s=np.gradient(source, data.dt_s), scales_from=data.scales)
    model = StageModel(known, fit.model.nominal, fit.model.causes)
    return calibrate(model, fit.p, mask, 2, 1e-4) if refit else replace(fit, model=model)


# A fitted model on another recording of the same stage.

#: Parameters that belong to one recording: the sensor's offset, and what happened before the first sample.
OF_ONE_RECORDING = ("offset_um", "h0", "start_um")


def fit_on_other_recording(fit: ModelFit, data: FitData, mask: BoolArray) -> ModelFit:
    """The fitted model on another recording ``data``, where only what belongs to one recording is calibrated again.

    That is the sensor's offset, the memory at the start, and causes that do not carry over (drift over time, phase
    of a hum, clock). ``mask`` (n,) is False where samples do not count.
    """
    home = fit.model
    _, static_um = home.nominal.static(
        fit.signals.drive_V, home.parameters_of(fit.p, -1), home.data.subdivided(home.substeps, home.nominal.hold)
    )
    there = replace(
        data,
        fitted_low_um=float(np.min(static_um)),
        fitted_loop_um=float(np.max(np.abs(fit.signals.h_um))),
        input_is_linear=home.data.input_is_linear,
        nominal_kind=home.data.nominal_kind,
        known_modes_hz=home.data.known_modes_hz,
        has_mode=home.data.has_mode,
        scales_from=home.data.scales,
    )
    nominal = home.nominal
    if isinstance(nominal, BoucWenStage):
        nominal = replace(nominal, free_memory=nominal.free_memory or not begins_at_rest(data))
    model = StageModel(there, nominal, home.causes)
    known = {parameter.name: fit.p[i] for i, parameter in enumerate(home.parameters[: home.n_nominal])}
    own_parameters = model.parameters[: model.n_nominal]
    start = np.array([known.get(parameter.name, parameter.neutral) for parameter in own_parameters])
    own = {i for i, parameter in enumerate(own_parameters) if parameter.name in OF_ONE_RECORDING}
    for i, cause in enumerate(model.causes):
        # The number of parameters of such a cause may depend on the length of the recording.
        fresh = np.array([parameter.neutral for parameter in cause.parameters(there)])
        start = np.concatenate([start, fresh if cause.of_one_recording else home.parameters_of(fit.p, i)])
        first = start.size - fresh.size
        for k, parameter in enumerate(cause.parameters(there)):
            if cause.of_one_recording or parameter.name in OF_ONE_RECORDING:
                own.add(first + k)
                start[first + k] = parameter.neutral
    unfitted = ModelFit(model, start, fit.signals, there.y_um, 0.0, [])
    known_axis = with_other_axis(unfitted, mask, refit=False)
    return calibrate(known_axis.model, start, mask, 20, 1e-6, frozenset(own))
