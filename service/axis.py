"""One axis in the service: what learns, what is served, and the snapshots between the two.

No thread, no wire and no clock here: samples go in by :meth:`Axis.handle`, queries are answered by
:meth:`Axis.answer`, and the same samples give the same answers to the last bit, live or replayed. One thread may
handle samples while others answer queries: what they share is replaced whole, never changed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final

import numpy as np

from adaptive.errors import DehystError, InputError
from adaptive.types import Feedforward, FloatArray, InverseModel, OnlineModel, Sample
from service.config import AxisConfig
from service.errors import FieldError
from service.guard import Limits, check_domain, guard
from service.sequence import LATE, RESTARTED, SequenceTracker
from service.tracking import MemoryTracker
from service.wire import SampleBatch
from service.wire_query import NEWEST, NOT_FINITE_REPLACED, FeedforwardQuery, FeedforwardReply

#: The model that stands in, point by point, where another answers with what is not finite.
FALLBACK_MODEL: Final = "linear"
_MAX_EVENTS: Final = 256


@dataclass(frozen=True, slots=True)
class Served:
    """What queries read: immutable, and replaced whole.

    Attributes
    ----------
    seq : the last sample handled before this snapshot, -1 before any. t_s : its time, s; u_V : its voltage, V.
    models : by name. memories : by name, (m,) each, tracked from the samples up to ``seq``.
    """

    seq: int
    t_s: float
    u_V: float
    models: dict[str, InverseModel]
    memories: dict[str, FloatArray]


class Axis:
    """The models of one axis.

    Parameters
    ----------
    config : limits, snapshots, names; see :class:`service.config.AxisConfig`.
    models : by name, all of one sample time.
    learner : what learns; its snapshots are served as ``config.learn``. None for a service that does not learn.
    limits : those of ``config``, with a displacement range filled in.
    """

    def __init__(
        self, config: AxisConfig, models: dict[str, InverseModel], learner: OnlineModel | None, limits: Limits
    ) -> None:
        if config.served not in models:
            raise FieldError("served", repr(config.served), f"one of the models in the file: {', '.join(models)}")
        steps = {model.dt_s for model in models.values()}
        if len(steps) != 1:
            raise FieldError("dt_s", f"{sorted(steps)}", "one sample time for all models of an axis")
        self.config = config
        self.limits = limits
        self.learner = learner
        self.dt_s = steps.pop()
        self.sequence = SequenceTracker()
        self._tracker = MemoryTracker(self.dt_s)
        self._learner_dead = False
        self._events: deque[dict[str, Any]] = deque(maxlen=_MAX_EVENTS)
        # Time goes on where a restarted stage begins anew; what learns sees one clock and one count.
        self._t_last_s = self._t_offset_s = 0.0
        self._number_last = -1
        self._gates: dict[str, int] = {}
        # Newest last. A tuple, replaced at each snapshot, so that a query never waits for the learner.
        self._ring: tuple[Served, ...] = (self._first(dict(models)),)
        #: The last sequence number whose snapshot, if it has one, is in the ring.
        self.handled_seq = -1

    @property
    def newest(self) -> Served:
        return self._ring[-1]

    @property
    def learning(self) -> bool:
        """Whether samples still change what is served."""
        return self.learner is not None and not self._learner_dead

    @property
    def gates(self) -> dict[str, int]:
        """Samples by what the learner said of them, since the start."""
        return dict(self._gates)

    def take_events(self) -> list[dict[str, Any]]:
        """The events since the last call, oldest first; of a flood only the newest are kept."""
        events = []
        while self._events:
            events.append(self._events.popleft())
        return events

    def note(self, event: str, detail: str) -> None:
        """Keep an event for whoever publishes them."""
        self._events.append({"seq": self.sequence.last, "event": event, "detail": detail})

    def handle(self, batch: SampleBatch) -> list[str]:
        """Take the samples of a message; returns what was made of each: "learnt", or the reason why not."""
        verdicts = []
        every = self.config.snapshot_every
        rows = zip(batch.seq.tolist(), batch.t_s.tolist(), batch.u_V.tolist(), batch.y_um.tolist(), strict=True)
        for seq, t_s, u_V, y_um in rows:
            order = self.sequence.take(seq)
            number = self.sequence.number(seq)
            if order == RESTARTED:
                self._restart(seq)
                self._t_offset_s = self._t_last_s + (number - self._number_last) * self.dt_s - t_s
            t_going_on_s = t_s + self._t_offset_s
            if order != LATE and math.isfinite(t_going_on_s):
                self._number_last, self._t_last_s = number, t_going_on_s
            verdict = self._learn(Sample(number, t_going_on_s, u_V, y_um))
            self._gates[verdict] = self._gates.get(verdict, 0) + 1
            verdicts.append(verdict)
            if order == LATE:
                continue
            self._tracker.add(seq, u_V, y_um)
            if seq // every > self.newest.seq // every:
                self._publish(seq, t_s, u_V)
            self.handled_seq = seq
        return verdicts

    def answer(self, query: FeedforwardQuery) -> FeedforwardReply:
        """Voltages for a query, safe to apply. Raises InputError on what cannot be asked for."""
        handled = self.handled_seq  # read before the ring: what is missing then is really not there yet
        ring = self._ring
        served, behind = ring[-1], False
        if query.as_of != NEWEST:
            served, behind = self._as_of(ring, query.as_of, handled)
        name = query.model or self.config.served
        model = served.models.get(name)
        if model is None:
            raise FieldError("model", repr(name), f"one of {', '.join(served.models)}, or empty for the default")
        check_domain(query.y_um, self.limits)
        memory = served.memories[name] if query.memory is None else query.memory
        if memory.size != model.memory_size:
            raise FieldError(
                "memory",
                f"{memory.size} values",
                f"{model.memory_size} for model {name!r}",
                "bring back the memory of this model's last reply, or none",
            )
        forward = model.feedforward(query.y_um, query.v_um_per_s, query.a_um_per_s2, memory)
        u, std, fallback = forward.u_V, forward.std_V, False
        after = forward.memory
        finite = bool(np.isfinite(u).all())
        if not finite:
            u, fallback = self._stand_in(served, query, forward), True
        if not np.isfinite(after).all():
            after, fallback = memory, True
        safe, flags = guard(u, forward.inside, self.dt_s, self.limits, query.u_before_V)
        if not finite:
            flags[~np.isfinite(forward.u_V)] |= NOT_FINITE_REPLACED
        return FeedforwardReply(safe, std, flags, after, served.seq, name, behind, query.memory is None, fallback)

    def model(self, name: str) -> tuple[InverseModel, int, FloatArray]:
        """(model, snapshot_seq, tracked memory) of the newest snapshot. Raises InputError on an unknown name."""
        served = self.newest
        if name not in served.models:
            raise FieldError("model", repr(name), f"one of {', '.join(served.models)}")
        return served.models[name], served.seq, served.memories[name]

    def _first(self, models: dict[str, InverseModel]) -> Served:
        if self.learner is not None:
            models[self.config.learn] = self.learner.snapshot()
        return Served(-1, 0.0, math.nan, models, {name: model.rest_memory(0.0) for name, model in models.items()})

    def _as_of(self, ring: tuple[Served, ...], as_of: int, handled: int) -> tuple[Served, bool]:
        at = bisect_right(ring, as_of, key=attrgetter("seq")) - 1
        if at < 0:
            raise FieldError(
                "as_of",
                as_of,
                f"{ring[0].seq} or later",
                "older snapshots are gone: ask sooner, or keep more of them (snapshots_kept)",
            )
        every = self.config.snapshot_every
        following = (ring[at].seq // every + 1) * every
        return ring[at], following <= as_of and handled < following

    def _learn(self, sample: Sample) -> str:
        if self.learner is None or self._learner_dead:
            return "not_learning"
        try:
            return self.learner.handle(sample)
        except Exception as error:
            # A learner never raises on data. If it does, its state is in doubt: what it last gave stays served.
            self._learner_dead = True
            self.note("learner_failed", f"{type(error).__name__}: {error}; the last good model stays in service")
            return "not_learning"

    def _publish(self, seq: int, t_s: float, u_V: float) -> None:
        last = self.newest
        models = last.models
        if self.learner is not None and not self._learner_dead:
            try:
                models = models | {self.config.learn: self.learner.snapshot()}
            except (DehystError, ValueError, ArithmeticError) as error:
                self._learner_dead = True
                self.note("learner_failed", f"snapshot: {error}; the last good model stays in service")
        memories = self._tracker.advance(models, last.memories)
        self._ring = (*self._ring, Served(seq, t_s, u_V, models, memories))[-self.config.snapshots_kept :]

    def _restart(self, seq: int) -> None:
        """The stage counts from the beginning again: snapshots of the old count can no longer be named."""
        last = self.newest
        self._tracker.forget()
        self._ring = (Served(-1, last.t_s, last.u_V, last.models, last.memories),)
        self.note("stage_restarted", f"the stage's numbers went back to {seq}; the model is kept")

    def _stand_in(self, served: Served, query: FeedforwardQuery, forward: Feedforward) -> FloatArray:
        """The fallback's voltage where the model's is not finite."""
        model = served.models.get(FALLBACK_MODEL)
        if model is None:
            return forward.u_V
        try:
            other = model.feedforward(query.y_um, query.v_um_per_s, query.a_um_per_s2, served.memories[FALLBACK_MODEL])
        except InputError:
            return forward.u_V
        return np.where(np.isfinite(forward.u_V), forward.u_V, other.u_V)
