"""One axis in the service: samples in by `Axis.handle`, snapshots of its models, answers to queries by `Axis.answer`.

There is no thread, no wire and no clock here: the same samples give the same answers to the last bit, live or replayed.
One thread may handle samples while others answer queries, because what they share is replaced as a whole and never
changed. The operator's commands and the state belong to the thread that handles samples, between two batches.
"""

from __future__ import annotations

import logging
import math
import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Final, NamedTuple

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.gates import DUPLICATE, OUT_OF_ORDER, TIMING
from dehyst.adaptive.state import Entry, Refused, load, part_of, restore, save
from dehyst.adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict, prefixed
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import MemoryTracker, Served, answer, blends, learns, most_ahead
from dehyst.service.answers.correcting import QueryCorrection
from dehyst.service.answers.guard import Limits
from dehyst.service.answers.slices import Pace
from dehyst.service.answers.which_model import (
    Answering,
    Seen,
    answering,
    is_identified,
    trust_by_age,
)
from dehyst.service.background.adoptions import Retuned
from dehyst.service.config.settings import LEARN, AxisConfig
from dehyst.service.intake.command_witness import CommandWitness
from dehyst.service.intake.sequence import AHEAD, NEW_COUNT, REFUSED, RESTARTED, SampleClock, SequenceTracker
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import AUTO
from dehyst.service.protocol.model import Safety, digests, fingerprint, stored_kind
from dehyst.service.protocol.query import FeedforwardQuery, Trajectory
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.learner_supervisor import (
    NOT_COMMANDED,
    NOT_LEARNING,
    NOT_REFUSED,
    UNUSABLE,
    LearnerSupervisor,
    Revive,
    blend_share_of,
    champion_of,
    stored_model,
)
from dehyst.service.server.moves import Moves

# --- Events of an axis: kept for the wire, and written to the log of the process.

#: Parent of all loggers of axes: ``dehyst.axis.<stage>.<axis>``. Without a handler of the program nothing is printed.
LOGGER: Final = "dehyst.axis"
#: Levels of the events that are not information.
LEVELS: Final = {
    "learner_failed": logging.ERROR,
    "internal_error": logging.ERROR,
    "trouble": logging.WARNING,
    "stale": logging.WARNING,
    "samples_dropped": logging.WARNING,
    "thinned": logging.WARNING,
    "stopped_behind": logging.WARNING,
    "limits_narrow": logging.WARNING,
    "model_clipped": logging.WARNING,
    "rate_too_high": logging.WARNING,
    "malformed_samples": logging.WARNING,
    "contestant_failed": logging.WARNING,
    "checkpoint_failed": logging.WARNING,
    "checkpoint_refused": logging.WARNING,
    "journal_failed": logging.WARNING,
    "operation_refused": logging.WARNING,
    "standby_refused": logging.WARNING,
    "standby_differed": logging.WARNING,
    "claim_ignored": logging.WARNING,
    "under_way_ahead": logging.WARNING,
}
#: Events that wait for the publisher; of a flood only the newest are kept.
_KEPT: Final = 256

logging.getLogger("dehyst").addHandler(logging.NullHandler())


#: Events at the begin and at the end of a trouble: the detail begins with its name, and is its name.
TROUBLE, RECOVERED = "trouble", "recovered"


class EventLog:
    """The events of one axis. Any thread may note and take.

    Parameters
    ----------
    stage, axis : names on the wire, for the name of the logger; ``stage`` may be empty.
    """

    def __init__(self, stage: str, axis: str) -> None:
        self._logger = logging.getLogger(".".join(name for name in (LOGGER, stage, axis) if name))
        self._waiting: deque[dict[str, Any]] = deque(maxlen=_KEPT)
        self._troubles: dict[str, str] = {}

    def trouble_why(self, trouble: str) -> str:
        """The reason that was noted when ``trouble`` began, in words; "" where none was, or it is over."""
        return self._troubles.get(trouble, "")

    def note(self, seq: int, event: str, detail: str, **more: Any) -> None:
        """Keep an event with the number of the last sample and the present time, and log it.

        A standby publishes its events when it takes over, which may be much later.
        """
        self._waiting.append({"seq": seq, "event": event, "detail": detail, "time_unix_s": time.time(), **more})
        if event == TROUBLE:
            self._troubles[re.split(r"[^a-z_]", detail, maxsplit=1)[0]] = detail
        elif event == RECOVERED:
            self._troubles.pop(detail, None)
        self._logger.log(LEVELS.get(event, logging.INFO), "%s: %s (sample %d)", event, detail, seq)

    def take(self) -> list[dict[str, Any]]:
        """The events since the last call, oldest first."""
        events = []
        while self._waiting:
            events.append(self._waiting.popleft())
        return events


class EventLimiter:
    """Limits repeated events: it allows the first of a kind, and the next one after ``calm`` samples without any.

    A flood counts as one event; the counters still count each.
    """

    def __init__(self, calm: int) -> None:
        self._calm = calm
        self._last: dict[str, int] = {}

    def allows(self, event: str, received: int) -> bool:
        """Whether to tell ``event``, which has just occurred at sample number ``received`` of all that came."""
        last = self._last.get(event)
        self._last[event] = received
        return last is None or received - last > self._calm


#: Baselines that may stand in for the model that learns, the best first: the one with hysteresis, whose form bounds it
#: far from its data, then the one that is always there.
STAND_INS: Final = ("mpi", "linear", "bouc_wen")


class SampleCounts(NamedTuple):
    """Counts of one moment: number of the last sample handled, samples by order of arrival, samples by verdict; those
    that were refused for their number, and of these the ones that contradict what came before."""

    seq: int
    samples: dict[str, int]
    gates: dict[str, int]
    refused: int = 0
    foreign: int = 0


#: Samples whose readings are remembered, to tell a copy from another stage's: a power of two.
_RECENT: Final = 1024


@dataclass(slots=True)
class ServedEntries:
    """What is served, beside models and memories."""

    seq: Annotated[int, Entry("the last sample handled before the snapshot", low=-1)]
    t_s: Annotated[float, Entry("its time", "s")]
    u_V: Annotated[float, Entry("its voltage", "V", finite=False)]
    default: Annotated[str, Entry("name of the model that answers where a query names none", most=1000)]
    trust: Annotated[float, Entry("weight of the learning model inside its domain", low=0.0, high=1.0)]
    trouble: Annotated[str, Entry("what is wrong with the samples or the learner, empty for nothing", most=1000)]
    blend_share: Annotated[float, Entry("distance from the domain at which the stand-in answers alone", low=1e-9)]


@dataclass(slots=True)
class AxisEntries:
    """What an axis holds beside the learner and its supervisor, numbers and clock of samples, and frozen models."""

    seq: Annotated[int, Entry("the last sample handled", low=-1)]
    served: Annotated[ServedEntries, Entry("what is served")]
    gates: Annotated[dict[str, int], Entry("samples by outcome", low=0)]
    memory: Annotated[dict[str, FloatArray], Entry("hysteresis memory of each served model")]
    held: Annotated[FloatArray | None, Entry("memory of the stand-in when learning was stopped")]


#: Beginnings of the entries of the supervisor.
_OF_SUPERVISOR: Final = (
    "frozen_by", "dead", "dead_at", "adoptions", "watch.", "choice.", "model.", "mark.", "learner.",
)  # fmt: skip


class Axis:
    """The models of one axis.

    Parameters
    ----------
    config : limits, snapshots, names; see `service.config.settings.AxisConfig`.
    models : by name, all of one sample time.
    learner : learns from the samples; its snapshots are served as ``config.learn``. None for no learning.
    limits : those of ``config``, with a displacement range filled in.
    revive : starts another learner from a model, some time after a learner has failed; None: it stays failed.
    stage : name of the stage, for the log.
    warnings : what the operator should know from the start on, by the name of its event.

    Raises InputError if ``config`` names a model that is missing, or if the sample times differ.
    """

    def __init__(
        self,
        config: AxisConfig,
        models: dict[str, InverseModel],
        learner: OnlineModel | None,
        limits: Limits,
        revive: Revive | None = None,
        *,
        stage: str = "",
        warnings: Mapping[str, str] | None = None,
    ) -> None:
        if config.served == AUTO and AUTO not in models:
            config = replace(config, served=config.learn or LEARN)  # without a competition
        if config.served not in models:
            raise FieldError("served", repr(config.served), f"one of the models in the file: {', '.join(models)}")
        if config.stand_in and config.stand_in not in models:
            raise FieldError("stand_in", repr(config.stand_in), f"one of the models in the file: {', '.join(models)}")
        steps = {model.dt_s for model in models.values()}
        if len(steps) != 1:
            raise FieldError("dt_s", f"{sorted(steps)}", "one sample time for all models of an axis")
        self.config = config
        self.limits = limits
        self.dt_s = steps.pop()
        self.sequence = SequenceTracker(self.dt_s)
        self.clock = SampleClock(self.dt_s)
        self.tracker = MemoryTracker(self.dt_s)
        self.witness = CommandWitness(limits.u_max_V - limits.u_min_V)
        self.supervisor = LearnerSupervisor(
            config.learn, learner, limits, config.last_good_s, self.dt_s, self.note, revive
        )
        #: What is added to the answers to queries; None: nothing.
        self.correction = (
            QueryCorrection(config.correction, limits, self.dt_s, self._note_limited) if config.correction.on else None
        )
        #: What moves between two snapshots, for followers.
        self.moves = Moves(config.learn, config.delta_hz, self.dt_s)
        #: Number of the last sample whose snapshot, if it has one, is available.
        self.handled_seq = -1
        self._identified = {name: model for name, model in models.items() if name != AUTO}
        #: Whose its files are, see `service.storage.owner`.
        self.owner = f"{stage}/{config.name}"
        self._events = EventLog(stage, config.name)
        self._limiter = EventLimiter(calm=round(1.0 / self.dt_s))
        self._gates: dict[str, int] = {}
        # Newest last. A tuple, replaced at each snapshot, so that a query never waits for the learner.
        self._snapshots: tuple[Served, ...] = (self._first_snapshot(dict(models)),)
        #: The last samples by number, (number, reading), and the counts of those refused for their number.
        self._recent: list[tuple[int, float]] = [(-1, 0.0)] * _RECENT
        self._refused = self._foreign = 0
        #: Counts up to the last message; replaced as a whole, for readers in other threads.
        self.counts = SampleCounts(-1, {**self.sequence.counters(), "left_out": 0}, {})
        self._age_s: float | None = None
        #: Queries whose samples under way began far ahead of the stage; and whether the last one did.
        self.far_ahead = 0
        self._far_ahead = False
        self.warnings = dict(warnings or {})
        for event, detail in self.warnings.items():
            self.note(event, detail)

    # ---- what other threads read

    @cached_property
    def identified(self) -> dict[str, str]:
        """Digest of each model of the model file, by name: what a checkpoint must have grown from."""
        return digests(self._identified)

    @property
    def newest(self) -> Served:
        """The newest snapshot."""
        return self._snapshots[-1]

    @property
    def snapshots(self) -> tuple[Served, ...]:
        """All snapshots that queries can ask for, the newest last."""
        return self._snapshots

    @property
    def served(self) -> str:
        """Name of the model that answers where a query names none."""
        return self.newest.default

    @property
    def learner(self) -> OnlineModel | None:
        """The model that learns; another object after it was replaced or restored."""
        return self.supervisor.learner

    @property
    def learning(self) -> bool:
        """Whether samples still change what is served."""
        return self.supervisor.learning

    @property
    def frozen(self) -> bool:
        """Whether an operator has stopped learning."""
        return self.supervisor.frozen

    @property
    def gates(self) -> dict[str, int]:
        """Samples by verdict since the start."""
        return dict(self._gates)

    def answering(self) -> Answering:
        """Which model answers a query that names none."""
        served, learn, age_s = self.newest, self.config.learn, self._age_s or 0.0
        model = served.models[served.default]
        learnt = learns(served.default, self.config)
        age_weight = 1.0 if served.frozen else trust_by_age(age_s, self.config.stale_s, self.config.last_good_s)[0]
        return answering(
            Seen(
                served.trouble,
                served.trust * age_weight if learnt else 1.0,
                frozen=served.frozen,
                rival=isinstance(model, ChampionInverse) and model.champion != 0,
                learns=learnt,
                identified=learnt and is_identified(served.models[learn], self._identified[learn]),
            )
        )

    def note(self, event: str, detail: str, **more: Any) -> None:
        """Note an event at the last sample. From any thread."""
        self._events.note(self.sequence.last, event, detail, **more)

    def trouble_why(self, trouble: str) -> str:
        """The reason for ``trouble``, in words; "" where none is known."""
        return self._events.trouble_why(trouble)

    def take_events(self) -> list[dict[str, Any]]:
        """The events since the last call, oldest first; of a flood only the newest are kept."""
        return self._events.take()

    def update_age(self, age_s: float | None) -> None:
        """The time, s, since the newest sample that was handled came; None before any. For the publishing thread."""
        self._age_s = age_s

    def answer(self, query: FeedforwardQuery, pace: Pace | None = None, commands: bool = True) -> Trajectory:
        """Voltages for a query, safe to apply. Raises InputError on a query that cannot be answered.

        ``pace`` : evaluate in slices, all from one snapshot, with this between them (`service.answers.slices`).
        ``commands`` : whether what is under way is believed: it is compared with the samples, and corrected.
        """
        handled = self.handled_seq  # read before the snapshots: one that is missing in them is then really not there
        ring = self._snapshots

        def ask(asked: FeedforwardQuery) -> Trajectory:
            return answer(asked, ring, handled, self.config, self.limits, self._age_s, pace)

        if query.pending is None or not commands:
            return ask(query)
        got = ask(query) if self.correction is None else self.correction.answer(query, ask, ring, handled)
        self.witness.note(query.pending, query.y_um, got.u_V)
        if self._age_s is not None:
            self._look_ahead(query.pending.first, most_ahead(handled, self._age_s, self.dt_s))
        return got

    def _look_ahead(self, first: int, most: int) -> None:
        """Tell of a controller whose count is far ahead of the stage's. It gets its answer: the stage's counter may
        have jumped, which samples will show later."""
        if first <= most:
            self._far_ahead = False
            return
        self.far_ahead += 1
        if not self._far_ahead:
            self._far_ahead = True
            self.note("under_way_ahead", f"a controller's voltages begin at sample {first}, the stage is before {most}")

    def model(self, name: str, served: Served | None = None) -> tuple[InverseModel, int, FloatArray]:
        """(model, snapshot_seq, tracked memory) of a snapshot, or the newest. Raises InputError on an unknown name."""
        served = served or self.newest
        if name not in served.models:
            raise FieldError("model", repr(name), f"one of {', '.join(served.models)}")
        return served.models[name], served.seq, served.memories[name]

    def safety(self, name: str, served: Served | None = None) -> Safety:
        """The rules by which the model ``name`` gives way to its stand-in, for evaluation in another process."""
        served, config = served or self.newest, self.config
        return Safety(
            blends(name, served.default, config),
            served.blend_share,
            served.trust if learns(name, config) else 1.0,
            config.stale_s if learns(name, config) and not served.frozen else 0.0,
            config.last_good_s,
            served.standing_in_for(name, served.frozen),
            served.trouble,
        )

    def differs(self, seq: int, theirs: str) -> bool:
        """Whether the learning model of the snapshot at ``seq`` has another fingerprint than ``theirs``."""
        mine = next((served for served in reversed(self._snapshots) if served.seq == seq), None)
        return bool(self.config.learn) and mine is not None and fingerprint(mine.models[self.config.learn]) != theirs

    def adopt_at(self, *retuned: Retuned) -> None:
        """Let the learner adopt hyper-parameters, each right after its sample."""
        self.supervisor.adoptions.add(*retuned)

    # ---- samples, in the thread that handles them

    def handle(self, batch: SampleBatch, on_snapshot: Callable[[], None] | None = None) -> list[str]:
        """Take the samples of a message. Returns the verdict on each: "learnt", or the reason why not.

        ``on_snapshot`` : called after each new snapshot, when the state is that of its sample.
        """
        verdicts = []
        every = self.config.snapshot_every
        rows = zip(batch.seq.tolist(), batch.t_s.tolist(), batch.u_V.tolist(), batch.y_um.tolist(), strict=True)
        for seq, t_s, u_V, y_um in rows:
            before = self.sequence.last
            order = self.sequence.take(seq, t_s)
            if self.sequence.refuted >= 0:
                self._note_refuted(self.sequence.take_refuted(), before)
            if order in REFUSED:
                verdicts.append(self._counted(self._refusal(order, seq)))
                self._count_refused(order, seq, y_um)
                continue
            if order in NEW_COUNT:
                self._begin_count(order, seq, before)
            number = self.sequence.number(seq)
            self._recent[seq % _RECENT] = seq, y_um
            commanded = self.witness.take(seq, u_V)
            if commanded is not None:
                # In doubt the memory follows the commanded motion.
                u_V, y_um = commanded
            sample = Sample(number, self._time_s(number, t_s, order in NEW_COUNT), u_V, y_um)
            said = self._teach(sample)
            verdict = self._counted(NOT_COMMANDED if commanded is not None and said not in UNUSABLE else said)
            verdicts.append(verdict)
            if self.supervisor.adoptions.pending:
                self.supervisor.adopt_due(number)
            self.supervisor.watch.take(u_V, y_um, verdict)
            if verdict not in UNUSABLE:
                self.tracker.add(seq, u_V, y_um)
            if self.correction is not None:
                self.correction.read(seq, u_V, y_um if verdict in NOT_REFUSED else math.nan)
            due = seq // every > self.newest.seq // every
            if due:
                self._take_snapshot(seq, t_s, u_V)
                self.moves.begin(self.newest, self.learner)
            self.handled_seq = seq
            if due and on_snapshot is not None:
                on_snapshot()
            if self.moves.due(seq):
                self.moves.take(seq, self.learner)
        if self.moves.due_at_end(self.handled_seq):
            self.moves.take(self.handled_seq, self.learner)
        self._update_counts()
        return verdicts

    def _counted(self, verdict: str) -> str:
        self._gates[verdict] = self._gates.get(verdict, 0) + 1
        return verdict

    def _update_counts(self) -> None:
        counts = {**self.sequence.counters(), "left_out": self.sequence.left_out}
        self.counts = SampleCounts(self.handled_seq, counts, self.gates, self._refused, self._foreign)

    def _count_refused(self, order: str, seq: int, y_um: float) -> None:
        """Count a sample refused for its number: a copy of one before, one that was lost and comes late, or, where it
        is neither, one of another sender."""
        self._refused += 1
        number, reading = self._recent[seq % _RECENT]
        if number == seq:
            self._foreign += reading != y_um and reading == reading and y_um == y_um
        elif order == AHEAD or not self.sequence.was_skipped(seq):
            self._foreign += 1

    def _refusal(self, order: str, seq: int) -> str:
        """The verdict on a sample that is refused for its number."""
        if order == AHEAD:
            return AHEAD
        if not self.learning:
            return NOT_LEARNING
        return DUPLICATE if seq == self.sequence.last else OUT_OF_ORDER

    def _time_s(self, number: int, t_s: float, anew: bool) -> float:
        """The time of a sample, s, for the learner: without the steps of the stage's clock."""
        sets = self.clock.sets
        continuous_s = self.clock.take(number, t_s, anew)
        if self.clock.sets != sets:
            self._note_limited(
                "stage_clock_set", "the stage's clock has been set; time goes on by the numbers of the samples"
            )
        return continuous_s

    def _teach(self, sample: Sample) -> str:
        """The learner's verdict on a sample in order; one with a doubtful time is refused before."""
        if self.clock.in_doubt and self.learning:
            return TIMING
        verdict = self.supervisor.handle(sample, self.witness.doubts)
        if self.clock.must_resync(verdict) and self.learner is not None:
            self._note_limited(
                "learner_resynced", f"it refused samples in order as {verdict}: its own count and time begin anew"
            )
            self.learner.resync()
        return verdict

    def _begin_count(self, order: str, seq: int, before: int) -> None:
        """The stage has begun another count: its number after ``before`` is ``seq``."""
        self.tracker.forget()
        if self.correction is not None:
            self.correction.forget()
        if order == RESTARTED:
            # Snapshots of the old count can no longer be named.
            self._snapshots = (replace(self.newest, seq=-1),)
            self._note_limited("stage_restarted", f"the stage's numbers went back to {seq}; the model is kept")
        else:
            self._note_limited(
                "numbers_jumped",
                f"the stage's numbers went from {before} to {seq}, which its times do not explain; the model is kept",
            )

    def _note_refuted(self, refuted: int, before: int) -> None:
        detail = f"number {refuted} after {before} was refused: the next ones did not go on from there"
        self._note_limited("numbers_ahead", detail)

    def _note_limited(self, event: str, detail: str) -> None:
        if self._limiter.allows(event, self.sequence.received):
            self.note(event, detail)

    # ---- snapshots

    def _first_snapshot(self, models: dict[str, InverseModel]) -> Served:
        config = self.config
        if self.learner is not None:
            models[config.learn] = self.learner.snapshot()
        # Before the first sample the stage is assumed at rest, at the position where it was when it was identified.
        positions = (model.features.y_rest_um for model in models.values() if isinstance(model, LssvmInverse))
        rest_um = next(positions, 0.0)
        memories = {name: model.rest_memory(rest_um) for name, model in models.items()}
        # A model of the learner's own form is no stand-in for it.
        usable = (name for name in STAND_INS if name in models and name not in (config.learn, config.served))
        return Served(
            -1, 0.0, math.nan, models, memories, config.served, config.stand_in or next(usable, ""),
            blend_share=config.blend_share,
        )  # fmt: skip

    def _take_snapshot(self, seq: int, t_s: float, u_V: float) -> None:
        last, supervisor = self.newest, self.supervisor
        models = last.models
        if supervisor.learner is not None:
            learnt = supervisor.models(last, self.sequence.received, self.witness.why)
            # While frozen the samples are still judged, but what they change is not served.
            models = models if last.frozen else models | learnt
        memories = supervisor.memories(models, self.tracker.advance(models, last.memories), last.frozen)
        served = replace(
            last, seq=seq, t_s=t_s, u_V=u_V, models=models, memories=memories,
            trust=last.trust if last.frozen else supervisor.choice.trust, trouble=supervisor.choice.trouble,
            blend_share=last.blend_share
            if last.frozen
            else blend_share_of(supervisor.learner, last.stand_in, self.config.blend_share),
        )  # fmt: skip
        self._snapshots = (*self._snapshots, served)[-self.config.snapshots_kept :]

    # ---- operator's commands; each returns the number of the sample after which it holds

    def freeze(self, by: str = "") -> int:
        """Stop learning and keep what is served to the last bit; samples are still tracked, judged and recorded."""
        self.supervisor.freeze(by or "operator")
        self._snapshots = (*self._snapshots[:-1], self.newest.freeze())
        self.moves.end()
        self.note("frozen", "learning is stopped", by=by)
        return self.handled_seq

    def thaw(self, by: str = "") -> int:
        """Resume learning; the next snapshot serves what has been learnt."""
        self.supervisor.thaw()
        self._snapshots = (*self._snapshots[:-1], self.newest.thaw())
        self.note("thawed", "learning goes on", by=by)
        return self.handled_seq

    def set_frozen(self, frozen: bool, by: str) -> None:
        """Freeze or thaw unless it is so already."""
        if frozen != self.frozen:
            (self.freeze if frozen else self.thaw)(by)

    def select(self, model: str, by: str = "") -> int:
        """Let ``model`` answer where a query names none. Raises FieldError if it is not served."""
        newest = self.newest
        if model not in newest.models:
            raise FieldError("model", repr(model), f"one of {', '.join(newest.models)}")
        self._snapshots = (*self._snapshots[:-1], replace(newest, default=model))
        self.note("selected", f"{model} answers instead of {newest.default}", by=by, model=model)
        return self.handled_seq

    def rollback(self, learner: OnlineModel, checkpoint: int, by: str = "") -> int:
        """Go on with the ``learner`` of a checkpoint; numbers, memories and recording continue."""
        self.supervisor.replace(learner)
        newest = self.newest
        changed = {self.config.learn: learner.snapshot(), **champion_of(learner)}
        memories = {
            name: newest.memories[name] if newest.memories[name].size == new.memory_size else new.rest_memory(0.0)
            for name, new in changed.items()
        }
        served = replace(newest, models=newest.models | changed, memories=newest.memories | memories)
        self._snapshots = (*self._snapshots[:-1], served)
        self.moves.end()
        self.note("rolled_back", f"to checkpoint {checkpoint}", by=by, checkpoint=checkpoint)
        return self.handled_seq

    # ---- state, for checkpoints and for a standby

    def state_dict(self) -> StateDict:
        """All that samples and operators have changed, flat; copies.

        Models of the model file are not included. The learner is, with the model that it started from, so that a state
        of another identification can be refused.
        """
        served = self.newest
        answers = ServedEntries(
            served.seq, served.t_s, served.u_V, served.default, served.trust, served.trouble, served.blend_share
        )
        held = served.held if served.frozen else None
        state = save(AxisEntries(self.handled_seq, answers, self._gates, served.memories, held))
        for name, part in (("sequence", self.sequence), ("clock", self.clock), ("tracker", self.tracker)):
            state |= prefixed(f"{name}.", save(part))
        if served.frozen:
            for name in (self.config.learn, AUTO):
                if name in served.models and learns(name, self.config):
                    model = served.models[name]
                    role = f"frozen.{'auto' if name == AUTO else 'learn'}."
                    state |= {f"{role}kind": stored_kind(model), **prefixed(role, model.state_dict())}
        state |= self.supervisor.state_dict()
        return state

    def restore(self, state: StateDict) -> None:
        """Continue from ``state``. Raises ModelFileError if it does not fit; the axis is then unchanged."""
        if not any(name.startswith("sequence.") for name in state):
            raise ModelFileError(
                "it holds a learner alone, as the file of an axis of a fleet does; serve it by a [fleet], or remove it "
                "to begin with the model file"
            )
        rest = dict(state)
        sequence, clock, tracker = SequenceTracker(self.dt_s), SampleClock(self.dt_s), MemoryTracker(self.dt_s)
        try:
            for name, part in (("sequence", sequence), ("clock", clock), ("tracker", tracker)):
                with part_of(rest, f"{name}.") as kept:
                    restore(part, kept)
            theirs = [name for name in rest if name.startswith(_OF_SUPERVISOR)]
            supervisor = self.supervisor.restored({name: rest.pop(name) for name in theirs}, sequence.received)
            served, own = self._restored_snapshot(rest, supervisor)
        except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as error:
            raise ModelFileError(f"state: entry missing or damaged: {error!r}") from error
        self.sequence, self.clock, self.tracker, self.supervisor = sequence, clock, tracker, supervisor
        self._gates = own.gates
        self._snapshots = (served,)
        self.moves.end()
        self.handled_seq = own.seq
        self._update_counts()

    def _restored_snapshot(self, rest: StateDict, supervisor: LearnerSupervisor) -> tuple[Served, AxisEntries]:
        """The snapshot and the axis' own entries of ``rest``, which holds nothing else. Raises ModelFileError."""
        now = self.newest
        models = dict(now.models)
        if supervisor.learner is not None:
            good = supervisor.choice.good
            models[self.config.learn] = supervisor.learner.snapshot() if good is None else good
            models |= champion_of(supervisor.learner)
        for role, name in (("learn", self.config.learn), ("auto", AUTO)):
            with part_of(rest, f"frozen.{role}.") as kept:
                if kept and supervisor.frozen and name in models:
                    models[name] = stored_model(kept, models[name], f"the frozen model {name!r}")
        own = load(AxisEntries, rest)
        memories: dict[str, FloatArray] = {}
        for name, model in models.items():
            memories[name] = memory = own.memory.get(name, model.rest_memory(0.0))
            if memory.shape != (model.memory_size,):
                raise Refused(f"memory.{name}", f"float64 {memory.shape}", f"a shape of ({model.memory_size},)")
        s = own.served
        served = replace(
            now, seq=s.seq, t_s=s.t_s, u_V=s.u_V, models=models, memories=memories,
            default=s.default if s.default in models else now.default, trust=s.trust, trouble=s.trouble,
            blend_share=s.blend_share, frozen=False, held=None,
        )  # fmt: skip
        if not supervisor.frozen:
            return served, own
        served = served.freeze()
        if own.held is None or served.held is None:
            return served, own
        if own.held.shape != served.held.shape:
            raise Refused("held", f"float64 {own.held.shape}", f"a shape of {served.held.shape}")
        return replace(served, held=own.held), own
