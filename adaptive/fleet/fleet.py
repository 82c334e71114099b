"""A fleet: B learners as one batch, sample by sample the same as B single ones.

The order of a sample is that of a single learner (`adaptive.online.step`), in a compiled loop over the axes. The rows
of all axes are in common arrays. Where a sample needs what is rare, the axis' own `Learner` goes on with it, on the
same row, so that a refused axis costs the others nothing but the time of one single learner. The windows are stepped on
the processor, or all at once in torch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.inverse_model import DOMAIN_MARGIN, LssvmInverse, evaluate_packed, unpacked
from dehyst.adaptive.online import gates
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import OUTCOMES
from dehyst.adaptive.online.learner import NUMBERS, Home, Learner, allocate, config_record, row_in
from dehyst.adaptive.online.row import row_of
from dehyst.adaptive.online.step import DONE, ILL, JUDGE, PREDICT, TAKE, TRIED, WINDOW, go_on_all, memories_now
from dehyst.adaptive.types import BoolArray, Feedforward, FloatArray, IntArray, StateDict, under
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window.arrays import ACCEPTED, ALPHA, BETA, COUNT, GAMMA, ILL_CONDITIONED, WindowArrays

if TYPE_CHECKING:
    from dehyst.adaptive.fleet.in_torch import TorchWindows

#: In place of an outcome: no sample.
NO_SAMPLE: Final = -1


def distinct(bases: Sequence[LssvmInverse]) -> list[int]:
    """(B,) number of the distinct model of each axis, frames aside, in the order of their first axes."""
    found: dict[tuple[bytes, float], int] = {}
    return [found.setdefault((base.packed[0][3:].tobytes(), base.span_V), len(found)) for base in bases]


def check_alike(bases: Sequence[LssvmInverse]) -> None:
    """Raise InputError naming the first axis whose model has another shape than that of axis 0."""
    if not bases:
        raise InputError("models: got none, expected one for each axis")
    # Of the packed sizes all but the number of samples, the covariance and the bound.
    shapes = [{"dt_s": base.dt_s, "shape": np.delete(base.packed[1], (5, 6, 9)).tolist()} for base in bases]
    for i, shape in enumerate(shapes):
        for name, got in shape.items():
            if got != shapes[0][name]:
                raise InputError(
                    f"models[{i}].{name}: got {got}, expected {shapes[0][name]} as of axis 0; identify all alike"
                )


# --- Threads that share the axes. Each axis is stepped by one of them, so the result does not depend on their number.


#: Fewest axes for which a second thread is worth its wake-up.
_LEAST_AXES = 16


class Threads:
    """Some threads that share a loop over axes; for several callers at once."""

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count - 1, "fleet") if count > 1 else None
        self._count = count

    def share(self, count: int, work: Callable[..., None], *arguments: object) -> None:
        """``work(lo, hi, ...)`` over ``count`` axes, in parts on the threads."""
        parts = max(1, min(self._count, count // _LEAST_AXES))
        ends = [count * i // parts for i in range(parts + 1)]
        pool = self._pool
        others = [pool.submit(work, ends[i], ends[i + 1], *arguments) for i in range(1, parts)] if pool else []
        work(0, ends[1], *arguments)
        for one in others:
            one.result()


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
    lo: int, hi: int, rows: IntArray, numbers: Any, V: FloatArray, F: FloatArray, C: IntArray, support: FloatArray,
    widths: FloatArray, margin: float, packed: FloatArray, counts: IntArray, linear: FloatArray,
) -> None:  # fmt: skip
    """The learnt models of all axes in the layout of `LssvmInverse.packed`, with ``linear`` as of `FleetSnapshot`."""
    for b in range(lo, hi):
        A, out, r, n = row_of(rows[b]), packed[b], numbers[b], C[b, COUNT]
        j, span, bounded = r.judgement, A.domain[1::2] - A.domain[::2], r.fixed.allowed_V > 0.0
        counts[b] = A.sizes
        counts[b, 5], counts[b, 6], counts[b, 9] = n, 0, bounded
        known, anchor, _, _, _, _ = unpacked(A.model, A.sizes)
        m, beta, inverse_widths, alpha, scaled, at = unpacked(out, counts[b])
        m.frame[:], m.scale[:] = A.frames[1, :3], known.scale
        m.thresholds[:], m.arcs[:], m.retain[:] = known.thresholds, known.arcs, known.retain
        out[3] = max(j.long_V2, j.short_V2) + j.doubt_V2
        out[4], out[5], out[6] = r.share.kernel_variance, 1.0 / (1.0 + 1.0 / F[b, GAMMA]), r.fixed.allowed_V
        out[7:13:2] = A.domain[::2] - margin * span
        out[8:13:2] = A.domain[1::2] + margin * span
        share = r.share.share
        beta[:], inverse_widths[:], alpha[:] = A.beta, widths[b], share * V[b, ALPHA, :n]
        beta[0] += share * F[b, BETA]
        scaled[:] = support[b, :, :n]
        if bounded:
            out[at : at + beta.size] = anchor
        linear[b, 0], linear[b, 1], linear[b, 2:] = A.frames[1, 3], A.frames[1, 0], beta


# --- The windows of all axes on the processor: the single learner's own compiled steps.


class CompiledWindows:
    """Windows of B axes, stepped by compiled code."""

    #: Whether ``arrays`` gives the state itself, not a copy.
    shares = True

    def __init__(self, starts: Sequence[WindowArrays]) -> None:
        """``starts`` : what each window begins as."""
        names = [name for name in WindowArrays._fields if name != "kept"]
        self._all = {name: np.array([getattr(start, name) for start in starts]) for name in names}
        # It takes memory as it is written: in the inverse form, never.
        self._all["kept"] = np.zeros((len(starts), starts[0].kept.size))
        self._views = [
            WindowArrays(**{name: field[axis] for name, field in self._all.items()}) for axis in range(len(starts))
        ]
        for view in self._views:
            ws.forget_kept(view)
        self.handles = np.array([ws.handle_of(view) for view in self._views])

    def arrays(self, axis: int) -> WindowArrays:
        """The solver's state of an axis: views, stepped in place by whoever has them."""
        return self._views[axis]

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver."""
        ws.take_over(self._views[axis], arrays)

    def samples(self) -> dict[str, FloatArray]:
        """The windows' arrays by name; views."""
        return self._all


# --- The fleet.


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
    axes : B. bases : (B,) identified models. held : what frozen axes serve.
    """

    def __init__(self, models: Sequence[LssvmInverse], config: FleetConfig | None = None) -> None:
        """``models`` : the identified model of each axis. Raises InputError where their shapes differ."""
        self.config = config = config or FleetConfig()
        self.bases = tuple(models)
        check_alike(models)
        numbers, c = distinct(models), config.learner
        made = [Learner(models[numbers.index(i)], c) for i in range(max(numbers) + 1)]
        starts = [made[number].parts.window.window_arrays for number in numbers]
        self.axes, self._threads = len(models), Threads(config.threads)
        self._numbers, self._config = np.zeros(self.axes, NUMBERS), config_record(c, models[0].dt_s)
        self._arrays = allocate(self.axes, models[0], c)
        if config.device == "cpu":
            self._windows: CompiledWindows | TorchWindows = CompiledWindows(starts)
        else:
            from dehyst.adaptive.fleet.in_torch import TorchWindows

            self._windows = TorchWindows(starts, self._arrays, self._numbers, c.eviction == "fifo", config.device)
        self._learners = []
        for b, base in enumerate(models):
            window = self._windows.arrays(b) if self._windows.shares else starts[b]
            home = Home(self._numbers[b : b + 1], self._config, row_in(self._arrays, b, base, c), window)
            self._learners.append(Learner(base, c, home))
        self._rows = np.array([learner.parts.handle for learner in self._learners])
        self.held: dict[int, LssvmInverse] = {}
        self._cache: FleetSnapshot | None = None

    def step(self, seq: object, t_s: object, u_V: object, y_um: object, present: object = True) -> IntArray:
        """Take one sample of each axis that is ``present``; arguments are (B,) or one value for all.

        Returns (B,) results: the number of the outcome in ``OUTCOMES``, NO_SAMPLE for an axis that is not present.
        Never raises on the values of samples; raises InputError on shapes.
        """
        w = self._numbers["sample"]
        for name, given in (("seq", seq), ("t_s", t_s), ("u_V", u_V), ("y_um", y_um), ("present", present)):
            values = np.asarray(given)
            if values.shape not in ((), (self.axes,)):
                raise InputError(f"{name}: got shape {values.shape}, expected ({self.axes},) or one value for all")
            w[name] = values
        w["due"] = False
        axes = np.flatnonzero(w["present"])
        if axes.size:
            self._let_check(axes)
            rare = self._through(axes, TAKE)
            if rare or w["due"].any():
                self._cache = None
        return np.where(w["present"], w["outcome"], NO_SAMPLE)

    def warm(self) -> None:
        """Load or compile every step, so that no sample waits for the compiler."""
        self._through(np.arange(0), TAKE)
        still = np.zeros((self.axes, 1))
        self.snapshot().feedforward(still, still, still, self.memory())

    def _let_check(self, axes: IntArray) -> None:
        """Note whose control trial may begin: as many as the configuration allows, the longest waiting first."""
        waits, checks = self._numbers["intake"]["until_control"], self._numbers["sample"]["checks"]
        due = axes[waits[axes] <= 1]
        room = self.config.checks - int(self._numbers["intake"]["control"].sum())
        checks[:] = False
        checks[due[waits[due].argsort(kind="stable")[: max(room, 0)]]] = True

    def _through(self, axes: IntArray, stage: int) -> bool:
        """The samples of ``axes`` from ``stage`` on to their end. Returns whether one needed what is rare."""
        w, windows, share = self._numbers["sample"], self._windows, self._threads.share
        handles, here = windows.handles, windows.shares
        share(axes.size, go_on_all, axes, self._rows, handles, self._numbers, self._config, stage, here)
        at = w["stage"][axes]
        rare = axes[at >= TRIED].tolist()
        if not isinstance(windows, CompiledWindows):
            predicts, learns = axes[at == PREDICT], axes[at == WINDOW]
            if predicts.size:
                w["kernel_V"][predicts] = windows.predict(predicts)
                rare += [-1] * self._through(predicts, JUDGE)
            if learns.size:
                status = windows.learn(learns, self._rows, self._config)
                learnt, refused = OUTCOMES.index(gates.LEARNT), OUTCOMES.index(gates.NUMERICS)
                w["outcome"][learns] = np.where(status == ACCEPTED, learnt, refused)
                w["stage"][learns] = np.where(status == ILL_CONDITIONED, ILL, DONE)
                rare += learns[status == ILL_CONDITIONED].tolist()
                done = learns[status != ILL_CONDITIONED]
                self._arrays["counters"][done, w["outcome"][done]] += 1
        for axis in rare:
            if axis >= 0:
                self.learner_of(axis).go_on(int(w["stage"][axis]))
                self._take_window(axis)
        return bool(rare)

    def _take_window(self, axis: int) -> None:
        """Take over the window of an axis where its learner has stepped or replaced it."""
        window, windows = self._learners[axis].parts.window, self._windows
        if not windows.shares:
            windows.put(axis, window.window_arrays)
        elif window.window_arrays is not windows.arrays(axis):
            windows.put(axis, window.window_arrays)
            window.take_arrays(windows.arrays(axis))

    def load_axis(self, axis: int, state: StateDict, anew: bool = False) -> None:
        """Continue an axis from the state of a single learner of the same model and configuration.

        ``anew`` : its next sample is taken whatever its number.

        Raises ModelFileError, and leaves the axis as it is, where it is of another.
        """
        # First, because the settings of a damaged state may ask for any memory.
        if under("config.", state) != self.config.learner.state_dict():
            raise ModelFileError(f"axis {axis}: the state is of another configuration of the learner")
        given, base = LssvmInverse.from_state(under("base.", state)), self.bases[axis]
        if given.features != base.features or not np.array_equal(given.beta, base.beta):
            raise ModelFileError(f"axis {axis}: the state is of another model; load the one of this axis")
        learner = self._learners[axis]
        learner.resume(state)
        self._take_window(axis)
        if anew:
            learner.resync()
        self.held.pop(axis, None)
        self.freeze([axis], learner.frozen)

    def freeze(self, axes: Iterable[int], frozen: bool = True) -> None:
        """Stop the learning of some axes and keep what they serve; with ``frozen=False`` let them learn again.

        Their samples are still tracked and judged.
        """
        for axis in axes:
            learner = self.learner_of(axis)
            (learner.freeze if frozen else learner.thaw)()
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
            self._cache = self._pack()
        return self._cache

    def _pack(self) -> FleetSnapshot:
        n, windows, p = self._numbers, self._windows.samples(), self._arrays["beta"].shape[1]
        sizes, (d, most) = np.array([base.packed[1] for base in self.bases]), windows["scaled"].shape[1:]
        length = max(17 + int(sizes[0, :3].sum()) + 2 * p + d + (1 + d) * most, *(b.packed[0].size for b in self.bases))
        packed, counts = np.empty((self.axes, length)), np.empty(sizes.shape, dtype=np.int64)
        linear, parts = np.empty((self.axes, 2 + p)), (windows[i] for i in ("V", "F", "C", "scaled", "inverse_widths"))
        self._threads.share(self.axes, _pack, self._rows, n, *parts, DOMAIN_MARGIN, packed, counts, linear)
        seq, valid = n["intake"]["gates"]["seq"].copy(), n["judgement"]["valid"].copy()
        # Where a gap or a fault is open, or the identified model is served, the model is made one by one.
        alone = n["intake"]["trial"] | n["intake"]["missing"] | n["judgement"]["fallback"]
        one_by_one = {axis: self.learner_of(axis).snapshot() for axis in np.flatnonzero(alone).tolist()}
        for axis, model in (one_by_one | self.held).items():
            row, of = model.packed
            packed[axis, : row.size], counts[axis] = row, of
            linear[axis] = model.features.gain, model.features.offset_um, *model.beta
            seq[axis], valid[axis] = model.seq, model.valid
        return FleetSnapshot(self.bases, seq, valid, linear, packed, counts, self._threads)

    def memory(self) -> FloatArray:
        """(B, m) hysteresis memory with which each axis' served model goes on from its last sample."""
        n, identified = self._numbers, self._numbers["judgement"]["fallback"].copy()
        for axis, model in self.held.items():
            moved = not np.array_equal(self._arrays["frames"][axis, 1, :3], model.features.arrays.frame)
            identified[axis] = moved and model.features == self.bases[axis].features
        out: FloatArray = np.empty_like(self._arrays["memory"])
        memories_now(self._rows, n, identified, out)
        alone = n["intake"]["hold"] | n["intake"]["trial"] | ~n["intake"]["track"]["begun"]
        for axis in np.flatnonzero(alone).tolist():
            learner = self._learners[axis]
            kept = learner.memory_for(self.model_of(axis))
            out[axis] = learner.memory() if kept is None else kept
        return out

    # ---- reports

    @property
    def apart(self) -> set[int]:
        """Axes with something rare under way, in which their samples need more than the compiled order."""
        front = self._numbers["intake"]
        rare = front["lost"] | ~front["track"]["begun"] | self._numbers["sample"]["heals"]
        for name in ("hold", "trial", "control", "missing", "proven", "proven_past"):
            rare = rare | front[name]
        return set(np.flatnonzero(rare).tolist())

    def learner_of(self, axis: int) -> Learner:
        """The learner of an axis, to look into."""
        learner = self._learners[axis]
        learner.look_again()
        if not self._windows.shares:
            learner.parts.window.take_arrays(self._windows.arrays(axis))
        return learner

    def outcomes(self) -> IntArray:
        """(B, outcomes) samples by outcome, in the order of ``OUTCOMES``."""
        counters: IntArray = self._arrays["counters"].copy()
        return counters

    def rms_error_pct(self) -> FloatArray:
        """(B,) rms error of the last 0.1 s, percent of the voltage span."""
        mean_V2 = self._numbers["judgement"]["short_V2"]
        return np.asarray(100.0 * np.sqrt(mean_V2) / self._numbers["fixed"]["span_V"], dtype=np.float64)

    def troubles(self) -> dict[int, str]:
        """Names of what keeps axes from learning, by axis; see `Learner.trouble`."""
        tried = np.flatnonzero(self._numbers["intake"]["trial"]).tolist()
        return {axis: name for axis in tried if (name := self._learners[axis].trouble)}
