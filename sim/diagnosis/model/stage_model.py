"""The stage model that is fitted: a nominal stage and cause models, simulated block by block."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics, RestoringForce, changed_midway, respond
from sim.diagnosis.model.fit_data import ActsOn, FitData, ModelParameter
from sim.diagnosis.model.nominal import NominalStage
from sim.diagnosis.parallel import side_by_side

#: Vectors whose simulated differences from the neutral span one linearised guess, and whether they may be scaled.
Guess = list[FloatArray]


@dataclass(frozen=True)
class CauseModel:
    """Model of one cause. Each hook is neutral unless overridden. ``variant`` tells models of one cause apart."""

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
    #: Its direct test also answers to other causes: it supports the name but does not replace the null distribution.
    test_answers_to_others: bool = False
    #: It is not named where its direct test is excited and sees nothing.
    unseen_is_absent: bool = False
    #: So smooth in time that it imitates the rest of many others: where its test is not excited, it must explain most.
    imitates_others: bool = False
    #: Model error: share (RMS) of the removed residual that the model may leave behind in a real stage.
    model_error: float = 0.025

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

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return u_V

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        """(n,) µm added to the static displacement, or None."""
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
            if kept is not None and start == ActsOn.STATIC and kept.nominal_p == own:
                # Only a cause has changed: the nominal hysteresis, which costs most time, is the same.
                h, w = kept.h_um, kept.w_um
            else:
                h, w = self.nominal.static(drive, mine, inner)
            extra = [e for cause, q in pairs if (e := cause.static(drive, h, w, q, mine, inner)) is not None]
            static = w + sum(extra) if extra else w
        else:
            h, w, own, static = kept.h_um, kept.w_um, kept.nominal_p, kept.static_um
        if start <= ActsOn.DYNAMICS or kept is None:
            began = self.nominal.start_um(mine)
            if began != 0.0:
                static = static.copy()
                static[0] += began
            back = next((r for cause, q in pairs if (r := cause.restoring(q, s)) is not None), None)
            system = self.dynamics(p)
            moved = respond(static, system, inner.dt_s, back)
            for cause, q in pairs:
                # With hysteresis in the force superposition does not hold.
                change = cause.changed_dynamics(system, q) if back is None else None
                if change is not None:
                    moved = changed_midway(static, moved, system, change, inner.dt_s)
            for cause, q in pairs:
                more = cause.added_motion(drive, static, q, inner, system)
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
        return Signals(drive, h, w, own, static, moved, motion, reading)

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
