"""One ordinary sample of each axis, in compiled loops over the axes: intake, then what it teaches.

The rules are the single learner's own functions, on records in place of its dataclasses (`adaptive.compiled.shared`).
What is written here is their order, as in `Intake.take`, `Track.advance` and `Learner.teach`. A sample that is not an
ordinary one changes nothing and is left to a single learner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import compiled, dot
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureArrays, advance, fill
from dehyst.adaptive.inverse_model import LssvmInverse, mean_of, track_memory, unpacked
from dehyst.adaptive.online import gates, intake, learner
from dehyst.adaptive.online import kernel_window as window
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.drift import RestCreep, update
from dehyst.adaptive.online.gates import LEARNT, PASSED, REASONS, AdmissionState
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED
from dehyst.adaptive.online.kernel_window import KernelShare
from dehyst.adaptive.online.kernel_window import due as window_due
from dehyst.adaptive.online.learner import MARK_S, REFERENCE_S, Judgement, Learner
from dehyst.adaptive.online.sensor_trust import CONFIRMED, STILL_STEPS, Following
from dehyst.adaptive.online.track import answers, drive_V
from dehyst.adaptive.smoothing import smooth_one
from dehyst.adaptive.types import BoolArray, FloatArray, IntArray, Sample, StateDict, parted
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import COUNT, ILL_CONDITIONED, WindowArrays, arrays_of

# --- The state of a fleet: the entries of a single learner's state, with one row for each axis.
#
# An axis is kept here while its learner is *ordinary* (`Parts.ordinary`): readings are trusted and nothing is in
# doubt. Numbers are in records that have the names of the single learner's dataclasses, so that its functions work on
# both (`adaptive.compiled.shared`). What an ordinary step neither reads nor writes stays with the axis as it came.


#: Results of a sample, by their number in a fleet.
OUTCOMES: Final = (LEARNT, PASSED, *REASONS)
#: Estimates of the filter that an ordinary step keeps, by their row; see `adaptive.online.learner.Parts`.
MARKS: Final = ("mark", "next_mark")

#: Arrays by their name in a learner's state.
_ARRAYS: Final = {
    "x": "front.track.smoother.x", "ring": "front.track.smoother.ring", "drive_x": "front.track.drive.x",
    "drive_ring": "front.track.drive.ring", "voltages": "front.track.u_V",
    "rates": "front.track.rates", "known": "front.known", "readings": "front.track.y_um", "good": "front.track.good",
    "motion": "front.track.motion", "memory": "front.track.memory",
    "frozen_memory": "front.track.frozen_memory", "beta": "filter.beta", "references": "references",
    "covariance": "filter.covariance", "domain": "domain", "point": "point", "born": "window.born",
}  # fmt: skip
#: Numbers of an ordinary learner that are the same as others.
_ALIASES: Final = {
    "front.reckoned_seq": "front.gates.seq", "front.track.drive.count": "front.track.smoother.count",
    "front.track.features.gain": "front.track.served.gain",
    "front.track.features.offset_um": "front.track.served.offset_um",
}  # fmt: skip
#: Samples by outcome, by their names in a learner's state.
_COUNTERS: Final = tuple(f"counters.{name}" for name in OUTCOMES)
#: Numbers beside those of a learner; see `Rows`.
_OWN: Final[StateDict] = {"delay_count": 0, "past_count": 0, "past_written": 0}


def _numbers(state: StateDict) -> StateDict:
    return {name: value for name, value in state.items() if isinstance(value, bool | int | float)}


def _record(numbers: StateDict) -> np.dtype[Any]:
    """The record that holds flat numbers, nested by their names."""
    fields = parted(numbers).items()
    return np.dtype([(name, type(of[""]) if "" in of else _record(of)) for name, of in fields], align=True)


def _leaves(kind: np.dtype[Any], group: str = "", at: int = 0) -> Iterator[tuple[str, np.dtype[Any], int]]:
    """Flat names, kinds and places of what is in a nested record, in the order of the numbers that it was made of."""
    for name, (inner, offset, *_) in (kind.fields or {}).items():
        if inner.names is None:
            yield group + name, inner, at + offset
        else:
            yield from _leaves(inner, f"{group}{name}.", at + offset)


def _flat(records: Any) -> Any:
    """The same records by flat names: a view."""
    names, kinds, places = zip(*_leaves(records.dtype), strict=True)
    size = records.dtype.itemsize
    return records.view(np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": size}))


def _records(rows: Sequence[StateDict], like: StateDict) -> Any:
    """A record for each of ``rows``, flat numbers, of the names and kinds of ``like``."""
    records = np.zeros(len(rows), _record(_numbers(like)))
    flat = _flat(records)
    flat[:] = [tuple(row[name] for name in flat.dtype.names) for row in rows]
    return records


class Rows(NamedTuple):
    """What changes: the first index is the axis. Names are those of the single learner, but for:

    numbers : a record for each axis, nested as the names of a learner's state are. frames : (B, 3) offset, 1/gain and
    dead band of the frame that is served. marks : (B, 2, 1 + p, p) estimates and covariances, see ``MARKS``. basis :
    (B, p) of the instant to learn. delay : (B, D + 2, p) ring of past estimates; one more than is looked at, so that
    the last can be taken back. pasts : (B, 2, ...) known places of the stage, the older one first: motion, voltage
    before, voltages and readings over the lag, memory, as of `adaptive.online.track.Past`; past_from : voltages written
    before each; past_voltages : ring of all voltages.
    counters : (B, OUTCOMES).
    """

    numbers: Any
    x: FloatArray
    ring: FloatArray
    drive_x: FloatArray
    drive_ring: FloatArray
    voltages: FloatArray
    rates: FloatArray
    known: FloatArray
    readings: FloatArray
    good: BoolArray
    motion: FloatArray
    memory: FloatArray
    frozen_memory: FloatArray
    frames: FloatArray
    beta: FloatArray
    covariance: FloatArray
    marks: FloatArray
    references: FloatArray
    delay: FloatArray
    domain: FloatArray
    basis: FloatArray
    point: FloatArray
    born: IntArray
    pasts: FloatArray
    past_voltages: FloatArray
    past_from: IntArray
    counters: IntArray


class Fixed(NamedTuple):
    """What does not change. config : one record. axis (B,) : a record for each axis. features (B, ...) : of the
    identified models. beta, walks, bursts (B, p) : of them and their filters. models,
    sizes (M, ...) : M distinct identified models as `LssvmInverse.packed` has them. The others are the smoother's."""

    config: Any
    axis: Any
    features: FeatureArrays
    beta: FloatArray
    walks: FloatArray
    bursts: FloatArray
    models: FloatArray
    sizes: IntArray
    transition: FloatArray
    gain: FloatArray
    lag_gains: FloatArray
    output_scale: FloatArray


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


def fixed_of(bases: Sequence[LssvmInverse], config: LearnerConfig, templates: Sequence[Learner]) -> Fixed:
    """The constants of a fleet; ``templates`` : for each axis a learner of its model, frame aside."""
    parts, step_s, dt_s = templates[0].parts, float(templates[0].parts.filter.step_s), float(bases[0].dt_s)
    steps = {"dt_s": dt_s, "step_s": step_s, "check_s": float(parts.check_s), "check_every": parts.check_every,
             "mark_every": max(1, round(MARK_S / step_s)), "reference_every": max(1, round(REFERENCE_S / step_s)),
             "window_every": config.window_every,
             "fifo": config.eviction == "fifo"}  # fmt: skip
    settings = replace(config, admission=config.admission.at(dt_s)).state_dict() | steps
    axes, numbers, shape = [], distinct(bases), config.envelope.shape
    for base, template, number in zip(bases, templates, numbers, strict=True):
        f = base.features
        # The identified kernel part is allowed on top of the linear one, which depends on the frame.
        reach_V = template.parts.allowed_V - shape * drive_V(template.base)
        axes.append({
            "middle_um": 0.5 * (f.y_max_um + f.y_min_um), "range_um": f.y_max_um - f.y_min_um, "span_V": base.span_V,
            "drive_V": drive_V(base), "tells": answers(base),
            "allowed_V": shape * drive_V(base) + reach_V if f.linear else 0.0,
            "model": number,
        })  # fmt: skip
    models = [bases[numbers.index(number)].packed for number in range(max(numbers) + 1)]
    packed = np.zeros((len(models), max(row.size for row, _ in models)))
    for row, (model, _) in zip(packed, models, strict=True):
        row[: model.size] = model
    walks, bursts = zip(*(template.parts.filter.variances for template in templates), strict=True)
    smoother = parts.intake.smoother
    return Fixed(
        _records([settings], LearnerConfig().state_dict() | steps),
        _records(axes, dict.fromkeys(axes[0], 0.0) | {"tells": False, "model": 0}),
        FeatureArrays(*map(np.array, zip(*(base.features.arrays for base in bases), strict=True))),
        np.array([base.beta for base in bases]),
        np.array(walks), np.array(bursts), packed, np.array([sizes for _, sizes in models]),
        *map(np.array, (smoother.transition, smoother.gain, smoother.lag_gains, smoother.scale)),
    )  # fmt: skip


def _ordinary(model: LssvmInverse, config: LearnerConfig) -> StateDict:
    """The state of a learner that has just got all that an ordinary one has."""
    learner, f = Learner(model, config), model.features
    # Not one more: with the next one a control trial may begin, which is none of what every one has.
    for k in range(learner.parts.intake.smoother.config.lag + 1):
        learner.handle(Sample(k, k * model.dt_s, 0.0, 0.5 * (f.y_min_um + f.y_max_um)))
    # A state that was read has its kinds of numbers, whatever was given.
    return Learner.from_state(learner.state_dict()).parts.state_dict(arrays=False) | {"frozen": False}


class FleetState:
    """The rows of all axes, and what else belongs to each."""

    def __init__(self, bases: Sequence[LssvmInverse], config: LearnerConfig, delay_steps: int) -> None:
        B, state = len(bases), _ordinary(bases[0], config)
        p, marks, lag = state["filter.beta"].size, len(MARKS), state["front.track.u_V"].size - 2
        likes = {name: state[path] for name, path in _ARRAYS.items()} | {
            "frames": np.zeros(3), "marks": np.zeros((marks, 1 + p, p)),
            "delay": np.zeros((delay_steps + 2, p)), "past_voltages": np.zeros(MOST_BRIDGED + 2), "basis": np.zeros(p),
            "past_from": np.zeros(2, dtype=np.int64), "counters": np.zeros(len(OUTCOMES), dtype=np.int64),
            "pasts": np.zeros((2, 4 + 2 * lag + state["front.track.memory"].size)),
        }  # fmt: skip
        numbers = {n: v for n, v in _numbers(state).items() if n not in _ALIASES and not n.startswith("counters.")}
        rows = {name: np.zeros((B, *like.shape), like.dtype) for name, like in likes.items()}
        self.rows = s = Rows(np.zeros(B, _record(numbers | _OWN)), **rows)
        #: Where the numbers of a learner's state are, then its arrays, (B, ...) each, and those of its past places.
        self._numbers = _flat(s.numbers)[list(numbers)]
        self._fields = {path: getattr(s, name) for name, path in _ARRAYS.items()}
        for j, mark in enumerate(MARKS):
            self._fields |= {f"{mark}.beta": s.marks[:, j, 0], f"{mark}.covariance": s.marks[:, j, 1:]}
        parts: dict[str, Any] = {
            "motion": slice(3), "u_before_V": 3, "lag_V": slice(4, 4 + lag), "lag_um": slice(4 + lag, 4 + 2 * lag),
            "memory": slice(4 + 2 * lag, None),
        }  # fmt: skip
        self._pasts = [{f"front.past{j}.{name}": s.pasts[:, j, part] for name, part in parts.items()} for j in (0, 1)]
        self._rest: list[StateDict] = [{} for _ in range(B)]

    def load(self, axis: int, state: StateDict) -> None:
        """Take the state of an ordinary learner, without the arrays of its window. Raises KeyError, ValueError."""
        rest, s = dict(state), self.rows
        row, served = s.numbers[axis], s.numbers["front"]["track"]["served"][axis]
        self._numbers[axis] = tuple(rest.pop(name) for name in self._numbers.dtype.names)
        s.counters[axis] = [rest.pop(name) for name in _COUNTERS]
        for alias in _ALIASES:
            del rest[alias]
        _take(self._fields, axis, rest)
        s.frames[axis] = served["offset_um"], 1.0 / served["gain"], served["dead_um"]
        delay = np.asarray(rest.pop("delay"), dtype=np.float64).reshape(-1, s.beta.shape[1])
        s.delay[axis, : len(delay)] = delay
        pasts = [j for j in range(2) if f"front.past{j}.u_V" in rest]
        voltages = [np.asarray(rest.pop(f"front.past{j}.u_V")) for j in pasts]
        row["delay_count"], row["past_count"] = len(delay), len(pasts)
        row["past_written"] = voltages[0].size if pasts else 0
        for j in pasts:
            _take(self._pasts[j], axis, rest)
            s.past_from[axis, j] = voltages[0].size - voltages[j].size
        if pasts:
            s.past_voltages[axis, : voltages[0].size] = voltages[0]
        self._rest[axis] = rest

    def read(self, axis: int) -> StateDict:
        """Inverse of ``load``."""
        s, row = self.rows, self.rows.numbers[axis]
        state = self._rest[axis] | _given(self._fields, axis)
        state |= zip(self._numbers.dtype.names, self._numbers[axis].item(), strict=True)
        state |= zip(_COUNTERS, s.counters[axis].tolist(), strict=True)
        state |= {alias: state[name] for alias, name in _ALIASES.items()}
        kept, taken = s.delay.shape[1] - 1, int(row["delay_count"])
        state["delay"] = s.delay[axis, np.arange(max(taken - kept, 0), taken) % (kept + 1)]
        ring, written = s.past_voltages[axis], int(row["past_written"])
        for j in range(int(row["past_count"])):
            state |= _given(self._pasts[j], axis)
            state[f"front.past{j}.u_V"] = ring[np.arange(s.past_from[axis, j], written) % ring.size]
        return state


def _take(fields: StateDict, axis: int, state: StateDict) -> None:
    """Move the entries of ``state`` to where they are in the rows."""
    for name, field in fields.items():
        given = np.asarray(state.pop(name))
        if given.shape != field.shape[1:]:
            raise ValueError(f"{name}: got shape {given.shape}, expected {field.shape[1:]}")
        field[axis] = given


def _given(fields: StateDict, axis: int) -> StateDict:
    """Inverse of `_take`: copies."""
    return {name: field[axis].copy() if field.ndim > 1 else field[axis].item() for name, field in fields.items()}


# --- Intake of a sample, and what it teaches.


#: In place of an outcome: no sample; the sample is due for learning; it is for a single learner from its intake on, or
#: from what it teaches on.
NO_SAMPLE: Final = -1
TEACHES: Final = -2
DOUBT: Final = -3
ODD: Final = -4

# Compiled code knows methods by plain names only. Fields of a record are read as attributes, as those of the single
# learner's dataclasses, and written as items.
_judge, _is_valid, _falls_back = Judgement.take, Judgement.decide, Judgement.choose
_follow, _rest_shift_um, _leave_rest = Following.take, RestCreep.shift_um, RestCreep.leave
_note_taken, _note_step, _count_again = AdmissionState.take, AdmissionState.step, Following.count_again
_forget_slopes, _weigh = Following.forget_slopes, KernelShare.take
_FROZEN, _OUTLIER, _NUMERICS, _SATURATED, _UNEXCITED, _LEARNT = (
    OUTCOMES.index(name)
    for name in (gates.FROZEN, gates.OUTLIER, gates.NUMERICS, gates.SATURATED, gates.UNEXCITED, gates.LEARNT)
)


#: A sample of an axis, and what is made of it. controls : whether the control trial of the axis may begin now.
#: outcome : of the sample, or a number from above. learns : whether the window is to make a step, of target_V.
SAMPLE: Final = np.dtype([
    ("seq", np.int64), ("t_s", np.float64), ("u_V", np.float64), ("y_um", np.float64), ("present", np.bool_),
    ("controls", np.bool_), ("outcome", np.int64), ("learns", np.bool_),
    ("target_V", np.float64),
], align=True)  # fmt: skip


@compiled
def _number_of(outcome: str) -> int:
    for i in range(len(OUTCOMES)):
        if OUTCOMES[i] == outcome:
            return i
    return NO_SAMPLE


@compiled
def _map(c: Fixed, b: int, frames: FloatArray) -> FeatureArrays:
    """The feature map of an axis in a frame."""
    m = c.features
    return FeatureArrays(
        m.thresholds[b], m.arcs[b], m.retain[b], m.scale[b], m.kernel_plays[b], m.flags[b], frames[b],
    )  # fmt: skip


@compiled
def _remember_place(s: Rows, b: int, keep: bool) -> None:
    """The present place becomes the newest known one: after the last, or with ``keep`` in its stead."""
    r, slots, lag = s.numbers[b], s.voltages.shape[1], s.voltages.shape[1] - 2
    at = r.past_count - 1 if keep else min(r.past_count, 1)
    if r.past_count == 2:
        s.pasts[b, 0], s.past_from[b, 0] = s.pasts[b, 1], s.past_from[b, 1]
    past, first = s.pasts[b, at], r.front.track.smoother.count - lag
    past[:3], past[3], past[4 + 2 * lag :] = s.motion[b], s.voltages[b, (first - 1) % slots], s.memory[b]
    for i in range(lag):
        slot = (first + i) % slots
        past[4 + i], past[4 + lag + i] = s.voltages[b, slot], s.readings[b, slot]
    s.past_from[b, at], r["past_count"] = r.past_written, at + 1


@compiled
def _admit(s: Rows, c: Fixed, b: int, sample: Any) -> int:
    """`Intake.take` of an ordinary sample: TEACHES where it may go on, DOUBT, or the gate that refuses it."""
    front, f, a = s.numbers[b].front, c.axis[b], c.config[0].admission
    g, dt_s = front.gates, c.config[0].dt_s
    refused = gates.check_sample(a, g, sample, dt_s)
    if refused == "" and abs(sample.y_um - f.middle_um) > intake.FAR_OUT * f.range_um:
        refused = gates.OUT_OF_RANGE
    if refused != "":
        # A sample in its place whose reading cannot be used advances the place of the single learner.
        y_um, sample["y_um"] = sample.y_um, 0.0
        without = gates.check_sample(a, g, sample, dt_s)
        sample["y_um"] = y_um
        return DOUBT if without == "" else _number_of(refused)
    if sample.seq != g.seq + 1:
        return DOUBT
    gates.watch_voltage(g, sample.u_V)
    _note_taken(g, sample, 1)
    refused = gates.check_repeats(g, sample, f.span_V)
    innovation = (sample.y_um - s.x[b, 0]) / f.range_um
    slope, bend = s.drive_x[b, 1] * c.output_scale[1], s.drive_x[b, 2] * c.output_scale[2]
    known = g.since_start > a.settle and intake.is_known(s.known[b, 0], slope, bend)
    if refused != "" or (known and abs(innovation) > gates.surprise(a, g, f.span_V)):
        return DOUBT
    gates.watch_innovation(a, g, innovation)
    front["until_control"] -= 1
    return DOUBT if known and f.tells and front.until_control <= 0 and sample.controls else TEACHES


@compiled
def _advance(s: Rows, c: Fixed, b: int, u_V: float, y_um: float) -> None:
    """`Intake.advance`: one step of the smoother, and of the hysteresis memory in both frames."""
    r, slots = s.numbers[b], s.voltages.shape[1]
    front, smoother = r.front, r.front.track.smoother
    _note_step(front.gates)
    front["calm"] += 1
    s.past_voltages[b, r.past_written % s.past_voltages.shape[1]] = u_V
    r["past_written"] += 1
    if r.past_count > 0 and r.past_written - s.past_from[b, 0] > MOST_BRIDGED:
        # At rest nothing is checked, and the present place is as good as the past one.
        _remember_place(s, b, True)
    slot, motion = smoother.count % slots, s.motion[b]
    s.readings[b, slot], s.voltages[b, slot], s.good[b, slot] = y_um, u_V, True
    smooth_one(u_V, smoother.count, s.drive_x[b], s.drive_ring[b], c.transition, c.gain, c.lag_gains, motion)
    front.track["smooth_V"] = motion[0]
    s.rates[b, 0], s.rates[b, 1] = motion[1] * c.output_scale[1], motion[2] * c.output_scale[2]
    smooth_one(y_um, smoother.count, s.x[b], s.ring[b], c.transition, c.gain, c.lag_gains, motion)
    smoother["count"] += 1
    for i in range(3):
        motion[i] *= c.output_scale[i]
    advance(motion[0], s.memory[b], _map(c, b, s.frames))
    advance(motion[0], s.frozen_memory[b], _map(c, b, c.features.frame))


@compiled
def _instant(s: Rows, b: int) -> tuple[int, int, bool]:
    """The smoothed instant: its number and slot, and whether its readings are good."""
    slots = s.voltages.shape[1]
    now = s.numbers[b].front.track.smoother.count + 1 - slots
    return now, now % slots, s.good[b, now % slots] and s.good[b, (now - 1) % slots]


@compiled
def take(lo: int, hi: int, axes: IntArray, s: Rows, c: Fixed, w: Any) -> None:
    """Intake of one sample of each of ``axes``, in records as `SAMPLE`; the first gates of what it teaches."""
    config, slots = c.config[0], s.voltages.shape[1]
    for k in range(lo, hi):
        b = axes[k]
        kept, sample = s.numbers[b : b + 1].copy(), w[b]
        sample["outcome"] = _admit(s, c, b, sample)
        if sample.outcome != TEACHES:
            s.numbers[b] = kept[0]
            continue
        _advance(s, c, b, sample.u_V, sample.y_um)
        now, at, good = _instant(s, b)
        motion = s.motion[b]
        refused = gates.check_pair(config.admission, s.voltages[b, at], s.voltages[b, (now - 1) % slots], motion[0])
        if gates.settling(config.admission, s.numbers[b].front.gates):
            refused = gates.SETTLING
        elif not good:
            refused = gates.GLITCH
        if now % config.filter_every != 0 or (refused != "" and refused != gates.SATURATED):
            sample["outcome"] = _number_of(refused if refused != "" else gates.PASSED)
            continue
        fill(motion[0], motion[1], motion[2], s.memory[b], _map(c, b, s.frames), s.basis[b], s.point[b])


@compiled
def teach(lo: int, hi: int, axes: IntArray, kernel_V: FloatArray, s: Rows, c: Fixed, w: Any) -> None:
    """What the samples of ``axes`` teach, all but the steps of the windows; ``kernel_V`` : their predictions, V."""
    config, p, d = c.config[0], s.beta.shape[1], s.point.shape[1]
    basis, kernel, gain, row = np.empty(p), np.empty(d), np.empty(p), np.empty(p)
    for k in range(lo, hi):
        b = axes[k]
        t, r, f, h, motion = w[b], s.numbers[b], c.axis[b], s.basis[b], s.motion[b]
        now, at, _ = _instant(s, b)
        u, before = r.front.track.smooth_V, s.voltages[b, (now - 1) % s.voltages.shape[1]]
        saturated = gates.check_pair(config.admission, s.voltages[b, at], before, motion[0]) != ""
        kept = s.numbers[b : b + 1].copy()
        t["learns"] = False
        t["outcome"] = _SATURATED if saturated else _number_of(gates.PASSED)
        served, count = r.front.track.served, r.front.track.smoother.count
        rests = gates.at_rest(config.admission, r.front.gates, motion[0], count, f.range_um, config.dt_s)
        target = u - r.window.share * kernel_V[k]
        if not isfinite(target):
            t["outcome"] = _NUMERICS
            continue
        fill(motion[0], motion[1], motion[2], s.frozen_memory[b], _map(c, b, c.features.frame), basis, kernel)
        _, beta, inverse_widths, alpha, scaled, _ = unpacked(c.models[f.model], c.sizes[f.model])
        frozen_V = mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)
        if _finds_fault(s, c, b, h, target, u, frozen_V, saturated, now % config.check_every == 0):
            s.numbers[b] = kept[0]
            t["outcome"] = ODD
            continue
        if saturated:
            continue
        if r.frozen:
            t["outcome"] = _FROZEN
            continue
        left_V = u - dot(h, s.beta[b], p)
        said = update(
            config.drift, r.filter, s.beta[b], s.covariance[b], c.walks[b], c.bursts[b], f.span_V, config.step_s, h,
            target, not rests, gain, row,
        )  # fmt: skip
        if said == "outlier":
            t["outcome"] = _OUTLIER
            continue
        if rests:
            shift_um = _rest_shift_um(r.rest, s.beta[b, 0], u, f.span_V, f.range_um, config.step_s, config.creep_s)
            served["offset_um"] += shift_um
            s.frames[b, 0] = served.offset_um
        else:
            _leave_rest(r.rest)
            _weigh(r.window, kernel_V[k], left_V, config.step_s)
        t["outcome"] = _UNEXCITED if rests else _LEARNT
        if not rests and r.judgement.valid:
            for i in range(2):
                s.known[b, 2, i] = max(s.known[b, 2, i], abs(s.rates[b, i]))
            for i in range(3):
                s.domain[b, 2 * i] = min(s.domain[b, 2 * i], motion[i])
                s.domain[b, 2 * i + 1] = max(s.domain[b, 2 * i + 1], motion[i])
        if not rests and window_due(now // config.filter_every, config.window_every):
            t["learns"], t["target_V"] = True, u - dot(h, s.beta[b], p)


@compiled
def _finds_fault(
    s: Rows, c: Fixed, b: int, h: FloatArray, target: float, u: float, frozen_V: float, saturated: bool, checks: bool
) -> bool:
    """Errors of the models as they were served, all checks, and marks (`Parts.judge`, `Learner._check`).

    True where the learner has to return to an earlier estimate, to the identified model, or to a trial of the sensor.
    """
    r, f, config, p = s.numbers[b], c.axis[b], c.config[0], h.size
    j, span_V, size = r.judgement, f.span_V, s.delay.shape[1]
    s.delay[b, r.delay_count % size] = s.beta[b]
    r["delay_count"] += 1
    served_V = dot(h, s.delay[b, max(r.delay_count - size + 1, 0) % size], p)
    _judge(j, target - served_V, u - frozen_V, config.step_s)
    _is_valid(j, config.valid_enter * span_V, config.valid_leave * span_V)
    before = j.fallback
    r.events["fallbacks"] += _falls_back(j, config.fallback_floor * span_V, config.step_s) and not before
    fault = j.fallen_s > learner.ROLLBACK_S
    confirmed = places = False
    if checks and f.tells and not saturated:
        follows, fastest_V_per_s = r.front.following, config.envelope.drift_per_s * f.drive_V
        known = intake.is_known(s.known[b, 0], s.rates[b, 0], s.rates[b, 1])
        judges = known and r.front.credit > 0
        p_V = u - target + dot(h, s.references[b, 0], p)
        odd = _follow(follows, u, p_V, f.drive_V, config.check_s, fastest_V_per_s)
        if not known:
            _forget_slopes(follows)
        fault = fault or (odd and judges) or follows.still >= STILL_STEPS
        confirmed = judges and (follows.good >= CONFIRMED or r.past_count == 0)
        # `Intake.follow`: a model that may not judge confirms nothing, but notes where the readings have moved.
        places = confirmed or (not judges and follows.steps == 0 and follows.still == 0)
    if fault:
        return True
    # A good estimate becomes the next mark, and the next reference; see `Parts.judge`.
    good = j.short_V2 < (0.5 * config.valid_enter * span_V) ** 2
    if good and j.judged % config.mark_every == 0:
        s.marks[b, 0] = s.marks[b, 1]
        s.marks[b, 1, 0], s.marks[b, 1, 1:] = s.beta[b], s.covariance[b]
    if good and j.judged % config.reference_every == 0:
        s.references[b, 0], s.references[b, 1] = s.references[b, 1], s.beta[b]
        s.known[b, 0], s.known[b, 1] = s.known[b, 1], s.known[b, 2]
    if places:
        if confirmed:
            _count_again(r.front.following)
        _remember_place(s, b, False)
    return False


@compiled
def memory_now(s: Rows, c: Fixed, frozen: BoolArray, out: FloatArray) -> None:
    """(B, m) memory at the last reading: the smoothed one, carried along the readings since; see `Track.memory_now`."""
    slots, lag = s.readings.shape[1], s.readings.shape[1] - 2
    readings = np.empty(lag)
    for b in range(out.shape[0]):
        for i in range(lag):
            readings[i] = s.readings[b, (s.numbers[b].front.track.smoother.count - lag + i) % slots]
        out[b] = s.frozen_memory[b] if frozen[b] else s.memory[b]
        track_memory(readings, out[b], _map(c, b, c.features.frame if frozen[b] else s.frames))


# --- The windows of all axes on the processor: the single learner's own compiled steps, in loops over the axes.
#
# A step of a window reads and writes one triangle once, which operations of torch cannot do; that is why the
# processor has this form. Some threads share the axes. Each axis is stepped by one of them, so the result does not
# depend on their number.


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


@compiled
def _predict(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, out: FloatArray) -> None:
    for k in range(lo, hi):
        out[k] = steps.predict(arrays_of(handles[axes[k]]), s.point[axes[k]])


@compiled
def learn(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, c: Fixed, w: Any, out: IntArray) -> None:
    """`ResidualWindow.learn` of each axis."""
    fifo = c.config[0].fifo
    for k in range(lo, hi):
        b = axes[k]
        A, r = arrays_of(handles[b]), s.numbers[b].window
        empty = A.C[COUNT] == 0
        status = window.learn(A, r, s.point[b], w[b].target_V, s.born[b], fifo)
        # An empty window has nothing that a new factorisation could mend.
        out[k] = ws.BAD_INPUT if empty and status == ILL_CONDITIONED else status


class CompiledWindows:
    """Windows of B axes, stepped by compiled code. ``axes`` (k,) are numbers of axes, without repeats."""

    #: Whether ``arrays`` gives the state itself, not a copy.
    shares = True

    def __init__(self, rows: Rows, fixed: Fixed, starts: Sequence[WindowArrays], threads: Threads) -> None:
        """``starts`` : what each window begins as."""
        self._rows, self._fixed, self._threads = rows, fixed, threads
        #: What windows begin as whose matrices are not written yet. It would take seconds to write all of them at once.
        self.unwritten = dict(enumerate(starts))
        small = (name for name in WindowArrays._fields if name not in ("P", "R", "kept"))
        self._all = {name: np.array([getattr(start, name) for start in starts]) for name in small}
        # They take memory as they are written: ``kept``, in the inverse form, never.
        self._all["kept"] = np.zeros((len(starts), starts[0].kept.size))
        matrices = np.empty((len(starts), 2, *starts[0].P.shape))
        self._views = [
            WindowArrays(*pair, **{name: field[axis] for name, field in self._all.items()})
            for axis, pair in enumerate(matrices)
        ]
        for view in self._views:
            ws.forget_kept(view)
        self._handles = np.array([ws.handle_of(view) for view in self._views])

    def write(self, axes: Iterable[int]) -> None:
        """Write the matrices that the windows of ``axes`` begin with, where they are not yet. No step before that."""
        for axis in self.unwritten.keys() & axes:
            start = self.unwritten.pop(axis)
            self._views[axis].P[...], self._views[axis].R[...] = start.P, start.R

    def arrays(self, axis: int) -> WindowArrays:
        """The solver's state of an axis: views, stepped in place by whoever has them, after `write`."""
        return self._views[axis]

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver; nothing where it is the axis' own."""
        if arrays is not self._views[axis]:
            self.unwritten.pop(axis, None)
            ws.take_over(self._views[axis], arrays)

    def samples(self) -> dict[str, FloatArray]:
        """The windows' arrays by name; views."""
        return self._all

    def predict(self, axes: IntArray) -> FloatArray:
        """(k,) kernel parts, V, at the present points of ``axes``."""
        out = np.empty(axes.size)
        self._threads.share(axes.size, _predict, self._handles, axes, self._rows, out)
        return out

    def learn(self, axes: IntArray, w: Any) -> IntArray:
        """(k,) status of one step of each window with its record of ``w``; see `ResidualWindow.learn`."""
        self.write(axes.tolist())
        out = np.empty(axes.size, dtype=np.int64)
        self._threads.share(axes.size, learn, self._handles, axes, self._rows, self._fixed, w, out)
        return out
