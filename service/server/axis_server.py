"""One axis on the wire: its subscriber, and its queryables, publishers and liveliness token while it serves."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from dehyst.service.background.retuner import Retuner
from dehyst.service.background.watcher import Watcher
from dehyst.service.failover.state_transfer import tell_standbys
from dehyst.service.intake.sample_queue import SampleQueue
from dehyst.service.operating.server import Journal, OperationsServer
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.samples import VERSION, decode_samples
from dehyst.service.runtime.memory import in_use
from dehyst.service.security.authenticator import Authenticator, HeardSamples
from dehyst.service.security.lease import Holders
from dehyst.service.security.refusals import refusal_counters
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loop import AxisLoop
from dehyst.service.server.axis_verbs import Background, axis_verbs
from dehyst.service.server.deltas import DeltaStreams
from dehyst.service.server.health import Arrivals, DiskFailures, Health, SampleLosses, Staleness
from dehyst.service.server.long_queries import LongQueries
from dehyst.service.server.query_answers import LatencyMeter, QueryAnswers
from dehyst.service.server.status import Publications, WriteRate, axis_fields
from dehyst.service.storage.checkpoint import CheckpointFolder, CheckpointKeeper
from dehyst.service.storage.recorder import Recorder, RecorderConfig

PRIMARY: Final = "primary"
STANDBY: Final = "standby"
#: Version of the status.
SCHEMA: Final = 1
#: Warning of a service without a key.
UNSIGNED: Final = "open: without a key nothing is signed, and everybody on the wire is believed; see docs/access.md"
#: How long a start waits for a process that still holds a folder of its recordings or checkpoints, s.
HOLD_S: Final = 5.0
#: Period at which the rates of the state are taken, s.
HEALTH_S: Final = 1.0
#: Longest time for which an operator's command waits for the learner, s.
_OPERATE_S: Final = 2.0
#: Longest time for which the answer to an operator waits for the checkpoint of the outcome, s.
_WRITTEN_S: Final = 1.0
#: Longest time for which it waits for the standbys to take the outcome, s.
_TOLD_S: Final = 1.0


class AxisServer:
    """Puts one axis on the wire.

    Samples are taken from `listen` on. Queries are answered, and anything but the status of a standby is published,
    between `serve` and `stand_down`.

    Parameters
    ----------
    instance : name of this process on the wire. wake : wakes the publishing thread, which calls `tick`.
    authenticator : signs what is sent, and checks what others of this service send.
    long_queries : of all axes of the process.

    Raises FieldError where the folder of its recordings is another's.

    Attributes
    ----------
    role : "primary" while it serves, else "standby". epoch : number of its take-over, see `RoleControl`.
    synced : whether the model is the one to be served: its own, or, of a standby, that of the serving instance.
    claims_refused : count of claims whose instance did not prove that it serves.
    loop : the thread of the axis. checkpoints : writes them.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        axis: Axis,
        instance: str,
        wake: Callable[[], None],
        authenticator: Authenticator,
        long_queries: LongQueries,
    ) -> None:
        self.keys = keys
        self.authenticator = authenticator
        self._samples = HeardSamples(authenticator, keys.sample)
        self.axis = axis
        self.instance = instance
        self.role = STANDBY
        self.synced = True
        self.epoch = 0
        self.claims_refused = 0
        #: Count of all samples when the last command was applied.
        self._operated_at = 0
        config = axis.config
        queue = SampleQueue(config.name, config.queue_samples)
        recorder = None
        if config.recorder is not None:
            settings = RecorderConfig(config.recorder, axis.owner, max_bytes=config.recorder_bytes)
            recorder = Recorder(settings, hold_s=HOLD_S)
        folder = None
        if config.checkpoints is not None:
            folder = CheckpointFolder(
                config.checkpoints, keys.stage, keys.axis, axis.dt_s, axis.identified, config.checkpoints_kept
            )
        self.checkpoints = CheckpointKeeper(axis, queue, keys.stage, instance, folder)
        watcher = Watcher(axis, config.diagnosis) if config.diagnosis.enabled else None
        tuned = config.retuning.enabled and axis.learner is not None
        retuner = Retuner(config.retuning, config.recorder) if tuned else None
        self.loop = AxisLoop(axis, queue, wake, recorder, watcher, retuner, self.checkpoints.on_snapshot)
        self._latency = LatencyMeter()
        self._long_queries = long_queries
        deltas = DeltaStreams(axis)
        self._answers = QueryAnswers(
            keys, axis, self.checkpoints, self._latency, self.status, self._long_queries, authenticator, deltas
        )
        self._operations = self._operations_server(session)
        self._publications = Publications(
            session, keys, instance, self.loop, self._latency, self._answers, self.status, deltas, authenticator
        )
        self._session = session
        self._staleness = Staleness(config.stale_s)
        self._losses = SampleLosses()
        self._disk_failures = DiskFailures()
        self._write_rate = WriteRate()
        self._health = Health()
        self._health_at_s = -math.inf
        self._inputs: list[Any] = []
        self._holders: Holders | None = None
        self._queryables: list[Any] = []
        self._token: Any = None
        self._changing = threading.RLock()

    # ---- roles

    def listen(self) -> None:
        """Take samples from now on."""
        self.loop.start()
        self._holders = Holders(self._session, self.keys, self.authenticator)
        self._inputs = [self._session.declare_subscriber(self.keys.sample, self._on_sample), self._holders]
        self._publications.listen()

    def serve(self) -> None:
        """Answer and publish from now on. The liveliness token comes last: clients query an instance that has one."""
        session = self._session
        with self._changing:
            self.role = PRIMARY
            self.loop.set_tuning(True)
            self._queryables = self._answers.declare(session)
            self._publications.serve()
            self._queryables += self._operations.declare(session)
            self._token = session.liveliness().declare_token(self.keys.alive(self.instance))

    def stand_down(self) -> None:
        """Withdraw the liveliness token, then the queryables; samples are still taken."""
        with self._changing:
            self.role = STANDBY
            self.loop.set_tuning(False)
            if self._token is not None:
                self._token.undeclare()
                self._token = None
            for entity in self._queryables:
                entity.undeclare()
            self._queryables = []
            self._publications.stand_down()

    def leave_tuning(self) -> None:
        """Drop the tuning under way, because another instance serves. From the thread of the axis."""
        if self.loop.retuner is not None:
            self.loop.retuner.leave()

    def set_synced(self, synced: bool) -> None:
        """Whether the model is the one to be served."""
        self.synced = synced

    def set_epoch(self, epoch: int) -> None:
        """The number of this instance's take-over."""
        self.epoch = epoch

    def set_claims_refused(self, count: int) -> None:
        """How many claims were ignored because their instance did not prove that it serves."""
        self.claims_refused = count

    def undeclare(self) -> None:
        """First no longer callable; what is queued is handled and kept, then the rest ends."""
        with self._changing:
            if self._token is not None:
                self._token.undeclare()
                self._token = None
            for entity in (*self._queryables, *self._inputs):
                entity.undeclare()
            self._queryables, self._inputs = [], []
        self.loop.close()
        if self.loop.retuner is not None:
            self.loop.retuner.close()
        self.checkpoints.close()
        if self.loop.watcher is not None:
            self.loop.watcher.close()
        self.stand_down()
        self._publications.close()

    # ---- operator's commands

    def _operate(self, work: Callable[[], int]) -> int:
        """Run an operator's command before the samples that wait, and copy the outcome for a checkpoint.

        Returns what ``work`` returns. Not from a callback of the wire, because it waits for the learner.
        """

        def apply() -> int:
            seq = work()
            self._operated_at = self.axis.sequence.received
            self.checkpoints.copy_now()
            return seq

        return self.loop.queue.call(apply, _OPERATE_S, urgent=True)

    def journal(self) -> Journal:
        """The operators' journal of the axis."""
        config = self.axis.config
        return Journal(config.recorder or config.checkpoints)

    def _operations_server(self, session: zenoh.Session) -> OperationsServer:
        def diagnose() -> Background | None:
            return None if self.loop.watcher is None else self.loop.watcher.request

        def retune() -> Background | None:
            return None if self.loop.tuner is None else self.loop.tuner.request

        background = {"diagnose": diagnose, "retune": retune}
        return OperationsServer(
            self.keys,
            self.instance,
            axis_verbs(self.axis, self.checkpoints, self._operate, background),
            self.journal(),
            self.axis.note,
            lambda: self.role,
            samples=lambda: self._operated_at,
            tell=lambda: tell_standbys(session, self.keys.switch, _TOLD_S, self.authenticator),
            settle=lambda: self.checkpoints.wait_written(_WRITTEN_S),
            background=tuple(background),
            authenticator=self.authenticator,
        )

    # ---- the publishing thread

    def tick(self, now_s: float) -> None:
        """Publish what is due at ``now_s`` (``time.monotonic``). One thread calls it."""
        if self.loop.watcher is not None:
            self.loop.watcher.tick(now_s)
        self._update_age(now_s)
        self._look_for_losses(now_s)
        if now_s - self._health_at_s >= HEALTH_S:
            self._health_at_s = now_s
            self._look_at_disk()
            samples = axis_fields(self.loop)["samples"]
            self._health.update(now_s, samples["received"], samples["dropped"], samples["gates"])
        with self._changing:
            self._publications.tick(now_s)

    def _update_age(self, now_s: float) -> None:
        """Tell the axis the age of its samples, and note when they become stale."""
        age_s = self.loop.queue.age_s(now_s)
        self.axis.update_age(age_s)
        age_s = age_s or 0.0
        if not self._staleness.look(age_s):
            return
        if self._staleness.stale:
            waiting = self.loop.queue.waiting
            why = f"{waiting} samples wait to be learnt" if waiting else "no samples come"
            detail = f"nothing is known of the last {age_s:.1f} s: {why}; answers are flagged as stale"
            self.axis.note("stale", detail)
        else:
            self.axis.note("fresh", "samples come and are learnt again")

    def _look_for_losses(self, now_s: float) -> None:
        """Note when samples come and are lost, and when that is over."""
        queue, counts, before = self.loop.queue, self.axis.counts, self._losses.trouble
        received, lost = counts.samples["received"], counts.samples["lost"]
        arrivals = Arrivals(received, counts.refused, counts.foreign, queue.dropped, queue.malformed, lost)
        if self._losses.look(now_s, arrivals):
            self._note_trouble(before, self._losses.trouble, self._losses.why)

    def _look_at_disk(self) -> None:
        """Note when samples or checkpoints do not reach the disk, and when that is over."""
        failures, before = self._disk_failures, self._disk_failures.trouble
        if failures.look(self._recorder(), self.checkpoints.counters()):
            self._note_trouble(before, failures.trouble, failures.why)

    def _note_trouble(self, before: str, now: str, why: str) -> None:
        if now:
            self.axis.note("trouble", f"{now} ({why})")
        else:
            self.axis.note("recovered", before)

    def _recorder(self) -> dict[str, Any] | None:
        return None if self.loop.sink is None else self.loop.sink.counters()

    def status(self) -> dict[str, Any]:
        """The status as it is published; JSON values only, docs/protocol.md lists the fields. From any thread."""
        config, signed = self.axis.config, bool(self.authenticator)
        status = axis_fields(self.loop, self._staleness.stale, self._losses.trouble or self._disk_failures.trouble)
        state, reason = self._health.state(status)
        return {
            "schema": SCHEMA,
            "wire": VERSION,
            "stage": self.keys.stage,
            "axis": self.keys.axis,
            "instance": self.instance,
            "role": self.role,
            "epoch": self.epoch,
            "synced": self.synced,
            "state": state,
            "state_reason": reason,
            "rate_per_s": None if self._health.per_s is None else round(self._health.per_s, 1),
            **status,
            "warnings": [*status["warnings"], *([] if signed else [UNSIGNED])],
            "queries": {
                **self._latency.summary(),
                "max_points": config.query_points,
                "waiting_points": self._long_queries.waiting_points,
                "far_ahead": self.axis.far_ahead,
            },
            "checkpoints": self.checkpoints.counters(),
            "operations": self._operations.counters(),
            "peers": {
                "claims_refused": self.claims_refused,
                "states_refused": self._answers.states_refused,
                "samples_refused": self._samples.refused,
            },
            "command": None if self._holders is None else self._holders.to_json(),
            "disk": self._disk(),
            "refused": refusal_counters(),
            "memory": in_use(),
        }

    def _disk(self) -> dict[str, float | None] | None:
        """What is written to the disk; None where neither samples nor checkpoints are kept."""
        recorder, kept = self._recorder(), self.checkpoints
        if recorder is None and kept.folder is None:
            return None
        recorded = 0 if recorder is None else int(recorder.get("bytes", 0))
        with self._changing:
            return self._write_rate.look(time.monotonic(), recorded + kept.bytes_in_all)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        payload = self._samples.take(sample)
        if payload is None:
            if self._samples.refused == 1:
                detail = "messages without the authenticator of the stage are left out; later ones are only counted"
                self.axis.note("samples_refused", detail)
            return
        try:
            batch = decode_samples(payload)
        except Exception as error:
            if self.loop.queue.count_malformed() == 1:
                self.axis.note("malformed_samples", f"{error}; later ones are only counted")
            return
        self.loop.offer(batch)
