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
    """A cause, neutral in every hook that it does not override. ``variant`` tells forms of one name apart."""

    name: str = ""
    variant: str = ""
    #: Slots of the nominal stage that would mean the same number twice, and stand still while this form is in.
    pins: tuple[str, ...] = ()
    #: Sub-steps of a sample at which drive and loop are simulated while this form is in.
    substeps: int = 1
    #: What it makes of the drive has no jumps: from one sub-step to the next it runs in a straight line.
    continuous: bool = False
    #: Acts within a few samples of a step, where the hold between two samples would have been chosen to imitate it.
    fast: bool = False
    #: Its numbers belong to one recording and say nothing of another (a drift over time, a hum's phase).
    of_one_recording: bool = False
    #: Share (rms) of what it removes that its fitted form may leave behind in a real stage: no form is exact.
    model_error: float = 0.025

    def applies(self, data: FitData) -> str:
        """Empty where the recording could show this cause at all, else what is missing."""
        return ""

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        raise NotImplementedError

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        """Guesses. The default for a linear form: one trial with a unit of every number."""
        parameters = self.parameters(data)
        neutral = np.array([s.neutral for s in parameters])
        rows = []
        for i, parameter in enumerate(parameters):
            row = neutral.copy()
            row[i] += parameter.step
            rows.append(row)
        return [rows]

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        """Whether the fitted numbers are of a size and a sign that this cause has."""
        return True

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return u_V

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        """What is added to the static displacement, (n,), or None."""
        return None

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system

    def later(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        """A moment (s) from which the linear part is another, and that other one; None where it stays."""
        return None

    def beside(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, data: FitData, system: Dynamics
    ) -> FloatArray | None:
        """What moves beside the nominal mechanics, (n,), driven by the voltage or by the static displacement."""
        return None

    def restoring(self, p: FloatArray, data: FitData) -> RestoringForce | None:
        """Hysteresis in the restoring force, or None."""
        return None

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return x_um

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return y_um

    def physical(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Reported numbers by name: value and its gradient by ``p`` (for the interval)."""
        out = {}
        for i, parameter in enumerate(self.parameters(data)):
            gradient = np.zeros(p.size)
            gradient[i] = 1.0
            out[parameter.name] = (float(p[i]), gradient)
        return out


def single_guesses(values: list[float]) -> list[Guess]:
    """Trials of a form of one number."""
    return [[np.array([v])] for v in values]


@dataclass
class Signals:
    """Signals between the stretches of one simulation, kept so that a later one may start half way."""

    drive_V: FloatArray
    h_um: FloatArray
    #: The nominal stage's own static displacement, and the parameters that it is of.
    w_um: FloatArray
    nominal_p: bytes
    static_um: FloatArray
    moved_um: FloatArray
    motion_um: FloatArray
    reading_um: FloatArray


@dataclass(frozen=True)
class StageModel:
    """Nominal stage + causes, in a setting. Parameters are one flat vector: the nominal's, then each cause's.

    ``frozen`` causes (of a stage file) stand among ``forms`` like any other; only their parameters are tighter.
    """

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

    def part(self, p: FloatArray, index: int) -> FloatArray:
        """The parameters of the cause ``forms[index]``; -1 is the nominal stage."""
        return p[self._cuts[index + 1] : self._cuts[index + 2]]

    def where(self, index: int) -> slice:
        """Place of the parameters of ``forms[index]`` in the flat vector."""
        return slice(self._cuts[index + 1], self._cuts[index + 2])

    @property
    def substeps(self) -> int:
        """Sub-steps of a sample at which drive and loop are simulated."""
        return max(self.nominal.substeps, *(cause.substeps for cause in self.causes), 1)

    @property
    def continuous(self) -> bool:
        """Whether a cause smooths the drive, so that nothing behind it jumps."""
        return any(cause.continuous for cause in self.causes)

    def plus(self, cause: CauseModel) -> StageModel:
        """The model with one cause more, at the end."""
        return StageModel(self.data, self.nominal, (*self.causes, cause))

    def less(self, index: int) -> StageModel:
        """The model without the cause ``forms[index]``."""
        return StageModel(self.data, self.nominal, self.causes[:index] + self.causes[index + 1 :])

    def simulate(self, p: FloatArray, start: ActsOn = ActsOn.DRIVE, kept: Signals | None = None) -> Signals:
        """All signals with parameters ``p``; the stretches before ``start`` are taken from ``kept``."""
        s = self.data
        substeps = self.substeps
        inner = s.subdivided(substeps, self.nominal.hold)
        parts = [self.part(p, i) for i in range(len(self.causes))]
        mine = self.part(p, -1)
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
                # A number of a cause: the nominal loop, which costs most, is as it was.
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
                # Beside a loop in the force a mode does not go on by superposition.
                change = cause.later(system, q) if back is None else None
                if change is not None:
                    moved = changed_midway(static, moved, system, change, inner.dt_s)
            for cause, q in pairs:
                more = cause.beside(drive, static, q, inner, system)
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
        """The linear part: the nominal's and what the causes add to it."""
        system = self.nominal.dynamics(self.part(p, -1), self.data)
        if self.continuous:
            system = replace(system, hold="first")
        for i, cause in enumerate(self.causes):
            system = cause.dynamics(system, self.part(p, i))
        return system

    def jacobian(self, p: FloatArray, base: Signals, which: list[int] | None = None) -> FloatArray:
        """Derivatives of the reading by the parameters ``which`` (all by default), (m, n), one row a parameter."""
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
