"""The model that is fitted: a nominal stage and the causes added to it, simulated stretch by stretch."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics, changed_midway, respond
from sim.diagnosis.model.forms import Form
from sim.diagnosis.model.measured import At, Setting, Slot
from sim.diagnosis.model.nominal import Nominal
from sim.diagnosis.search.parallel import side_by_side


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
class Model:
    """Nominal stage + causes, in a setting. Parameters are one flat vector: the nominal's, then each cause's.

    ``frozen`` causes (of a stage file) stand among ``forms`` like any other; only their slots are tighter.
    """

    setting: Setting
    nominal: Nominal
    forms: tuple[Form, ...] = ()
    _slots: tuple[Slot, ...] = field(init=False, repr=False)
    _cuts: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        groups = [self.nominal.slots(self.setting), *(f.slots(self.setting) for f in self.forms)]
        cuts = np.cumsum([0, *(len(g) for g in groups)])
        object.__setattr__(self, "_slots", tuple(s for g in groups for s in g))
        object.__setattr__(self, "_cuts", tuple(int(c) for c in cuts))

    @property
    def slots(self) -> tuple[Slot, ...]:
        return self._slots

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
        return max(self.nominal.substeps, *(form.substeps for form in self.forms), 1)

    @property
    def continuous(self) -> bool:
        """Whether a cause smooths the drive, so that nothing behind it jumps."""
        return any(form.continuous for form in self.forms)

    def plus(self, form: Form) -> Model:
        """The model with one cause more, at the end."""
        return Model(self.setting, self.nominal, (*self.forms, form))

    def less(self, index: int) -> Model:
        """The model without the cause ``forms[index]``."""
        return Model(self.setting, self.nominal, self.forms[:index] + self.forms[index + 1 :])

    def simulate(self, p: FloatArray, start: At = At.DRIVE, kept: Signals | None = None) -> Signals:
        """All signals with parameters ``p``; the stretches before ``start`` are taken from ``kept``."""
        s = self.setting
        substeps = self.substeps
        inner = s.fine(substeps, self.nominal.hold)
        parts = [self.part(p, i) for i in range(len(self.forms))]
        mine = self.part(p, -1)
        pairs = list(zip(self.forms, parts, strict=True))
        if kept is None:
            start = At.DRIVE
        if start <= At.DRIVE or kept is None:
            drive = inner.u_V
            for form, q in pairs:
                drive = form.drive(drive, q, inner)
        else:
            drive = kept.drive_V
        if start <= At.STATIC or kept is None:
            own = mine.tobytes()
            if kept is not None and start == At.STATIC and kept.nominal_p == own:
                # A number of a cause: the nominal loop, which costs most, is as it was.
                h, w = kept.h_um, kept.w_um
            else:
                h, w = self.nominal.static(drive, mine, inner)
            extra = [e for form, q in pairs if (e := form.static(drive, h, w, q, mine, inner)) is not None]
            static = w + sum(extra) if extra else w
        else:
            h, w, own, static = kept.h_um, kept.w_um, kept.nominal_p, kept.static_um
        if start <= At.DYNAMICS or kept is None:
            began = self.nominal.start_um(mine)
            if began != 0.0:
                static = static.copy()
                static[0] += began
            back = next((r for form, q in pairs if (r := form.restoring(q, s)) is not None), None)
            system = self.dynamics(p)
            moved = respond(static, system, inner.dt_s, back)
            for form, q in pairs:
                # Beside a loop in the force a mode does not go on by superposition.
                change = form.later(system, q) if back is None else None
                if change is not None:
                    moved = changed_midway(static, moved, system, change, inner.dt_s)
            for form, q in pairs:
                more = form.beside(drive, static, q, inner, system)
                if more is not None:
                    moved = moved + more
            if substeps > 1:
                moved = np.ascontiguousarray(moved[::substeps])
        else:
            moved = kept.moved_um
        if start <= At.MOTION or kept is None:
            motion = moved
            for form, q in pairs:
                motion = form.motion(motion, q, s)
            motion = self.nominal.behind_um(motion, s)
        else:
            motion = kept.motion_um
        reading = motion
        for form, q in pairs:
            reading = form.reading(reading, q, s)
        reading = reading + self.nominal.offset_um(mine)
        return Signals(drive, h, w, own, static, moved, motion, reading)

    def dynamics(self, p: FloatArray) -> Dynamics:
        """The linear part: the nominal's and what the causes add to it."""
        system = self.nominal.dynamics(self.part(p, -1), self.setting)
        if self.continuous:
            system = replace(system, hold="first")
        for i, form in enumerate(self.forms):
            system = form.dynamics(system, self.part(p, i))
        return system

    def jacobian(self, p: FloatArray, base: Signals, which: list[int] | None = None) -> FloatArray:
        """Derivatives of the reading by the parameters ``which`` (all by default), (m, n), one row a parameter."""
        chosen = range(len(self.slots)) if which is None else which
        rows = np.empty((len(chosen), self.setting.n))

        def column(at: tuple[int, int]) -> None:
            row, j = at
            slot = self.slots[j]
            step = 1e-3 * slot.step if p[j] + 1e-3 * slot.step <= slot.high else -1e-3 * slot.step
            moved = p.copy()
            moved[j] += step
            rows[row] = (self.simulate(moved, slot.at, base).reading_um - base.reading_um) / step

        side_by_side(column, enumerate(chosen))
        return rows
