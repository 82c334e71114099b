"""One axis in the service: what learns, what is served, and the snapshots between the two.

No thread, no wire and no clock here: samples go in by :meth:`Axis.handle`, queries are answered by
:meth:`Axis.answer`, and the same samples give the same answers to the last bit, live or replayed. One thread may
handle samples while others answer queries: what they share is replaced whole, never changed. The operator's verbs
belong to the thread that handles samples, between two batches.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, NamedTuple

from adaptive.inverse_model import LssvmInverse
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict
from service.answers.answering import Served, answer, blends, learns
from service.answers.guard import Limits
from service.answers.memory_tracking import MemoryTracker
from service.background.retuning.adoption import Adoptions
from service.config.config import LEARN, AxisConfig
from service.intake.clock import SampleClock
from service.intake.sequence import ANEW, REFUSED, Seldom, SequenceTracker
from service.protocol.errors import FieldError
from service.protocol.keys import AUTO
from service.protocol.model import Safety
from service.protocol.query import FeedforwardQuery
from service.protocol.reply import Trajectory
from service.protocol.samples import SampleBatch
from service.server.axis_counting import AxisCounting
from service.server.model_watch import Watch, WatchConfig

__all__ = ["Axis", "Served"]

#: The baselines that may stand in for the model that learns, the best first: the one with hysteresis and a form that
#: bounds it far from its data, then the one that is always there.
STAND_INS: Final = ("mpi", "linear", "bouc_wen")
_MAX_EVENTS: Final = 256


class Tally(NamedTuple):
    """Counts that belong together: of the last sample handled, of what came, and of what was made of it."""

    seq: int
    samples: dict[str, int]
    gates: dict[str, int]


class Axis(AxisCounting):
    """The models of one axis.

    Parameters
    ----------
    config : limits, snapshots, names; see :class:`service.config.config.AxisConfig`.
    models : by name, all of one sample time.
    learner : what learns; its snapshots are served as ``config.learn``. None for a service that does not learn.
    limits : those of ``config``, with a displacement range filled in.
    revive : makes what learns anew from a model, where the learner has failed; None: it stays dead.
    """

    def __init__(
        self,
        config: AxisConfig,
        models: dict[str, InverseModel],
        learner: OnlineModel | None,
        limits: Limits,
        revive: Callable[[InverseModel], OnlineModel] | None = None,
    ) -> None:
        if config.served == AUTO and AUTO not in models:
            config = replace(config, served=config.learn or LEARN)  # it is alone, or nothing learns
        if config.served not in models:
            raise FieldError("served", repr(config.served), f"one of the models in the file: {', '.join(models)}")
        if config.stand_in and config.stand_in not in models:
            raise FieldError("stand_in", repr(config.stand_in), f"one of the models in the file: {', '.join(models)}")
        steps = {model.dt_s for model in models.values()}
        if len(steps) != 1:
            raise FieldError("dt_s", f"{sorted(steps)}", "one sample time for all models of an axis")
        self.config = config
        self.limits = limits
        self.learner = learner
        self.dt_s = steps.pop()
        self.sequence = SequenceTracker(self.dt_s)
        self._seldom = Seldom(calm=round(1.0 / self.dt_s))
        self.tracker = MemoryTracker(self.dt_s)
        self.watch = Watch(WatchConfig(last_good_s=config.last_good_s), self.dt_s, limits)
        self._revive = revive
        self.adoptions = Adoptions()
        self._learner_dead = False
        self._frozen_by = ""
        self._events: deque[dict[str, Any]] = deque(maxlen=_MAX_EVENTS)
        # Time goes on where a restarted stage begins anew; what learns sees one clock and one count.
        self.clock = SampleClock(self.dt_s)
        self._gates: dict[str, int] = {}
        # Newest last. A tuple, replaced at each snapshot, so that a query never waits for the learner.
        self._ring: tuple[Served, ...] = (self._first(dict(models)),)
        # States of the learner, the older one first, and the count of samples at the newer one.
        self._marks: tuple[StateDict, StateDict] = ({}, {})
        self._marked = 0
        #: The last sequence number whose snapshot, if it has one, is in the ring.
        self.handled_seq = -1
        #: What has been counted up to the last message; replaced whole, for whoever tells of it meanwhile.
        self.tally = Tally(-1, self.sequence.counters(), {})
        #: Time since the newest sample that was handled came, s, where samples are expected; set by who has a clock.
        self.age_s = 0.0
        #: Called once, right after the next snapshot, by the thread that handles samples; then None again.
        self.at_snapshot: Callable[[], None] | None = None

    @property
    def newest(self) -> Served:
        return self._ring[-1]

    @property
    def served(self) -> str:
        """Name of the model that answers where a query names none."""
        return self.newest.default

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

    def note(self, event: str, detail: str, **more: Any) -> None:
        """Keep an event, with the time that it is now, for whoever publishes them: a standby may much later."""
        told = {"seq": self.sequence.last, "event": event, "detail": detail, "time_unix_s": time.time()}
        self._events.append({**told, **more})

    def handle(self, batch: SampleBatch) -> list[str]:
        """Take the samples of a message; returns what was made of each: "learnt", or the reason why not."""
        verdicts = []
        every = self.config.snapshot_every
        rows = zip(batch.seq.tolist(), batch.t_s.tolist(), batch.u_V.tolist(), batch.y_um.tolist(), strict=True)
        for seq, t_s, u_V, y_um in rows:
            before = self.sequence.last
            order = self.sequence.take(seq, t_s)
            if self.sequence.refuted >= 0:
                self._tell_refuted(before)
            if order in REFUSED:
                verdicts.append(self._counted(self._refused(order, seq)))
                continue
            if order in ANEW:
                self._begin_count(order, seq, before)
            number = self.sequence.number(seq)
            verdict = self._counted(self._taught(Sample(number, self._time(number, t_s, order in ANEW), u_V, y_um)))
            verdicts.append(verdict)
            if self.adoptions:
                self.adopt_due(number)
            self.watch.take(u_V, y_um, verdict)
            self.tracker.add(seq, u_V, y_um)
            if seq // every > self.newest.seq // every:
                self._publish(seq, t_s, u_V)
            self.handled_seq = seq
            if self.at_snapshot is not None and self.newest.seq == seq:
                call, self.at_snapshot = self.at_snapshot, None
                call()
        self.count()
        return verdicts

    def count(self) -> None:
        """Bring the tally up to date; in the thread that handles samples."""
        self.tally = Tally(self.handled_seq, self.sequence.counters(), self.gates)

    def answer(self, query: FeedforwardQuery) -> Trajectory:
        """Voltages for a query, safe to apply. Raises InputError on what cannot be asked for."""
        handled = self.handled_seq  # read before the ring: what is missing then is really not there yet
        return answer(query, self._ring, handled, self.config, self.limits, self.age_s)

    def model(self, name: str) -> tuple[InverseModel, int, FloatArray]:
        """(model, snapshot_seq, tracked memory) of the newest snapshot. Raises InputError on an unknown name."""
        served = self.newest
        if name not in served.models:
            raise FieldError("model", repr(name), f"one of {', '.join(served.models)}")
        return served.models[name], served.seq, served.memories[name]

    def safety(self, name: str) -> Safety:
        """By what rules the model called ``name`` gives way to another, for who evaluates it elsewhere."""
        served, config = self.newest, self.config
        return Safety(
            blends(name, served.default, config),
            config.blend_share,
            served.trust if learns(name, config) else 1.0,
            config.stale_s if learns(name, config) else 0.0,
            config.last_good_s,
            served.standing_in_for(name),
        )

    def _first(self, models: dict[str, InverseModel]) -> Served:
        config = self.config
        if self.learner is not None:
            models[config.learn] = self.learner.snapshot()
        # Before the first sample the stage is taken to be at rest, where it was when it was identified.
        places = (model.features.y_rest_um for model in models.values() if isinstance(model, LssvmInverse))
        rest_um = next(places, 0.0)
        memories = {name: model.rest_memory(rest_um) for name, model in models.items()}
        # A model of the learner's own form is no stand-in for it.
        known = (name for name in STAND_INS if name in models and name not in (config.learn, config.served))
        return Served(-1, 0.0, math.nan, models, memories, config.served, config.stand_in or next(known, ""))

    def _publish(self, seq: int, t_s: float, u_V: float) -> None:
        last = self.newest
        models = last.models
        if self.learner is not None:
            models = models | self._judged(last)
        memories = self._own_memory(models, self.tracker.advance(models, last.memories))
        served = replace(
            last, seq=seq, t_s=t_s, u_V=u_V, models=models, memories=memories,
            trust=self.watch.trust, trouble=self.watch.trouble,
        )  # fmt: skip
        self._ring = (*self._ring, served)[-self.config.snapshots_kept :]
