"""The answer to a query: which snapshot, which model, from which memory; then by the rules of
``service.answers.fallback``.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.fallback import Rules, answer_safely
from dehyst.service.answers.guard import Limits, check_domain
from dehyst.service.answers.slices import Pace
from dehyst.service.answers.which_model import trust_by_age
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import AUTO
from dehyst.service.protocol.model import StandIn
from dehyst.service.protocol.query import MAX_PENDING, NEWEST, FeedforwardQuery, Pending, Trajectory
from dehyst.service.protocol.samples import MAX_SEQ, check_finite, column

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
    _seq: Annotated[int, Entry("the last sample", low=-1)]
    _y: Annotated[float, Entry("its displacement", "µm", finite=False)]
    _v: Annotated[float, Entry("its velocity", "µm/s", finite=False)]

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._rows = []
        self._begun = False
        self.forget()

    def forget(self) -> None:
        """Drop the samples that wait, and begin the differences anew."""
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

    Given values are kept; missing ones are central differences, one-sided and of second order at the ends.
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
        array = column(field, values)
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
    blend_share : distance outside the learnt domain, in learnt spans, at which the stand-in answers alone.
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
    blend_share: float = 0.5
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


def answer(
    query: FeedforwardQuery,
    ring: tuple[Served, ...],
    handled: int,
    config: AxisConfig,
    limits: Limits,
    age_s: float | None,
    pace: Pace | None = None,
) -> Trajectory:
    """Voltages for a query, safe to apply. Raises InputError on an invalid query.

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
        check_count(query.pending)
    if query.memory is None:
        memory, points, resumes_V = begin_from(model, served.memories[name], query, served.seq)
    else:
        memory, points, resumes_V = query.memory, (query.y_um, query.v_um_per_s, query.a_um_per_s2), math.nan
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
        points,
        query.u_before_V,
        # The trust in the samples concerns only models that learn from them.
        Rules(limits, served.blend_share, trust * served.trust if learns(name, config) else 1.0, stale),
        served.standing_in_for(name, query.memory is not None),
        blends(name, default, config),
        resumes_V,
        pace,
    )
    return got._replace(snapshot_seq=served.seq, model=name, behind=behind, tracked_memory=query.memory is None)


class Beginning(NamedTuple):
    """Where an answer begins.

    Attributes
    ----------
    memory : (m,) at the first of the points. points : (n,) or (n + 1,) displacements µm, velocities µm/s and
    accelerations µm/s². resumes_V : where finite, the first point was commanded already, with this voltage, V.
    """

    memory: FloatArray
    points: tuple[FloatArray, FloatArray, FloatArray]
    resumes_V: float = math.nan


def begin_from(model: InverseModel, memory: FloatArray, query: FeedforwardQuery, seq: int) -> Beginning:
    """The answer of ``model`` from its tracked ``memory`` (m,) after sample ``seq``, along what is under way.

    The last point under way is asked for again, ahead of the points of the query: what the model asks for there now is
    another voltage than was commanded, and the difference fades (``service.answers.fallback``), so that a new snapshot
    is no step. Velocity and acceleration of that point are not sent. Of `_last_motions`, those count whose voltage is
    nearest to the commanded one, so that a turn of the motion there is not taken for a difference of the models.
    """
    pending, points = query.pending, (query.y_um, query.v_um_per_s, query.a_um_per_s2)
    # Commands for samples before the last one seen have been applied already.
    if pending is None or pending.first + pending.y_um.size <= seq:
        return Beginning(memory, points)
    seen = min(max(seq + 1 - pending.first, 0), pending.y_um.size - 1)
    memory = carried(model, memory, Pending(pending.first + seen, pending.y_um[seen:-1], pending.u_V[seen:-1]))
    last_um, last_V = pending.y_um[-1:], float(pending.u_V[-1])
    v_um_per_s, a_um_per_s2 = _last_motions(pending.y_um[-3:].tolist(), query, model.dt_s)
    errors_V = np.array(
        [
            abs(
                float(model.feedforward(last_um, v_um_per_s[i : i + 1], a_um_per_s2[i : i + 1], memory).u_V[0]) - last_V
            )
            for i in range(v_um_per_s.size)
        ]
    )
    i = int(np.argmin(np.where(np.isfinite(errors_V), errors_V, np.inf)))
    first = (last_um, v_um_per_s[i : i + 1], a_um_per_s2[i : i + 1])
    y, v, a = (np.concatenate([one, other]) for one, other in zip(first, points, strict=True))
    return Beginning(memory, (y, v, a), last_V)


def _last_motions(way_um: list[float], query: FeedforwardQuery, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """(k,) velocities, µm/s, and accelerations, µm/s², that the last point under way may have been commanded with.

    From the first point of the query by a polynomial of third order; by the straight line from the point before; by
    central differences. ``way_um`` : its displacement after those before it, up to three in all.
    """
    y, v, a = query.y_um.item(0), query.v_um_per_s.item(0), query.a_um_per_s2.item(0)
    jerk = 6.0 * (y - v * dt_s + 0.5 * a * dt_s**2 - way_um[-1]) / dt_s**3
    speeds, accelerations = [v - a * dt_s + 0.5 * jerk * dt_s**2], [a - jerk * dt_s]
    if len(way_um) > 1:
        speeds.append((way_um[-1] - way_um[-2]) / dt_s)
        accelerations.append(0.0)
    if len(way_um) > 2:
        speeds.append((y - way_um[-2]) / (2.0 * dt_s))
        accelerations.append((v - (way_um[-1] - way_um[-3]) / (2.0 * dt_s)) / (2.0 * dt_s))
    return np.array(speeds), np.array(accelerations)


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

    Queries name the others to compare them, so they answer alone.
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
