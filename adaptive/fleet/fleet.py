"""A fleet: B independent learners as one batch, sample by sample the same as B single learners.

Axes whose readings are ordinary are stepped together by compiled loops (`adaptive.fleet.step`), their windows by the
processor or in torch. Readings that are far from the prediction, gaps, restarts, trials of a sensor, returns to the
identified model and repairs of a window are rare. Such an axis is *apart*: from that sample on a single learner
(``adaptive.online``) has its state and handles its samples, until it is ordinary again. So every rule of the single
learner holds for each axis, and a refused axis costs the others nothing but the time of one single learner.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.fleet import step as steps
from dehyst.adaptive.fleet.step import (
    DOUBT,
    NO_SAMPLE,
    ODD,
    OUTCOMES,
    SAMPLE,
    TEACHES,
    CompiledWindows,
    Fixed,
    FleetState,
    Rows,
    Threads,
    check_alike,
    distinct,
    fixed_of,
)
from dehyst.adaptive.inverse_model import DOMAIN_MARGIN, LssvmInverse, evaluate_packed, unpacked
from dehyst.adaptive.online import gates
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.kernel_window import ResidualWindow
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import BoolArray, Feedforward, FloatArray, IntArray, Sample, StateDict, under
from dehyst.adaptive.window.arrays import ACCEPTED, ALPHA, BETA, COUNT, GAMMA, ILL_CONDITIONED

if TYPE_CHECKING:
    from dehyst.adaptive.fleet.in_torch import TorchWindows

# --- Snapshots: the served models of all axes, immutable, and their evaluation at once.


@compiled
def _evaluate(
    lo: int, hi: int, axes: IntArray, packed: FloatArray, counts: IntArray, motion: FloatArray, memory: FloatArray,
    u: FloatArray, std: FloatArray, inside: BoolArray,
) -> None:  # fmt: skip
    for k in range(lo, hi):
        y, v, a, b = motion[0, k], motion[1, k], motion[2, k], axes[k]
        evaluate_packed(y, v, a, memory[k], packed[b], counts[b], u[k], std[k], inside[k])


@dataclass(frozen=True)
class FleetSnapshot:
    """B models. seq (B,) : last sample that each has seen. valid (B,) : whether its learner vouches for it.

    linear : (B, 2 + p) gain and offset (µm) of each axis' frame, and its linear part, V.
    packed (B, L), counts (B, C) : the models as `LssvmInverse.packed` has them.
    """

    bases: tuple[LssvmInverse, ...]
    seq: IntArray
    valid: BoolArray
    linear: FloatArray
    packed: FloatArray
    counts: IntArray
    threads: Threads

    def rest_memory(self) -> FloatArray:
        """(B, m) memory of stages that have always been at rest."""
        return np.array([base.rest_memory(base.features.y_rest_um) for base in self.bases])

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray,
        axes: IntArray | None = None,
    ) -> Feedforward:  # fmt: skip
        """Voltages (B, n) and memory (B, m) of all axes, or of B ``axes``, at (B, n) points, one sample time apart.

        Raises InputError on shapes that do not fit together.
        """
        at = np.arange(len(self.bases)) if axes is None else axes
        B, given = at.size, [np.asarray(part, dtype=np.float64) for part in (y_um, v_um_per_s, a_um_per_s2)]
        shapes = [part.shape for part in given]
        if len(shapes[0]) != 2 or shapes[0][0] != B or len(set(shapes)) != 1:
            raise InputError(f"y_um, v_um_per_s, a_um_per_s2: got shapes {shapes}, expected three of equal ({B}, n)")
        if np.shape(memory) != (B, self.bases[0].memory_size):
            raise InputError(f"memory: got shape {np.shape(memory)}, expected ({B}, {self.bases[0].memory_size})")
        after, (u, std) = np.array(memory, dtype=np.float64), np.empty((2, *shapes[0]))
        inside = np.empty(shapes[0], dtype=np.bool_)
        self.threads.share(B, _evaluate, at, self.packed, self.counts, np.array(given), after, u, std, inside)
        return Feedforward(u, std, inside, after)


@compiled
def _pack(
    lo: int, hi: int, s: Rows, c: Fixed, V: FloatArray, F: FloatArray, C: IntArray, support: FloatArray,
    widths: FloatArray, margin: float, packed: FloatArray, counts: IntArray, linear: FloatArray,
) -> None:  # fmt: skip
    """The learnt models of all axes in the layout of `LssvmInverse.packed`, with ``linear`` as of `FleetSnapshot`."""
    for b in range(lo, hi):
        out, r, f, n = packed[b], s.numbers[b], c.axis[b], C[b, COUNT]
        j, span, bounded = r.judgement, s.domain[b, 1::2] - s.domain[b, ::2], f.allowed_V > 0.0
        counts[b] = c.sizes[f.model]
        counts[b, 5], counts[b, 6], counts[b, 9] = n, 0, bounded
        m, beta, inverse_widths, alpha, scaled, at = unpacked(out, counts[b])
        m.frame[:], m.scale[:] = s.frames[b], c.features.scale[b]
        m.thresholds[:], m.arcs[:], m.retain[:] = c.features.thresholds[b], c.features.arcs[b], c.features.retain[b]
        out[3] = max(j.long_V2, j.short_V2) + j.doubt_V2
        out[4], out[5], out[6] = r.window.kernel_variance, 1.0 / (1.0 + 1.0 / F[b, GAMMA]), f.allowed_V
        out[7:13:2] = s.domain[b, ::2] - margin * span
        out[8:13:2] = s.domain[b, 1::2] + margin * span
        share = r.window.share
        beta[:], inverse_widths[:], alpha[:] = s.beta[b], widths[b], share * V[b, ALPHA, :n]
        beta[0] += share * F[b, BETA]
        scaled[:] = support[b, :, :n]
        if bounded:
            out[at : at + beta.size] = c.beta[b]
        linear[b, 0], linear[b, 1], linear[b, 2:] = r.front.track.served.gain, s.frames[b, 0], beta


def snapshot_of(
    bases: tuple[LssvmInverse, ...], s: Rows, c: Fixed, windows: dict[str, FloatArray], apart: dict[int, LssvmInverse],
    threads: Threads,
) -> FleetSnapshot:  # fmt: skip
    """Copies of what is served now; ``apart`` : models of the axes that are not in the batch, or frozen."""
    B, p = s.beta.shape
    d, most = windows["scaled"].shape[1:]
    length = max(17 + int(c.sizes[0, :3].sum()) + 2 * p + d + (1 + d) * most, c.models.shape[1])
    packed, counts = np.empty((B, length)), np.empty((B, c.sizes.shape[1]), dtype=np.int64)
    linear, parts = np.empty((B, 2 + p)), (windows[name] for name in ("V", "F", "C", "scaled", "inverse_widths"))
    threads.share(B, _pack, s, c, *parts, DOMAIN_MARGIN, packed, counts, linear)
    seq, valid = s.numbers["front"]["gates"]["seq"].copy(), s.numbers["judgement"]["valid"].copy()
    fallen = [axis for axis in np.flatnonzero(s.numbers["judgement"]["fallback"]).tolist() if axis not in apart]
    for axis, model in (apart | {axis: bases[axis] for axis in fallen}).items():
        row, sizes = model.packed
        packed[axis, : row.size], counts[axis] = row, sizes
        linear[axis] = model.features.gain, model.features.offset_um, *model.beta
    # The fourth number of a packed model is the variance of its noise.
    packed[fallen, 3] = s.numbers["judgement"]["frozen_short_V2"][fallen]
    for axis, model in apart.items():
        seq[axis], valid[axis] = model.seq, model.valid
    return FleetSnapshot(bases, seq, valid, linear, packed, counts, threads)


# --- The fleet.


#: Samples within which the matrices of all windows are written.
WRITTEN_WITHIN = 256


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """Frozen configuration of a fleet.

    learner : of every axis, see there.
    device : ``cpu`` steps the windows by the single learner's own compiled code, on the processor; any device of torch,
    its processor ``cpu:0`` too, by operations of torch, in the inverse form.
    threads : that share the axes of a step; the result does not depend on them.
    checks : most axes at a time whose model is under a control trial (`docs/learner.md`); others wait for their turn.
    """

    learner: LearnerConfig = field(default_factory=LearnerConfig)
    device: str = "cpu"
    threads: int = 2
    checks: int = 16

    def __post_init__(self) -> None:
        form = self.learner.solver.form
        if not self.device:
            raise InputError("device: got nothing, expected 'cpu' or a device of torch, as 'cuda'")
        if not 1 <= self.threads <= 256:
            raise InputError(f"threads: got {self.threads}, expected 1 to 256")
        if self.checks < 1:
            raise InputError(f"checks: got {self.checks}, expected at least 1 axis")
        if self.device != "cpu" and form != "inverse":
            raise InputError(f"learner.solver.form: got {form!r}, expected 'inverse', which device {self.device!r} has")


class Fleet:
    """Learns B axes online. Not for several threads at once; snapshots may be used anywhere.

    Attributes
    ----------
    axes : B. bases : (B,) identified models. apart : the axes that are not ordinary at present, as single learners.
    held : what frozen axes serve.
    """

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
        self.axes = len(models)
        self._samples = np.zeros(self.axes, SAMPLE)
        arrays = [template.parts.window.window_arrays for template in templates]
        if config.device == "cpu":
            self._windows: CompiledWindows | TorchWindows = CompiledWindows(self._state.rows, c, arrays, self._threads)
        else:
            from dehyst.adaptive.fleet.in_torch import TorchWindows

            self._windows = TorchWindows(self._state.rows, c, arrays, config.device)
        self.apart: dict[int, Learner] = {}
        self._shells: dict[int, Learner] = {}
        self.held: dict[int, LssvmInverse] = {}
        self._cache: FleetSnapshot | None = None
        for i in range(self.axes):
            # Before its first sample an axis has no place: the single learner takes that one.
            self._set_apart(i, self._learner(i))

    def step(self, seq: object, t_s: object, u_V: object, y_um: object, present: object = True) -> IntArray:
        """Take one sample of each axis that is ``present``; arguments are (B,) or one value for all.

        Returns (B,) results: the number of the outcome in ``OUTCOMES``, NO_SAMPLE for an axis that is not present.
        Never raises on the values of samples; raises InputError on shapes.
        """
        w = self._samples
        for name, given in (("seq", seq), ("t_s", t_s), ("u_V", u_V), ("y_um", y_um), ("present", present)):
            values = np.asarray(given)
            if values.shape not in ((), (self.axes,)):
                raise InputError(f"{name}: got shape {values.shape}, expected ({self.axes},) or one value for all")
            w[name] = values
        outcome = w["outcome"]
        outcome[:] = NO_SAMPLE
        apart, together = [axis for axis in self.apart if w["present"][axis]], w["present"].copy()
        together[list(self.apart)] = False
        inside = np.flatnonzero(together)
        if inside.size:
            self._step_together(inside)
            doubtful = np.flatnonzero(outcome == DOUBT).tolist()
            for axis in doubtful:
                self._take_out(axis)
            apart += doubtful
        for axis in apart:
            learner = self.apart[axis]
            if not learner.parts.intake.begins:
                self._windows.write([axis])
            self._settle(axis, learner, learner.handle(Sample(*w[axis].item()[:4])))
        self._windows.write(list(islice(self._windows.unwritten, -(-self.axes // WRITTEN_WITHIN))))
        return outcome.copy()

    def warm(self) -> None:
        """Load or compile every step, so that no sample waits for the compiler."""
        s, c, w, share, none = self._state.rows, self._c, self._samples, self._threads.share, np.arange(0)
        share(0, steps.take, none, s, c, w)
        share(0, steps.teach, none, self._windows.predict(none), s, c, w)
        self._windows.learn(none, w)
        still = np.zeros((self.axes, 1))
        self.snapshot().feedforward(still, still, still, self.memory())

    def _let_check(self, inside: IntArray) -> None:
        """Note whose control trial may begin: as many as the configuration allows, the longest waiting first."""
        waits = self._state.rows.numbers["front"]["until_control"]
        due = inside[waits[inside] <= 1]
        room = self.config.checks - sum(one.parts.intake.controls for one in self.apart.values())
        self._samples["controls"] = False
        self._samples["controls"][due[waits[due].argsort(kind="stable")[: max(room, 0)]]] = True

    def _step_together(self, inside: IntArray) -> None:
        s, c, w, share = self._state.rows, self._c, self._samples, self._threads.share
        outcome = w["outcome"]
        self._let_check(inside)
        share(inside.size, steps.take, inside, s, c, w)
        axes = inside[outcome[inside] == TEACHES]
        failed = axes[:0]
        if axes.size:
            share(axes.size, steps.teach, axes, self._windows.predict(axes), s, c, w)
            learning = axes[w["learns"][axes]]
            if learning.size:
                status = self._windows.learn(learning, w)
                learnt, refused = OUTCOMES.index(gates.LEARNT), OUTCOMES.index(gates.NUMERICS)
                outcome[learning] = np.where(status == ACCEPTED, learnt, refused)
                failed = learning[status == ILL_CONDITIONED]
            self._cache = None
        counted = inside[outcome[inside] >= 0]
        s.counters[counted, outcome[counted]] += 1
        for axis in axes[outcome[axes] == ODD].tolist():
            learner = self._take_out(axis)
            track = learner.parts.intake.track
            pair = track.pair() if track is not None else None
            assert pair is not None
            said = learner.teach(pair)
            learner.parts.counters[said] += 1
            self._settle(axis, learner, said)
        for axis in failed.tolist():
            self._take_out(axis).parts.window.begin_healing()

    # ---- in and out of the batch

    def _learner(self, axis: int) -> Learner:
        """The single learner of an axis, over the axis' own window."""
        if axis not in self._shells or not self._windows.shares:
            base, c = self.bases[axis], self.config.learner
            window = ResidualWindow.over(self._windows.arrays(axis), base, c.eviction, c.solver)
            self._shells[axis] = Learner.around(base, c, window, float(self._c.axis["allowed_V"][axis]))
        return self._shells[axis]

    def _set_apart(self, axis: int, learner: Learner) -> Learner:
        self.apart[axis] = learner
        self._note(axis, learner)
        return learner

    def _take_out(self, axis: int) -> Learner:
        return self._set_apart(axis, self.learner_of(axis))

    def _settle(self, axis: int, learner: Learner, outcome: str) -> None:
        """Note what a single learner said to a sample, and take it back into the batch where it is ordinary."""
        self._samples["outcome"][axis] = OUTCOMES.index(outcome)
        self._note(axis, learner)
        if learner.parts.ordinary:
            del self.apart[axis]
            arrays = learner.parts.window.window_arrays
            self._windows.put(axis, arrays)
            if arrays is not self._windows.arrays(axis):
                del self._shells[axis]
            self._state.load(axis, learner.parts.state_dict(arrays=False) | {"frozen": learner.frozen})

    def _note(self, axis: int, learner: Learner) -> None:
        """Note the figures of an axis that is apart, for reports on all."""
        self._cache = None
        self._state.rows.counters[axis] = [learner.parts.counters[name] for name in OUTCOMES]
        self._state.rows.numbers["judgement"]["short_V2"][axis] = learner.parts.judgement.short_V2

    def load_axis(self, axis: int, state: StateDict, anew: bool = False) -> None:
        """Continue an axis from the state of a single learner of the same model and configuration.

        ``anew`` : its next sample is taken whatever its number.

        Raises ModelFileError, and leaves the axis as it is, where it is of another.
        """
        # First, because the settings of a damaged state may ask for any memory.
        if under("config.", state) != self.config.learner.state_dict():
            raise ModelFileError(f"axis {axis}: the state is of another configuration of the learner")
        given, base = Learner.from_state(state), self.bases[axis]
        if given.base.features != base.features or not np.array_equal(given.base.beta, base.beta):
            raise ModelFileError(f"axis {axis}: the state is of another model; load the one of this axis")
        self._shells.pop(axis, None)
        self._windows.put(axis, given.parts.window.window_arrays)
        learner = self._learner(axis)
        learner.resume(state, arrays=False)
        if anew:
            learner.resync()
        # Its next sample shows whether it is ordinary.
        self._set_apart(axis, learner)
        self.held.pop(axis, None)
        self.freeze([axis], learner.frozen)

    def freeze(self, axes: Iterable[int], frozen: bool = True) -> None:
        """Stop the learning of some axes and keep what they serve; with ``frozen=False`` let them learn again.

        Their samples are still tracked and judged.
        """
        for axis in axes:
            learner = self.learner_of(axis)
            (learner.freeze if frozen else learner.thaw)()
            self._state.rows.numbers["frozen"][axis] = frozen
            if frozen:
                self.held.setdefault(axis, learner.snapshot())
            else:
                self.held.pop(axis, None)
        self._cache = None

    # ---- snapshots out

    def model_of(self, axis: int) -> LssvmInverse:
        """The model of an axis as it is served, immutable."""
        return self.held.get(axis) or self.learner_of(axis).snapshot()

    def snapshot(self) -> FleetSnapshot:
        """The models of all axes as they stand, immutable; the same object while nothing was learnt."""
        if self._cache is None:
            models = {axis: learner.snapshot() for axis, learner in self.apart.items()} | self.held
            rows, samples = self._state.rows, self._windows.samples()
            self._cache = snapshot_of(self.bases, rows, self._c, samples, models, self._threads)
        return self._cache

    def memory(self) -> FloatArray:
        """(B, m) hysteresis memory with which each axis' served model goes on from its last sample."""
        s, identified = self._state.rows, self._state.rows.numbers["judgement"]["fallback"].copy()
        for axis, model in self.held.items():
            moved = not np.array_equal(s.frames[axis], model.features.arrays.frame)
            identified[axis] = moved and model.features == self.bases[axis].features
        out = np.empty_like(s.memory)
        steps.memory_now(s, self._c, identified, out)
        for axis, learner in self.apart.items():
            kept = learner.memory_for(self.held.get(axis) or learner.snapshot())
            out[axis] = learner.memory() if kept is None else kept
        return out

    # ---- reports

    def learner_of(self, axis: int) -> Learner:
        """An axis as a single learner, to look into: its own where it is apart, else a copy."""
        self._windows.write([axis])
        if axis in self.apart:
            return self.apart[axis]
        learner = self._learner(axis)
        learner.resume(self._state.read(axis), arrays=False)
        return learner

    def outcomes(self) -> IntArray:
        """(B, outcomes) samples by outcome, in the order of ``OUTCOMES``."""
        return self._state.rows.counters.copy()

    def rms_error_pct(self) -> FloatArray:
        """(B,) rms error of the last 0.1 s, percent of the voltage span."""
        mean_V2 = self._state.rows.numbers["judgement"]["short_V2"]
        return np.asarray(100.0 * np.sqrt(mean_V2) / self._c.axis["span_V"], dtype=np.float64)

    def troubles(self) -> dict[int, str]:
        """Names of what keeps axes from learning, by axis; see `Learner.trouble`. Such an axis is apart."""
        return {axis: one.trouble for axis, one in sorted(self.apart.items()) if one.trouble}
