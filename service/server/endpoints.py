"""One axis on the wire: its subscriber, and what comes and goes with serving, down to the liveliness token."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from service.answers.answering import trust_by_age
from service.answers.latency import LatencyMeter
from service.background.retuning.retuner import Retuner
from service.intake.intake import Intake
from service.intake.sinks import SampleSink, SampleWatcher
from service.operating.journal import Journal
from service.operating.server import OperationsServer
from service.operating.verbs import Background, Verbs
from service.protocol.keys import Keys
from service.protocol.samples import decode_samples
from service.server.axis import Axis
from service.server.axis_answers import Answers
from service.server.axis_state import fingerprint
from service.server.publications import Publications
from service.server.status import axis_status
from service.storage.checkpoint import CheckpointFolder
from service.storage.checkpoint_keeper import Keeper

PRIMARY: Final = "primary"
STANDBY: Final = "standby"


class AxisServer:
    """Puts one axis on the wire.

    Samples are taken from :meth:`listen` on; queries are answered, and anything but the status of a standby is
    published, between :meth:`serve` and :meth:`stand_down`.

    Attributes
    ----------
    role : "primary" while it serves, else "standby".
    synced : whether the model is the one that is to be served: its own, or, in a standby, that of whoever serves.
    extra : what else comes and goes with serving: each declares on a session and returns what is to be undeclared.
    keeper : of the checkpoints.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        axis: Axis,
        instance: str,
        wake: Callable[[], None],
        sink: SampleSink | None = None,
        watcher: SampleWatcher | None = None,
    ) -> None:
        self.keys = keys
        self.axis = axis
        self.instance = instance
        self.role = STANDBY
        self.synced = True
        self.epoch = 0
        self.latency = LatencyMeter()
        self.intake = Intake(axis, wake, sink)
        self.watcher = self.intake.watcher = watcher
        tuned = axis.config.retuning.enabled and axis.learner is not None
        self._retuner = Retuner(axis.config.retuning, axis.config.recorder) if tuned else None
        self.operations = self._operations()
        self.extra: list[Callable[[zenoh.Session], list[Any]]] = [self.operations.declare]
        folder = axis.config.checkpoints
        self.keeper = Keeper(
            axis,
            self.intake,
            keys.stage,
            instance,
            None
            if folder is None
            else CheckpointFolder(folder, keys.stage, keys.axis, axis.dt_s, axis.config.checkpoints_kept),
        )
        axis.archive = self.keeper.folder
        self.answers = Answers(keys, axis, self.keeper, self.latency, self.status)
        self._session = session
        self._publications = Publications(
            session, keys, instance, axis, self.intake, self.latency, self.answers, self.status
        )
        self._stale = False
        self._inputs: list[Any] = []
        self._queryables: list[Any] = []
        self._token: Any = None
        self._changing = threading.RLock()

    def listen(self) -> None:
        """Take samples from now on."""
        self.intake.start()
        self._inputs = [self._session.declare_subscriber(self.keys.sample, self._on_sample)]
        self._publications.listen()

    def serve(self) -> None:
        """Answer and publish from now on; the liveliness token comes last, because alive means callable."""
        session = self._session
        with self._changing:
            self.role = PRIMARY
            # A standby does not tune: it adopts what the one that serves announces.
            self.axis.retuner = self._retuner
            self._queryables = self.answers.declare(session)
            self._publications.serve()
            for declare in self.extra:
                self._queryables += declare(session)
            self._token = session.liveliness().declare_token(self.keys.alive(self.instance))

    def stand_down(self) -> None:
        """First no longer alive, then no longer callable; samples are still taken."""
        with self._changing:
            self.role = STANDBY
            self.axis.retuner = None
            if self._token is not None:
                self._token.undeclare()
                self._token = None
            for entity in self._queryables:
                entity.undeclare()
            self._queryables = []
            self._publications.stand_down()

    def leave_tuning(self) -> None:
        """Another one serves: what was being tuned is no longer. From the thread that handles samples."""
        if self._retuner is not None:
            self._retuner.leave()

    def declare(self) -> None:
        """Take samples and serve."""
        self.listen()
        self.serve()

    def undeclare(self) -> None:
        """First no longer callable; what is queued is handled and kept, then the rest goes."""
        with self._changing:
            if self._token is not None:
                self._token.undeclare()
                self._token = None
            for entity in (*self._queryables, *self._inputs):
                entity.undeclare()
            self._queryables, self._inputs = [], []
        self.intake.close()
        if self._retuner is not None:
            self._retuner.close()
        self.keeper.close()
        if self.watcher is not None:
            self.watcher.close()
        self.stand_down()
        self._publications.close()

    def operate(self, work: Callable[[Axis], int], timeout_s: float = 2.0) -> int:
        """Do what an operator wants between two batches of samples, and have the outcome kept; returns what it does.

        Not from a callback of the wire: it waits for the learner.
        """
        seq = self.intake.call(lambda: work(self.axis), timeout_s)
        self.keeper.now(timeout_s)
        return seq

    def _operations(self) -> OperationsServer:
        def diagnose() -> Background | None:
            return None if self.watcher is None else self.watcher.request

        def retune() -> Background | None:
            return None if self.axis.retuner is None else self.axis.retuner.request

        config = self.axis.config
        verbs = Verbs(self.axis, self.operate, {"diagnose": diagnose, "retune": retune})
        journal = Journal(config.recorder or config.checkpoints)
        return OperationsServer(self.keys, self.instance, verbs, journal, self.axis.note, lambda: self.role)

    def tick(self, now_s: float) -> None:
        """Publish what is due at ``now_s`` on a clock that never goes back. Called from one thread."""
        if self.watcher is not None:
            self.watcher.tick(now_s)
        self.keeper.tick(now_s)
        self._look_at_age(now_s)
        with self._changing:
            self._publications.tick(now_s)

    def _look_at_age(self, now_s: float) -> None:
        """Samples are expected from the first one on."""
        self.axis.age_s = self.intake.age_s(now_s) or 0.0
        config = self.axis.config
        stale = trust_by_age(self.axis.age_s, config.stale_s, config.last_good_s)[1]
        if stale != self._stale:
            self._stale = stale
            if stale:
                known = f"nothing is known of the last {self.axis.age_s:.1f} s"
                why = f"{waiting} samples wait to be learnt" if (waiting := self.intake.waiting) else "no samples come"
                self.axis.note("stale", f"{known}: {why}; answers are flagged as stale")
            else:
                self.axis.note("fresh", "samples come and are learnt again")

    def status(self) -> dict[str, Any]:
        """The status as it is published."""
        age_s = self.intake.age_s(time.monotonic())
        synced = self.synced
        newest = self.axis.newest
        told = axis_status(self.keys, self.instance, self.axis, self.intake, self.latency, age_s)
        learn = self.axis.config.learn
        return {
            **told,
            # Of the very snapshot that the fingerprint below is of: another may have come since.
            "snapshot_seq": newest.seq,
            "role": self.role,
            "epoch": self.epoch,
            "synced": synced,
            "stale": self._stale,
            "trouble": newest.trouble,
            "trust": newest.trust,
            "stand_in": newest.stand_in,
            "frozen": self.axis.frozen,
            "checkpoints": self.keeper.counters(),
            "operations": self.operations.counters(),
            "fingerprint": fingerprint(newest.models[learn]) if learn else "",
        }

    def _on_sample(self, sample: zenoh.Sample) -> None:
        try:
            batch = decode_samples(sample.payload.to_bytes())
        except Exception as error:
            self.intake.malformed += 1
            if self.intake.malformed == 1:
                self.axis.note("malformed_samples", f"{error}; later ones are only counted")
            return
        self.intake.offer(batch)
