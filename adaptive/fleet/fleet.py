"""A fleet: B independent learners as one batch, sample by sample the same as B single learners.

Axes whose readings are ordinary are stepped together by compiled loops (`adaptive.fleet.step`), their windows by the
processor or in torch. Readings that are far from the prediction, gaps, restarts, trials of a sensor, returns to the
identified model and repairs of a window are rare. Such an axis is *apart*: from that sample on a single learner
(``adaptive.online``) has its state and handles its samples, until it is ordinary again. So every rule of the single
learner holds for each axis, and a refused axis costs the others nothing but the time of one single learner.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.fleet import step as steps
from adaptive.fleet.config import FleetConfig
from adaptive.fleet.snapshot import FleetSnapshot, snapshot_of
from adaptive.fleet.state import OUTCOMES, FleetState, check_alike, distinct, fixed_of
from adaptive.fleet.step import DOUBT, NO_SAMPLE, ODD, TEACHES, Samples, Work
from adaptive.fleet.windows import CompiledWindows, Step, Threads
from adaptive.inverse_model import LssvmInverse
from adaptive.online import gates
from adaptive.online.kernel_window import ResidualWindow
from adaptive.online.learner import Learner
from adaptive.types import FloatArray, IntArray, Sample, StateDict
from adaptive.window.arrays import ACCEPTED, ILL_CONDITIONED, WindowArrays

if TYPE_CHECKING:
    from adaptive.fleet.in_torch import TorchWindows

#: Samples within which the matrices of all windows are written.
WRITTEN_WITHIN = 256


class Fleet:
    """Learns B axes online. Not for several threads at once; snapshots may be used anywhere."""

    def __init__(self, models: Sequence[LssvmInverse], config: FleetConfig | None = None) -> None:
        """``models`` : the identified model of each axis. Raises InputError where their shapes differ."""
        self.config = config = config or FleetConfig()
        self.bases = tuple(models)
        check_alike(models)
        numbers = distinct(models)
        made = [Learner(models[numbers.index(i)], config.learner) for i in range(max(numbers) + 1)]
        templates = [made[number] for number in numbers]
        self._c = c = fixed_of(models, config.learner, templates)
        self._state = FleetState(models, config.learner, templates[0].parts.delay.steps)
        self._threads = Threads(config.threads)
        B, p = c.beta.shape
        self._work = Work(
            self._state.rows.numbers.copy(), np.empty(B, dtype=np.int64), np.empty((B, p)),
            *np.zeros((2, B), dtype=np.bool_), *np.zeros((2, B)),
        )  # fmt: skip
        arrays = [template.parts.window.window_arrays for template in templates]
        self._windows = self._make_windows(arrays)
        self._apart: dict[int, Learner] = {}
        self._shells: dict[int, Learner] = {}
        #: What frozen axes serve: their rows of a snapshot.
        self._held: dict[int, tuple[Any, ...]] = {}
        self._cache: FleetSnapshot | None = None
        for i in range(B):
            # Before its first sample an axis has no place: the single learner takes that one.
            self._set_apart(i, self._learner(i))

    def _make_windows(self, starts: Sequence[WindowArrays]) -> CompiledWindows | TorchWindows:
        rows, config = self._state.rows, self.config
        if not config.in_torch:
            return CompiledWindows(rows, self._c, starts, self._threads)
        from adaptive.fleet.in_torch import TorchWindows

        return TorchWindows(rows, self._c, starts, config.device)

    # ---- samples in

    @property
    def axes(self) -> int:
        """B."""
        return len(self.bases)

    def step(self, seq: object, t_s: object, u_V: object, y_um: object, present: object = True) -> IntArray:
        """Take one sample of each axis that is ``present``; arguments are (B,) or one value for all.

        Returns (B,) results: the number of the outcome in ``OUTCOMES``, NO_SAMPLE for an axis that is not present.
        Never raises on the values of samples; raises InputError on shapes.
        """
        taken = self._given("present", present, np.bool_)
        numbers = (("t_s", t_s), ("u_V", u_V), ("y_um", y_um))
        sample = [self._given("seq", seq, np.int64), *(self._given(name, value, np.float64) for name, value in numbers)]
        outcome = self._work.outcome
        outcome[:] = NO_SAMPLE
        apart, together = [axis for axis in self._apart if taken[axis]], taken.copy()
        together[list(self._apart)] = False
        inside = np.flatnonzero(together)
        if inside.size:
            self._step_together(inside, Samples._make([*sample, self._may_check(inside)]))
            doubtful = np.flatnonzero(outcome == DOUBT).tolist()
            for axis in doubtful:
                self._take_out(axis)
            apart += doubtful
        for axis in apart:
            learner = self._apart[axis]
            if not learner.parts.intake.begins:
                self._windows.write([axis])
            said = learner.handle(Sample(*(part[axis].item() for part in sample)))
            self._settle(axis, learner, said)
        self._windows.write(list(islice(self._windows.unwritten, -(-self.axes // WRITTEN_WITHIN))))
        return outcome.copy()

    def warm(self) -> None:
        """Load or compile every step, so that no sample waits for the compiler."""
        s, c, w, share, none = self._state.rows, self._c, self._work, self._threads.share, np.arange(0)
        samples = Samples(none, w.targets, w.targets, w.targets, w.learns)
        share(0, steps.take, none, s, c, samples, w)
        share(0, steps.teach, none, self._windows.predict(none), s, c, w)
        self._windows.let_go(none, 1.0)
        self._windows.learn(none, Step(s.point[none], w.targets[none], w.weights[none], 0.0, False))
        still = np.zeros((self.axes, 1))
        self.snapshot().feedforward(still, still, still, self.memory())

    def _given(self, name: str, value: object, kind: type) -> Any:
        given: Any = np.asarray(value, dtype=kind)
        if given.ndim > 1 or (given.ndim == 1 and given.shape[0] != self.axes):
            raise InputError(f"{name}: got shape {given.shape}, expected ({self.axes},) or one value for all")
        return np.ascontiguousarray(np.broadcast_to(given, (self.axes,)))

    def _may_check(self, inside: IntArray) -> Any:
        """(B,) axes whose control trial may begin: as many as the configuration allows, the longest waiting first."""
        may = np.zeros(self.axes, dtype=np.bool_)
        waits = self._state.rows.numbers["front"]["until_control"]
        due = inside[waits[inside] <= 1]
        if due.size:
            room = self.config.checks - sum(one.parts.intake.controls for one in self._apart.values())
            may[due[waits[due].argsort(kind="stable")[: max(room, 0)]]] = True
        return may

    def _step_together(self, inside: IntArray, samples: Samples) -> None:
        s, c, w, config, share = self._state.rows, self._c, self._work, self.config.learner, self._threads.share
        share(inside.size, steps.take, inside, s, c, samples, w)
        axes = inside[w.outcome[inside] == TEACHES]
        failed = axes[:0]
        if axes.size:
            share(axes.size, steps.teach, axes, self._windows.predict(axes), s, c, w)
            fading = axes[w.lets_go[axes] & (w.outcome[axes] >= 0)]
            if fading.size:
                self._windows.let_go(fading, config.weights.before_change)
            failed = self._learn(axes[w.learns[axes]])
            self._cache = None
        counted = inside[w.outcome[inside] >= 0]
        s.counters[counted, w.outcome[counted]] += 1
        for axis in axes[w.outcome[axes] == ODD].tolist():
            learner = self._take_out(axis)
            track = learner.parts.intake.track
            pair = track.pair() if track is not None else None
            assert pair is not None
            outcome = learner.teach(pair)
            learner.parts.counters[outcome] += 1
            self._settle(axis, learner, outcome)
        for axis in failed.tolist():
            self._take_out(axis).parts.window.begin_healing()

    def _learn(self, axes: IntArray) -> IntArray:
        """One sample into the windows of ``axes``; returns those whose step was refused for numerics."""
        if not axes.size:
            return axes
        s, w, c = self._state.rows, self._work, self.config.learner
        step_s, fifo = c.learn_every * self.bases[0].dt_s, c.eviction == "fifo"
        step = Step(s.point[axes], w.targets[axes], w.weights[axes], step_s, fifo)
        status: IntArray = self._windows.learn(axes, step)
        w.outcome[axes] = np.where(status == ACCEPTED, OUTCOMES.index(gates.LEARNT), OUTCOMES.index(gates.NUMERICS))
        return np.asarray(axes[status == ILL_CONDITIONED])

    # ---- in and out of the batch

    def _learner(self, axis: int) -> Learner:
        """The single learner of an axis, over the axis' own window."""
        if axis not in self._shells or not self._windows.shares:
            base, c = self.bases[axis], self.config.learner
            window = ResidualWindow.over(self._windows.arrays(axis), base, c.eviction, c.solver)
            self._shells[axis] = Learner.around(base, c, window, float(self._c.axis["allowed_V"][axis]))
        return self._shells[axis]

    def _set_apart(self, axis: int, learner: Learner) -> Learner:
        self._apart[axis] = learner
        self._cache = None
        return learner

    def _take_out(self, axis: int) -> Learner:
        return self._set_apart(axis, self.learner_of(axis))

    def _settle(self, axis: int, learner: Learner, outcome: str) -> None:
        """Note what a single learner said to a sample, and take it back into the batch where it is ordinary."""
        self._work.outcome[axis] = OUTCOMES.index(outcome)
        self._cache = None
        if learner.parts.ordinary:
            del self._apart[axis]
            arrays = learner.parts.window.window_arrays
            self._windows.put(axis, arrays)
            if arrays is not self._windows.arrays(axis):
                del self._shells[axis]
            self._state.load(axis, learner.parts.state_dict(arrays=False) | {"frozen": learner.frozen})

    def export_axis(self, axis: int) -> StateDict:
        """The whole state of an axis, as of ``Learner.state_dict``."""
        return self.learner_of(axis).state_dict()

    def load_axis(self, axis: int, state: StateDict, anew: bool = False) -> None:
        """Continue an axis from the state of a single learner of the same model and configuration.

        ``anew`` : its next sample is taken whatever its number.

        Raises ModelFileError, and leaves the axis as it is, where it is of another.
        """
        given, base = Learner.from_state(state), self.bases[axis]
        if given.base.features != base.features or not np.array_equal(given.base.beta, base.beta):
            raise ModelFileError(f"axis {axis}: the state is of another model; load the one of this axis")
        if given.config != self.config.learner:
            raise ModelFileError(f"axis {axis}: the state is of another configuration of the learner")
        self._shells.pop(axis, None)
        self._held.pop(axis, None)
        self._windows.put(axis, given.parts.window.window_arrays)
        learner = self._learner(axis)
        learner.resume(state, arrays=False)
        self._state.rows.numbers["frozen"][axis] = learner.frozen
        if anew:
            learner.resync()
        # Its next sample shows whether it is ordinary.
        self._set_apart(axis, learner)

    def freeze(self, axes: Iterable[int], frozen: bool = True) -> None:
        """Stop the learning of some axes and keep what they serve; with ``frozen=False`` let them learn again.

        Their samples are still tracked and judged.
        """
        for axis in axes:
            self._state.rows.numbers["frozen"][axis] = frozen
            if axis in self._apart:
                (self._apart[axis].freeze if frozen else self._apart[axis].thaw)()
            if not frozen:
                self._held.pop(axis, None)
        self._cache = None
        self.snapshot()

    @property
    def frozen(self) -> IntArray:
        """The axes that do not learn."""
        return np.flatnonzero(self._state.rows.numbers["frozen"])

    # ---- models out

    def snapshot(self) -> FleetSnapshot:
        """The models of all axes as they stand, immutable; the same object while nothing was learnt."""
        if self._cache is None:
            apart = {axis: learner.snapshot() for axis, learner in self._apart.items()}
            rows, samples = self._state.rows, self._windows.samples()
            self._cache = snapshot_of(self.bases, rows, self._c, samples, apart, self._threads)
            learnt = self._cache.learnt
            for axis in self.frozen.tolist():
                held = self._held.setdefault(axis, tuple(part[axis].copy() for part in learnt))
                for part, kept in zip(learnt, held, strict=True):
                    part[axis] = kept
        return self._cache

    def memory(self) -> FloatArray:
        """(B, m) hysteresis memory with which each axis' served model goes on from its last sample."""
        s = self._state.rows
        out = np.empty_like(s.memory)
        identified, snapshot = s.numbers["judgement"]["fallback"].copy(), self.snapshot()
        for axis in self._held:
            f = self.bases[axis].features
            identified[axis] = tuple(snapshot.linear[axis, :2]) == (f.gain, f.offset_um)
        steps.memory_now(s, self._c, identified, out)
        for axis, learner in self._apart.items():
            kept = learner.memory_for(learner.snapshot())
            if kept is not None and axis in self._held:
                kept = learner.parts.intake.memory_now(bool(identified[axis]))
            out[axis] = learner.memory() if kept is None else kept
        return out

    # ---- reports

    def learner_of(self, axis: int) -> Learner:
        """An axis as a single learner, to look into: its own where it is apart, else a copy."""
        self._windows.write([axis])
        if axis in self._apart:
            return self._apart[axis]
        learner = self._learner(axis)
        learner.resume(self._state.read(axis), arrays=False)
        return learner

    def counters(self, axis: int) -> dict[str, int]:
        """Samples of an axis by outcome, and events; see `Learner.counters`."""
        return self.learner_of(axis).counters()

    def outcomes(self) -> IntArray:
        """(B, outcomes) samples by outcome, in the order of ``OUTCOMES``."""
        out = self._state.rows.counters.copy()
        for axis, learner in self._apart.items():
            out[axis] = [learner.parts.counters[name] for name in OUTCOMES]
        return out

    def rms_error_pct(self) -> FloatArray:
        """(B,) rms error of the last 0.1 s, percent of the voltage span."""
        out = self._state.rows.numbers["judgement"]["short_V2"].copy()
        for axis, learner in self._apart.items():
            out[axis] = learner.parts.judgement.short_V2
        return np.asarray(100.0 * np.sqrt(out) / self._c.axis["span_V"], dtype=np.float64)

    def troubles(self) -> dict[int, str]:
        """Names of what keeps axes from learning, by axis; see `Learner.trouble`. Such an axis is apart."""
        return {axis: one.trouble for axis, one in sorted(self._apart.items()) if one.trouble}

    @property
    def apart(self) -> tuple[int, ...]:
        """The axes that are not ordinary at present."""
        return tuple(sorted(self._apart))
