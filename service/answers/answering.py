"""The answer to a query: which snapshot, which model, from which memory; then by the rules of
``service.answers.fallback``.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike

from adaptive.compiled import all_finite
from adaptive.state import Entry
from adaptive.types import FloatArray, InverseModel
from baselines.competition.champion import ChampionInverse
from service.answers.fallback import Rules, answer_safely
from service.answers.guard import Limits, check_domain, check_voltages
from service.answers.slices import Pace
from service.config.settings import AxisConfig
from service.protocol.errors import FieldError
from service.protocol.keys import AUTO
from service.protocol.model import StandIn
from service.protocol.query import MAX_PENDING, NEWEST, FeedforwardQuery, Pending, Trajectory
from service.protocol.samples import MAX_SEQ, check_finite

# --- The hysteresis memory that the service tracks from measured samples, for queries that bring none.


class MemoryTracker:
    """Collects samples between two snapshots and advances the memory of every model by them at once.

    Velocity and acceleration are backward differences; sample (k) pairs the motion at t_k with the voltage applied
    from t_k on. What is not finite is left out.
    """

    _rows: Annotated[
        list[tuple[float, float, float, float]], Entry("motion and voltage that wait", "µm, µm/s, µm/s², V", "*,4")
    ]
    _begun: Annotated[bool, Entry("whether a sample has come")]
    _seq: Annotated[int, Entry("number of the last sample, -1 for none", low=-1)]
    _y: Annotated[float, Entry("its displacement", "µm", finite=False)]
    _v: Annotated[float, Entry("its velocity", "µm/s", finite=False)]

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._rows = []
        self._begun = False
        self.forget()

    def forget(self) -> None:
        """Drop what waits, and begin the differences anew."""
        self._rows.clear()
        self._seq = -1
        self._y = math.nan
        self._v = math.nan

    def add(self, seq: int, u_V: float, y_um: float) -> None:
        """One sample in order: voltage in V, displacement in µm."""
        if not (math.isfinite(u_V) and math.isfinite(y_um)):
            return
        step_s = (seq - self._seq) * self._dt_s
        v = (y_um - self._y) / step_s if math.isfinite(self._y) else 0.0
        a = (v - self._v) / step_s if math.isfinite(self._v) else 0.0
        self._rows.append((y_um, v, a, u_V))
        self._seq, self._y, self._v = seq, y_um, v

    def advance(self, models: dict[str, InverseModel], memories: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """New memories by name after all that was added since the last call; the given ones are not changed."""
        if not self._rows:
            return memories
        y, v, a, u = np.array(self._rows).T.copy()
        self._rows.clear()
        advanced = {}
        for name, model in models.items():
            memory = memories[name]
            # Before the first samples the position of the stage is unknown.
            if not self._begun or memory.size != model.memory_size:
                memory = model.rest_memory(float(y[0]))
            after = model.track(y, v, a, u, memory)
            advanced[name] = after if np.isfinite(after).all() else memory
        self._begun = True
        return advanced


# --- Velocity and acceleration of a desired trajectory where the caller gives only displacement.


def derivatives(
    y_um: FloatArray, v_um_per_s: ArrayLike | None, a_um_per_s2: ArrayLike | None, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """(v, a), each (n,), µm/s and µm/s², of ``y_um`` (n,) with points ``dt_s`` apart.

    What is given is kept; what is not is taken by central differences, one-sided and of second order at the ends.
    A single point rests. Raises InputError on other lengths and on what is not finite.
    """
    n = y_um.size
    check_finite("y_um", y_um)

    def given(field: str, values: ArrayLike | None, of: FloatArray) -> FloatArray:
        if values is None:
            if n == 1:
                return np.zeros(1)
            slope: FloatArray = np.gradient(of, dt_s, edge_order=2 if n > 2 else 1)
            return slope
        array = np.atleast_1d(np.asarray(values, dtype=np.float64))
        if array.shape != y_um.shape:
            raise FieldError(field, f"shape {array.shape}", f"{y_um.shape}, that of y_um")
        check_finite(field, array)
        return array

    v = given("v_um_per_s", v_um_per_s, y_um)
    return v, given("a_um_per_s2", a_um_per_s2, v)


# --- Answers.

#: What is under way may begin this time, s, and MAX_PENDING samples ahead of the stage.
AHEAD_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Served:
    """What queries read: immutable, and replaced whole.

    Attributes
    ----------
    seq : the last sample handled before this snapshot, -1 before any. t_s : its time, s; u_V : its voltage, V.
    models : by name. memories : by name, (m,) each, tracked from the samples up to ``seq``.
    default : name of the model that answers where a query names none.
    stand_in : name of the baseline that stands in for it; empty for none.
    trust : weight of the learning model inside its domain, 0 to 1.
    trouble : name of what is wrong with the samples or the learner, empty while nothing is.
    frozen : whether an operator has stopped learning: models and trust stay those of that moment.
    held : while frozen, memory of the stand-in at that moment, for queries that bring a memory of their own.
    """

    seq: int
    t_s: float
    u_V: float
    models: dict[str, InverseModel]
    memories: dict[str, FloatArray]
    default: str = ""
    stand_in: str = ""
    trust: float = 1.0
    trouble: str = ""
    frozen: bool = False
    held: FloatArray | None = None

    def standing_in_for(self, name: str, own_memory: bool = False) -> StandIn | None:
        """The model that stands in for the one called ``name``; None where there is no other.

        ``own_memory`` : the query brings its own memory, so that its answer depends on samples by the stand-in alone.
        """
        if self.stand_in in ("", name) or self.stand_in not in self.models:
            return None
        memory = self.memories[self.stand_in]
        if own_memory and self.frozen and self.held is not None:
            memory = self.held
        return StandIn(self.stand_in, self.models[self.stand_in], memory)

    def freeze(self) -> Served:
        """The same, frozen."""
        held = self.memories.get(self.stand_in)
        return self if self.frozen else replace(self, frozen=True, held=None if held is None else held.copy())

    def thaw(self) -> Served:
        """The same, not frozen."""
        return replace(self, frozen=False, held=None)


def trust_by_age(age_s: float, stale_s: float, last_good_s: float) -> tuple[float, bool]:
    """(weight, stale) of a model whose newest sample is ``age_s`` old, s, where samples are expected.

    Stale from ``stale_s`` on (0: never); from ``last_good_s`` on the stand-in takes over within a second.
    """
    if stale_s == 0.0 or age_s <= stale_s:
        return 1.0, False
    return 1.0 - min(1.0, max(0.0, age_s - last_good_s)), True


def answer(
    query: FeedforwardQuery,
    ring: tuple[Served, ...],
    handled: int,
    config: AxisConfig,
    limits: Limits,
    age_s: float | None,
    pace: Pace | None = None,
) -> Trajectory:
    """Voltages for a query, safe to apply. Raises InputError on what cannot be asked for.

    ``ring``: snapshots, newest last; ``handled``: the last sequence number of which all snapshots are in the ring;
    ``age_s``: time since the newest sample that was handled came, s, None before any. An ``as_of`` names its
    snapshot: age does not change what it answers, or a replay could not repeat it. ``pace`` : see `answer_safely`.
    """
    if query.y_um.size > config.query_points:
        raise FieldError(
            "n", query.y_um.size, f"1 to {config.query_points} points", "ask for fewer at once (query_points)"
        )
    served, behind, trust, stale = ring[-1], False, 1.0, False
    if query.as_of == NEWEST:
        trust, stale = trust_by_age(age_s or 0.0, config.stale_s, config.last_good_s)
        if served.frozen:
            trust = 1.0  # a frozen model follows no samples, so their age does not matter
    else:
        served, behind = _as_of(ring, query.as_of, handled, config.snapshot_every)
    default = served.default or config.served
    name = query.model or default
    model = served.models.get(name)
    if model is None:
        raise FieldError("model", repr(name), f"one of {', '.join(served.models)}, or empty for the default")
    check_domain(query.y_um, limits)
    if query.pending is not None:
        check_domain(query.pending.y_um, limits, "pending.y_um")
        check_voltages(query.pending.u_V, limits, "pending.u_V")
        check_count(query.pending)
    memory, y_um, v_um_per_s, a_um_per_s2 = query.memory, query.y_um, query.v_um_per_s, query.a_um_per_s2
    resumes_V = math.nan
    if memory is None:
        way, resumed = under_way(query, served.seq, model.dt_s)
        memory = carried(model, served.memories[name], way)
        if resumed is not None:
            y_um, v_um_per_s, a_um_per_s2, resumes_V = resumed
    if memory.size != model.memory_size:
        raise FieldError(
            "memory",
            f"{memory.size} values",
            f"{model.memory_size} for model {name!r}",
            "bring back the memory of this model's last reply, or none",
        )
    if query.memory is not None and isinstance(model, ChampionInverse) and not model.has_weights(memory):
        raise FieldError(
            "memory",
            f"the shares {memory[: len(model.models)].tolist()}",
            f"one share from 0 to 1 for each of {', '.join(model.names)}, with the sum 1",
            "bring back the memory of this model's last reply, or none",
        )
    got = answer_safely(
        model,
        memory,
        (y_um, v_um_per_s, a_um_per_s2),
        query.u_before_V,
        # The trust in the samples concerns only models that learn from them.
        Rules(limits, config.blend_share, trust * served.trust if learns(name, config) else 1.0, stale),
        served.standing_in_for(name, query.memory is not None),
        blends(name, default, config),
        resumes_V,
        pace,
    )
    return got._replace(snapshot_seq=served.seq, model=name, behind=behind, tracked_memory=query.memory is None)


def under_way(
    query: FeedforwardQuery, seq: int, dt_s: float
) -> tuple[Pending | None, tuple[FloatArray, FloatArray, FloatArray, float] | None]:
    """(what is under way after sample ``seq``, how the answer resumes from its last point).

    The last point under way is asked for again, ahead of the points of the query: (n + 1,) displacements, µm,
    velocities, µm/s, and accelerations, µm/s², and the voltage, V, that was commanded there. What the model asks for
    there now is another voltage: the difference fades (``service.answers.fallback``), so that a new snapshot is no
    step. Its
    velocity is the first point's less a step of its acceleration. None where nothing is under way.
    """
    pending = query.pending
    # What was commanded for samples before the last one seen is long done.
    if pending is None or pending.first + pending.y_um.size <= seq:
        return None, None
    seen = min(max(seq + 1 - pending.first, 0), pending.y_um.size - 1)
    way = Pending(pending.first + seen, pending.y_um[seen:-1], pending.u_V[seen:-1])
    y_um = np.concatenate([pending.y_um[-1:], query.y_um])
    v, a = query.v_um_per_s, query.a_um_per_s2
    v_um_per_s, a_um_per_s2 = np.concatenate([v[:1] - a[:1] * dt_s, v]), np.concatenate([a[:1], a])
    return way, (y_um, v_um_per_s, a_um_per_s2, float(pending.u_V[-1]))


def check_count(pending: Pending) -> None:
    """Raise InputError where what is under way would go beyond the largest number of a sample."""
    if pending.first + pending.y_um.size - 1 > MAX_SEQ:
        raise FieldError("pending.first", pending.first, f"at most 2**62 - {pending.y_um.size - 1}")


def most_ahead(handled: int, age_s: float, dt_s: float) -> int:
    """The largest number at which what is under way plausibly begins, when sample ``handled`` came ``age_s`` s ago."""
    return handled + math.ceil(age_s / dt_s) + 1 + math.ceil(AHEAD_S / dt_s) + MAX_PENDING


def carried(model: InverseModel, memory: FloatArray, way: Pending | None) -> FloatArray:
    """(m,) memory of ``model`` once what is under way has been done; ``memory`` is not changed."""
    if way is None or not way.y_um.size:
        return memory
    still = np.zeros(way.y_um.size)
    after = model.track(way.y_um, still, still, way.u_V, memory)
    return after if all_finite(after) else memory


def learns(name: str, config: AxisConfig) -> bool:
    """Whether the samples change the model called ``name``."""
    return bool(config.learn) and name in (config.learn, AUTO)


def blends(name: str, default: str, config: AxisConfig) -> bool:
    """Whether a model gives way to the stand-in outside its domain: the default and the one that learns do.

    The others are asked by name to be compared, and answer as themselves.
    """
    return name == default or learns(name, config)


def _as_of(ring: tuple[Served, ...], as_of: int, handled: int, every: int) -> tuple[Served, bool]:
    at = bisect_right(ring, as_of, key=attrgetter("seq")) - 1
    if at < 0:
        raise FieldError(
            "as_of",
            as_of,
            f"{ring[0].seq} or later",
            "older snapshots are gone: ask sooner, or keep more of them (snapshots_kept)",
        )
    following = (ring[at].seq // every + 1) * every
    return ring[at], following <= as_of and handled < following
