"""The stage model that is fitted: a nominal stage and cause models, simulated block by block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.dynamics import Dynamics, RestoringForce, changed_midway, respond
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.parallel import side_by_side

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


@dataclass(frozen=True)
class NominalStage:
    """A stage that a recording is compared with. Its parameters are calibrated before causes are searched."""

    #: The voltage is held over a sample ("zero") or runs straight to the next ("first").
    hold: str = "zero"
    name: str = ""
    #: What happened before the first sample is described by further parameters, behind its own.
    free_memory: bool = False

    @property
    def substeps(self) -> int:
        """Sub-steps per sample at which drive and hysteresis are simulated."""
        # h is curved while the voltage runs linearly between samples; under a held voltage one exact step suffices.
        return 4 if self.hold == "first" else 1

    @property
    def remembers(self) -> bool:
        """Whether what happened before the first sample matters."""
        return True

    def with_other_hold(self) -> NominalStage:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    def with_free_memory(self) -> NominalStage:
        return replace(self, free_memory=True) if self.remembers and not self.free_memory else self

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        raise NotImplementedError

    def starts(self, data: FitData) -> list[FloatArray]:
        """Start values of the calibration."""
        raise NotImplementedError

    def static(self, drive_V: FloatArray, p: FloatArray, data: FitData) -> tuple[FloatArray, FloatArray]:
        """Hysteresis h and static displacement w (µm, (n,) each) for the voltage at the actuator."""
        raise NotImplementedError

    def dynamics(self, p: FloatArray, data: FitData) -> Dynamics:
        raise NotImplementedError

    def behind_um(self, x_um: FloatArray, data: FitData) -> FloatArray:
        """(n,) displacement behind the mechanics after what the stage itself adds there."""
        return x_um

    def offset_um(self, p: FloatArray) -> float:
        raise NotImplementedError

    def start_um(self, p: FloatArray) -> float:
        """Distance (µm) of the first sample from equilibrium with the first voltage."""
        return 0.0


#: Parameters of the initial state: only the first samples determine them, so they cannot be held out.
INITIAL_STATE = ("start_um", "before_um", "h0", "before_share", "path_start_um")

#: Vectors whose simulated differences from the neutral span one linearised guess, and whether they may be scaled.
Guess = list[FloatArray]


@dataclass(frozen=True)
class CauseModel:
    """A form of one effect that can be fitted. Each hook is neutral unless overridden.

    ``name`` is that of the effect; the catalogue sets it. ``variant`` tells forms of one effect apart.
    """

    name: str = ""
    variant: str = ""
    #: Parameters of the nominal stage that this cause replaces; they stay at their neutral values.
    pins: tuple[str, ...] = ()
    #: Sub-steps per sample at which drive and hysteresis must be simulated.
    substeps: int = 1
    #: The drive behind it has no jumps and runs linearly between sub-steps.
    continuous: bool = False
    #: It acts within a few samples of a step, so the choice of the hold may have imitated it: fit it with both.
    fast: bool = False
    #: Its parameters belong to one recording (drift over time, phase of a hum).
    of_one_recording: bool = False
    #: It takes over a part of the nominal stage: it is always fitted, from `joint_starts`, and without it the nominal
    #: stage starts from its own calibration.
    takes_over: bool = False
    #: It widens a bound of the nominal stage at which its calibration stands, and is fitted before all others.
    widens: bool = False
    #: It is fitted wherever another form of its effect is the most promising guess.
    beside_its_kind: bool = False
    #: Its direct test also answers to other causes: it supports the name but does not replace the null distribution.
    test_answers_to_others: bool = False
    #: It is not named where its direct test is excited and sees nothing.
    unseen_is_absent: bool = False
    #: It is named only where its direct test sees it, or gives a number that agrees with the fit.
    must_be_seen: bool = False
    #: So smooth in time that it imitates the rest of many others: where its test is not excited, it must explain most.
    imitates_others: bool = False
    #: It approximates a class of loops: a loop of free form beside it would take its number over.
    approximates: bool = False
    #: Reported numbers of which the nominal stage may take any part over: not zero where the cause is not there.
    shared: tuple[str, ...] = ()
    #: It is dropped where the intervals of all its numbers hold zero, however much it removes.
    never_zero: bool = False
    #: Another drive can show it: False for what somebody has to do to the stage.
    shown_by_a_drive: bool = True
    #: It is shown by driving another axis, recorded or not.
    of_other_axis: bool = False
    #: Model error: share (RMS) of the removed residual that the model may leave behind in a real stage.
    model_error: float = 0.025
    #: Iterations of the fit to convergence.
    iterations: int = 12

    def missing(self, data: FitData) -> str:
        """What the data lack to show this cause; empty if nothing."""
        return ""

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        raise NotImplementedError

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        """Start values for screening. Default for a linear cause: one guess with a unit step of every parameter."""
        parameters = self.parameters(data)
        neutral = np.array([s.neutral for s in parameters])
        rows = []
        for i, parameter in enumerate(parameters):
            row = neutral.copy()
            row[i] += parameter.step
            rows.append(row)
        return [rows]

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        """Whether the fitted parameters have a plausible size and sign."""
        return True

    def borne_out(self, readings: Readings) -> bool:
        """False where the readings speak against what this form has found."""
        return True

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        """How a number of a direct test, that is too faint or answers to others as well, agrees with the fit ``p``;
        empty if it does not."""
        return ""

    def line_hz(self, p: FloatArray) -> float | None:
        """Frequency of the permanent line that the form is; None for any other.

        A line is so specific that the residual's spectrum decides about it, and no other cause is confused with it.
        """
        return None

    def shown(self, readings: Readings) -> CauseModel:
        """The form with what the readings themselves show of it."""
        return self

    def found_again(self, fit: ModelFit, mask: BoolArray) -> CauseModel:
        """The form with what is to be found anew in each residual."""
        return self

    def own_fit(self, bare: StageModel, base: ModelFit, mask: BoolArray) -> ModelFit | None:
        """A first joint fit of its own, of ``bare`` and this cause beside ``base``; None where the usual one serves."""
        return None

    def fitted_again(self, fit: ModelFit, index: int, mask: BoolArray) -> ModelFit:
        """``fit`` with what this form (``causes[index]``) finds beside all causes; ``fit`` itself if that is not
        better."""
        return fit

    def joint_starts(self, nominal: FloatArray, names: tuple[str, ...], data: FitData) -> list[FloatArray]:
        """Further start values of the nominal stage (parameters ``names``) and of this cause together: where a part of
        the nominal stage gives way to it, a linearised guess beside the calibrated stage leads elsewhere."""
        return []

    def histories(self, data: FitData) -> list[CauseModel]:
        """The same form with other memories of the time before the recording."""
        return []

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        """A finer form of the same cause and its start values; None if there is none or none is needed.

        An error that a coarse form leaves must not be taken for another cause. ``p`` are the fitted parameters;
        ``left_floors`` is the remaining error in noise floors.
        """
        return None

    def freer(self) -> CauseModel | None:
        """A form of the same cause that must be tried before another cause is added; None if there is none."""
        return None

    def also(self, data: FitData) -> tuple[str, ...]:
        """Names of further causes that this one may be, whatever the recording says."""
        return ()

    def unresolved(self, data: FitData) -> dict[str, float]:
        """How far a reported number may be off, by its name, whatever the recording says: it widens the interval."""
        return {}

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return u_V

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        """(n,) µm added to the static displacement, or None."""
        return None

    def loop_um(self, u_V: FloatArray, added_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray | None:
        """(n,) the loop in ``added_um``, what `static` returned: what it lags by, like h of (2.2); None for no loop."""
        return None

    def on_loop(
        self, u_V: FloatArray, loop_um: Callable[[], FloatArray], p: FloatArray, data: FitData
    ) -> FloatArray | None:
        """(n,) µm added to the static displacement by what acts on ``loop_um()``, the loops of the nominal stage and of
        all causes together, or None."""
        return None

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system

    def changed_dynamics(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        """Time (s) of a change of the mechanics and the mechanics after it, or None."""
        return None

    def added_motion(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, data: FitData, system: Dynamics
    ) -> FloatArray | None:
        """(n,) motion parallel to the nominal mechanics, or None."""
        return None

    def restoring(self, p: FloatArray, data: FitData) -> RestoringForce | None:
        """Hysteresis in the restoring force, or None."""
        return None

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return x_um

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return y_um

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Reported numbers by name: the value and its gradient with respect to ``p``."""
        out = {}
        for i, parameter in enumerate(self.parameters(data)):
            gradient = np.zeros(p.size)
            gradient[i] = 1.0
            out[parameter.name] = (float(p[i]), gradient)
        return out


def single_guesses(values: list[float]) -> list[Guess]:
    """Guesses of a cause with one parameter."""
    return [[np.array([v])] for v in values]


@dataclass(frozen=True, slots=True)
class Added:
    """What a cause with the parameters ``p``, as bytes, adds to the static displacement (None: nothing)."""

    cause: CauseModel
    p: bytes
    um: FloatArray | None


@dataclass
class Signals:
    """Signals between the blocks of one simulation, kept so that a later one may start at any block."""

    drive_V: FloatArray
    h_um: FloatArray
    #: Static displacement of the nominal stage alone, and its parameters as bytes.
    w_um: FloatArray
    nominal_p: bytes
    static_um: FloatArray
    moved_um: FloatArray
    motion_um: FloatArray
    reading_um: FloatArray
    #: What each cause adds to the static displacement.
    added: tuple[Added, ...] = ()


@dataclass(frozen=True)
class StageModel:
    """A nominal stage and causes on one recording. The parameter vector begins with the nominal stage."""

    data: FitData
    nominal: NominalStage
    causes: tuple[CauseModel, ...] = ()
    _parameters: tuple[ModelParameter, ...] = field(init=False, repr=False)
    _cuts: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        groups = [self.nominal.parameters(self.data), *(f.parameters(self.data) for f in self.causes)]
        cuts = np.cumsum([0, *(len(g) for g in groups)])
        object.__setattr__(self, "_parameters", tuple(s for g in groups for s in g))
        object.__setattr__(self, "_cuts", tuple(int(c) for c in cuts))

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        return self._parameters

    @property
    def n_nominal(self) -> int:
        return self._cuts[1]

    def parameters_of(self, p: FloatArray, index: int) -> FloatArray:
        """The parameters of ``causes[index]``; -1 is the nominal stage."""
        return p[self._cuts[index + 1] : self._cuts[index + 2]]

    def slice_of(self, index: int) -> slice:
        """Place of the parameters of ``causes[index]`` in the vector."""
        return slice(self._cuts[index + 1], self._cuts[index + 2])

    @property
    def substeps(self) -> int:
        """Sub-steps per sample at which drive and hysteresis are simulated."""
        return max(self.nominal.substeps, *(cause.substeps for cause in self.causes), 1)

    @property
    def continuous(self) -> bool:
        """Whether a cause removes the jumps of the drive."""
        return any(cause.continuous for cause in self.causes)

    def with_cause(self, cause: CauseModel) -> StageModel:
        """The model with one cause more, at the end."""
        return StageModel(self.data, self.nominal, (*self.causes, cause))

    def without_cause(self, index: int) -> StageModel:
        """The model without ``causes[index]``."""
        return StageModel(self.data, self.nominal, self.causes[:index] + self.causes[index + 1 :])

    def simulate(self, p: FloatArray, start: ActsOn = ActsOn.DRIVE, kept: Signals | None = None) -> Signals:
        """All signals with the parameters ``p``; those of blocks before ``start`` are taken from ``kept``."""
        s = self.data
        substeps = self.substeps
        inner = s.subdivided(substeps, self.nominal.hold)
        parts = [self.parameters_of(p, i) for i in range(len(self.causes))]
        mine = self.parameters_of(p, -1)
        pairs = list(zip(self.causes, parts, strict=True))
        if kept is None:
            start = ActsOn.DRIVE
        if start <= ActsOn.DRIVE or kept is None:
            drive = inner.u_V
            for cause, q in pairs:
                drive = cause.drive(drive, q, inner)
        else:
            drive = kept.drive_V
        if start <= ActsOn.STATIC or kept is None:
            own = mine.tobytes()
            before: tuple[Added, ...] = ()
            if kept is not None and start == ActsOn.STATIC and kept.nominal_p == own:
                # Only a cause has changed: the nominal hysteresis, which costs most time, is the same.
                h, w, before = kept.h_um, kept.w_um, kept.added
            else:
                h, w = self.nominal.static(drive, mine, inner)
            added = self._added(drive, h, w, p, inner, before)
            extra = [one.um for one in added if one.um is not None] + self._on_loop(drive, h, p, inner, added)
            static = w + sum(extra) if extra else w
        else:
            h, w, own, static, added = kept.h_um, kept.w_um, kept.nominal_p, kept.static_um, kept.added
        if start <= ActsOn.DYNAMICS or kept is None:
            # The kept static displacement is that without a start: a later simulation adds it again.
            began = self.nominal.start_um(mine)
            driven = static
            if began != 0.0:
                driven = static.copy()
                driven[0] += began
            back = next((r for cause, q in pairs if (r := cause.restoring(q, s)) is not None), None)
            system = self.dynamics(p)
            moved = respond(driven, system, inner.dt_s, back)
            for cause, q in pairs:
                # With hysteresis in the force superposition does not hold.
                change = cause.changed_dynamics(system, q) if back is None else None
                if change is not None:
                    moved = changed_midway(driven, moved, system, change, inner.dt_s)
            for cause, q in pairs:
                more = cause.added_motion(drive, driven, q, inner, system)
                if more is not None:
                    moved = moved + more
            if substeps > 1:
                moved = np.ascontiguousarray(moved[::substeps])
        else:
            moved = kept.moved_um
        if start <= ActsOn.MOTION or kept is None:
            motion = moved
            for cause, q in pairs:
                motion = cause.motion(motion, q, s)
            motion = self.nominal.behind_um(motion, s)
        else:
            motion = kept.motion_um
        reading = motion
        for cause, q in pairs:
            reading = cause.reading(reading, q, s)
        reading = reading + self.nominal.offset_um(mine)
        return Signals(drive, h, w, own, static, moved, motion, reading, added)

    def _added(
        self,
        drive_V: FloatArray,
        h_um: FloatArray,
        w_um: FloatArray,
        p: FloatArray,
        inner: FitData,
        before: tuple[Added, ...],
    ) -> tuple[Added, ...]:
        """What each cause adds to the static displacement.

        ``before``: what each added to the same h and w; it is taken over where the cause has the same parameters.
        """
        added: list[Added] = []
        for i, cause in enumerate(self.causes):
            q = self.parameters_of(p, i)
            own = q.tobytes()
            if i < len(before) and before[i].cause is cause and before[i].p == own:
                added.append(before[i])
            else:
                one = cause.static(drive_V, h_um, w_um, q, self.parameters_of(p, -1), inner)
                added.append(Added(cause, own, one))
        return tuple(added)

    def _on_loop(
        self, drive_V: FloatArray, h_um: FloatArray, p: FloatArray, inner: FitData, added: tuple[Added, ...]
    ) -> list[FloatArray]:
        """What the causes add that act on the loops of the stage and of all causes."""

        def loop_um() -> FloatArray:
            out = h_um
            for i, cause in enumerate(self.causes):
                um = added[i].um
                more = None if um is None else cause.loop_um(drive_V, um, self.parameters_of(p, i), inner)
                out = out if more is None else out + more
            return out

        each = (cause.on_loop(drive_V, loop_um, self.parameters_of(p, i), inner) for i, cause in enumerate(self.causes))
        return [um for um in each if um is not None]

    def dynamics(self, p: FloatArray) -> Dynamics:
        """The mechanics: those of the nominal stage and what the causes add."""
        system = self.nominal.dynamics(self.parameters_of(p, -1), self.data)
        if self.continuous:
            system = replace(system, hold="first")
        for i, cause in enumerate(self.causes):
            system = cause.dynamics(system, self.parameters_of(p, i))
        return system

    def jacobian(self, p: FloatArray, base: Signals, which: list[int] | None = None) -> FloatArray:
        """(m, n) derivatives of the reading with respect to the parameters ``which`` (default: all)."""
        chosen = range(len(self.parameters)) if which is None else which
        rows = np.empty((len(chosen), self.data.n))

        def column(at: tuple[int, int]) -> None:
            row, j = at
            parameter = self.parameters[j]
            step = 1e-3 * parameter.step if p[j] + 1e-3 * parameter.step <= parameter.high else -1e-3 * parameter.step
            moved = p.copy()
            moved[j] += step
            rows[row] = (self.simulate(moved, parameter.acts_on, base).reading_um - base.reading_um) / step

        side_by_side(column, enumerate(chosen))
        return rows


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
        signals = replace(self.signals, h_um=none, w_um=none, static_um=none, moved_um=none, motion_um=none, added=())
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
