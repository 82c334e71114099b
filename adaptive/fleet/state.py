"""The state of a fleet: the entries of a single learner's state, with one row for each axis.

An axis is kept here while its learner is *ordinary* (`Parts.ordinary`): readings are trusted and nothing is in doubt.
Numbers are in records that have the names of the single learner's dataclasses, so that its functions work on both
(`adaptive.compiled.shared`). What an ordinary step neither reads nor writes stays with the axis as it came.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive.errors import InputError
from adaptive.features import FeatureArrays
from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.dead_reckoning import answers, drive_V, mean_slope
from adaptive.online.drift import DriftState, RestCreep
from adaptive.online.gates import LEARNT, PASSED, REASONS, AdmissionState
from adaptive.online.glitch_or_jump import MOST_BRIDGED
from adaptive.online.learner import MARK_S, Judgement, Learner
from adaptive.online.sensor_trust import Following
from adaptive.types import BoolArray, FloatArray, IntArray, StateDict

#: Results of a sample, by their number in a fleet.
OUTCOMES: Final = (LEARNT, PASSED, *REASONS)
#: Parts of a past place, in the order of `adaptive.online.track.Past`.
PAST: Final = ("motion", "u_before_V", "lag_V", "lag_um", "memory")
#: Estimates of the filter that an ordinary step keeps, by their row; see `adaptive.online.learner.Parts`.
MARKS: Final = ("mark", "next_mark", "confirmed0", "confirmed1")

#: Records by their path in a learner's state.
_GROUPS: Final[dict[str, tuple[str, Any]]] = {
    "gates": ("front.gates", AdmissionState()),
    "following": ("front.following", Following()),
    "judgement": ("judgement", Judgement(0.0, 0.0, 0.0, 0.0)),
    "rest": ("rest", RestCreep()),
    "filter": ("filter", DriftState()),
}
#: Single numbers by their path, and their kinds.
_NUMBERS: Final[dict[str, tuple[str, type]]] = {
    "count": ("front.track.smoother.count", int),
    "gain": ("front.track.served.gain", float),
    "offset_um": ("front.track.served.offset_um", float),
    **{name: (f"front.{name}", int) for name in ("calm", "credit", "until_control", "look_from")},
    **{name: (f"window.{name}", int) for name in ("clock", "changed", "next")},
    "kernel_variance": ("window.kernel_variance", float),
    "fallbacks": ("events.fallbacks", int),
    **{name: (name, float) for name in ("rail_s", "left_s")},
    "frozen": ("frozen", bool),
}
#: Arrays by their path.
_ARRAYS: Final = {
    "x": "front.track.smoother.x", "ring": "front.track.smoother.ring", "voltages": "front.track.u_V",
    "readings": "front.track.y_um", "good": "front.track.good", "motion": "front.track.motion",
    "memory": "front.track.memory", "frozen_memory": "front.track.frozen_memory", "beta": "filter.beta",
    "covariance": "filter.covariance", "domain": "domain", "point": "point", "born": "window.born",
    "own": "window.own_weights", "mark_ages": "mark_ages", "confirmed_ages": "confirmed_ages",
}  # fmt: skip


def _kinds(values: dict[str, Any]) -> np.dtype[Any]:
    """The record that holds the numbers of nested ``values``."""
    fields: list[tuple[str, Any]] = []
    for name, value in values.items():
        if isinstance(value, dict):
            fields.append((name, _kinds(value)))
        elif isinstance(value, bool | int | float):
            fields.append((name, type(value)))
    return np.dtype(fields, align=True)


def _fill(record: Any, values: dict[str, Any]) -> None:
    """Write nested ``values`` into an array of one record."""
    for name in record.dtype.names:
        value = values[name]
        if isinstance(value, dict):
            _fill(record[name], value)
        else:
            record[name] = value


#: confirmed : whether the last check has confirmed that the readings follow the drive. The others: see `Rows`.
_OWN: Final = {"delay_count": 0, "past_count": 0, "past_written": 0, "confirmed": False}
_ROW: Final = _kinds(
    {group: asdict(example) for group, (_, example) in _GROUPS.items()}
    | {name: kind() for name, (_, kind) in _NUMBERS.items()}
    | _OWN
)
_STEPS: Final = {"dt_s": 0.0, "step_s": 0.0, "check_s": 0.0, "check_every": 0, "mark_every": 0}
_CONFIG: Final = _kinds(asdict(LearnerConfig()) | _STEPS)
_AXIS: Final = _kinds(
    dict.fromkeys(
        ("middle_um", "range_um", "span_V", "drive_V", "slope_V_per_um", "allowed_V", "a_scale"), 0.0
    ) | {"model": 0, "tells": False}
)  # fmt: skip


class Rows(NamedTuple):
    """What changes: the first index is the axis. Names are those of the single learner, but for:

    frames : (B, 3) offset, 1/gain and dead band of the frame that is served. marks, mark_covariances : (B, 4, ...), see
    ``MARKS``. delay : (B, D + 2, p) ring of past estimates; one more than is looked at, so that the last can be taken
    back. past_... : (B, 2, ...) known places of the stage, the older one first; past_from : voltages written before
    each; past_voltages : ring of all voltages. counters : (B, OUTCOMES).
    """

    numbers: Any
    x: FloatArray
    ring: FloatArray
    voltages: FloatArray
    readings: FloatArray
    good: BoolArray
    motion: FloatArray
    memory: FloatArray
    frozen_memory: FloatArray
    frames: FloatArray
    beta: FloatArray
    covariance: FloatArray
    marks: FloatArray
    mark_covariances: FloatArray
    mark_ages: IntArray
    confirmed_ages: IntArray
    delay: FloatArray
    domain: FloatArray
    point: FloatArray
    born: IntArray
    own: FloatArray
    past_motion: FloatArray
    past_u_before_V: FloatArray
    past_lag_V: FloatArray
    past_lag_um: FloatArray
    past_memory: FloatArray
    past_voltages: FloatArray
    past_from: IntArray
    counters: IntArray


class Fixed(NamedTuple):
    """What does not change. config : one record. axis (B,) : a record for each axis. features (B, ...) : of the
    identified models. beta, walks, bursts (B, p) : of them and their filters. models, sizes (M, ...) : M distinct
    identified models as `LssvmInverse.packed` has them. The others are the smoother's."""

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
    parts, step_s, dt_s = templates[0].parts, templates[0].parts.filter.step_s, bases[0].dt_s
    settings = np.zeros(1, _CONFIG)
    steps = {"dt_s": dt_s, "step_s": step_s, "check_s": parts.check_s, "check_every": parts.check_every,
             "mark_every": max(1, round(MARK_S / step_s))}  # fmt: skip
    _fill(settings, asdict(config) | {"admission": asdict(config.admission.at(dt_s))} | steps)
    axis, numbers = np.zeros(len(bases), _AXIS), distinct(bases)
    for row, base, template, number in zip(axis, bases, templates, numbers, strict=True):
        f = base.features
        # The identified kernel part is allowed on top of the linear one, which depends on the frame.
        reach_V = template.parts.allowed_V - config.envelope.shape * drive_V(template.base)
        row["middle_um"], row["range_um"] = 0.5 * (f.y_max_um + f.y_min_um), f.y_max_um - f.y_min_um
        row["span_V"], row["drive_V"] = base.span_V, drive_V(base)
        row["slope_V_per_um"], row["tells"] = mean_slope(base), answers(base)
        row["allowed_V"] = config.envelope.shape * drive_V(base) + reach_V if f.linear else 0.0
        row["a_scale"], row["model"] = f.a_scale_um_per_s2, number
    models = [bases[numbers.index(number)].packed for number in range(max(numbers) + 1)]
    packed = np.zeros((len(models), max(row.size for row, _ in models)))
    for row, (model, _) in zip(packed, models, strict=True):
        row[: model.size] = model
    walks, bursts = zip(*(template.parts.filter.variances for template in templates), strict=True)
    smoother = parts.intake.smoother
    return Fixed(
        settings, axis, FeatureArrays(*map(np.array, zip(*(base.features.arrays for base in bases), strict=True))),
        np.array([base.beta for base in bases]), np.array(walks), np.array(bursts), packed,
        np.array([sizes for _, sizes in models]),
        *map(np.array, (smoother.transition, smoother.gain, smoother.lag_gains, smoother.scale)),
    )  # fmt: skip


class FleetState:
    """The rows of all axes, and what else belongs to each."""

    def __init__(self, c: Fixed, window: int, delay_steps: int) -> None:
        B, p = c.beta.shape
        slots, order = c.lag_gains.shape[0] + 1, c.gain.size
        K, A, M, _, d = c.sizes[0, :5].tolist()
        m, lag, marks = K + A + M + (A > 0), slots - 2, len(MARKS)
        floats: dict[str, tuple[int, ...]] = {
            "x": (order,), "ring": (lag + 1, 4), "voltages": (slots,), "readings": (slots,), "motion": (3,),
            "memory": (m,), "frozen_memory": (m,), "frames": (3,), "beta": (p,), "covariance": (p, p),
            "marks": (marks, p), "mark_covariances": (marks, p, p), "delay": (delay_steps + 2, p), "domain": (6,),
            "point": (d,), "own": (window,), "past_motion": (2, 3), "past_u_before_V": (2,), "past_lag_V": (2, lag),
            "past_lag_um": (2, lag), "past_memory": (2, m), "past_voltages": (MOST_BRIDGED + 2,),
        }  # fmt: skip
        integers: dict[str, tuple[int, ...]] = {
            "born": (window,), "past_from": (2,), "mark_ages": (2,), "confirmed_ages": (2,),
            "counters": (len(OUTCOMES),),
        }  # fmt: skip
        self.rows = Rows(
            numbers=np.zeros(B, _ROW), good=np.zeros((B, slots), dtype=np.bool_),
            **{name: np.zeros((B, *shape)) for name, shape in floats.items()},
            **{name: np.zeros((B, *shape), dtype=np.int64) for name, shape in integers.items()},
        )  # fmt: skip
        self._dead_um = c.features.frame[:, 2]
        self._rest: list[StateDict] = [{} for _ in range(B)]

    def load(self, axis: int, state: StateDict) -> None:
        """Take the state of an ordinary learner, without the arrays of its window. Raises KeyError, ValueError."""
        rest, s = dict(state), self.rows
        row = s.numbers[axis : axis + 1]
        for group, (path, _) in _GROUPS.items():
            for name in row.dtype[group].names or ():
                row[group][name] = rest.pop(f"{path}.{name}")
        for name, (path, _) in _NUMBERS.items():
            row[name] = rest.pop(path)
        for name, path in _ARRAYS.items():
            _write(getattr(s, name), axis, rest.pop(path))
        s.counters[axis] = [rest.pop(f"counters.{name}") for name in OUTCOMES]
        s.frames[axis] = row["offset_um"][0], 1.0 / row["gain"][0], self._dead_um[axis]
        for j, mark in enumerate(MARKS):
            _write(s.marks[axis], j, rest.pop(f"{mark}.beta"))
            _write(s.mark_covariances[axis], j, rest.pop(f"{mark}.covariance"))
        delay = np.asarray(rest.pop("delay"), dtype=np.float64).reshape(-1, s.beta.shape[1])
        s.delay[axis, : len(delay)] = delay
        pasts = sorted({name.split(".")[1] for name in rest if name.startswith("front.past")})
        voltages = [np.asarray(rest.pop(f"front.{past}.u_V")) for past in pasts]
        row["delay_count"], row["past_count"], row["confirmed"] = len(delay), len(pasts), False
        row["past_written"] = voltages[0].size if pasts else 0
        for j, past in enumerate(pasts):
            for name in PAST:
                _write(getattr(s, f"past_{name}")[axis], j, rest.pop(f"front.{past}.{name}"))
            s.past_from[axis, j] = voltages[0].size - voltages[j].size
        if pasts:
            s.past_voltages[axis, : voltages[0].size] = voltages[0]
        self._rest[axis] = rest

    def read(self, axis: int) -> StateDict:
        """Inverse of ``load``."""
        state, s = dict(self._rest[axis]), self.rows
        row = s.numbers[axis]
        for group, (path, _) in _GROUPS.items():
            state |= {f"{path}.{name}": row[group][name].item() for name in row[group].dtype.names}
        state |= {path: row[name].item() for name, (path, _) in _NUMBERS.items()}
        state |= {path: getattr(s, name)[axis].copy() for name, path in _ARRAYS.items()}
        state |= {f"counters.{name}": int(n) for name, n in zip(OUTCOMES, s.counters[axis], strict=True)}
        for j, mark in enumerate(MARKS):
            state[f"{mark}.beta"] = s.marks[axis, j].copy()
            state[f"{mark}.covariance"] = s.mark_covariances[axis, j].copy()
        state["front.reckoned_seq"] = state["front.gates.seq"]  # an ordinary sample has a reading
        for name in ("gain", "offset_um"):
            state[f"front.track.features.{name}"] = state[f"front.track.served.{name}"]
        kept, taken = s.delay.shape[1] - 1, int(row["delay_count"])
        state["delay"] = s.delay[axis, np.arange(max(taken - kept, 0), taken) % (kept + 1)]
        ring, written = s.past_voltages[axis], int(row["past_written"])
        for j in range(int(row["past_count"])):
            state |= {f"front.past{j}.{name}": getattr(s, f"past_{name}")[axis, j].copy() for name in PAST}
            state[f"front.past{j}.u_V"] = ring[np.arange(s.past_from[axis, j], written) % ring.size]
        return state


def _write(rows: Any, at: int, value: object) -> None:
    given = np.asarray(value)
    if given.shape != rows[at].shape:
        raise ValueError(f"got shape {given.shape}, expected {rows[at].shape}")
    rows[at] = given
