"""The state of a fleet: the entries of a single learner's state, with one row for each axis.

An axis is kept here while its learner is *ordinary* (`Parts.ordinary`): readings are trusted and nothing is in doubt.
Numbers are in records that have the names of the single learner's dataclasses, so that its functions work on both
(`adaptive.compiled.shared`). What an ordinary step neither reads nor writes stays with the axis as it came.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureArrays
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.dead_reckoning import answers, drive_V
from dehyst.adaptive.online.gates import LEARNT, PASSED, REASONS
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED
from dehyst.adaptive.online.learner import MARK_S, REFERENCE_S, Learner
from dehyst.adaptive.types import BoolArray, FloatArray, IntArray, Sample, StateDict, parted

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
