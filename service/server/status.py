"""What an axis publishes: status, models, diagnostics and events; docs/protocol.md lists the fields."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, Final

import zenoh

from dehyst.service.protocol.container import JSON, to_json
from dehyst.service.protocol.keys import AUTO, Keys
from dehyst.service.protocol.model import fingerprint, stored_kind
from dehyst.service.runtime.session import SURELY, is_followed
from dehyst.service.security.authenticator import NO_KEY, Authenticator
from dehyst.service.server.axis_loop import AxisLoop
from dehyst.service.server.deltas import DeltaStreams
from dehyst.service.server.query_answers import LatencyMeter, QueryAnswers

# --- The status of one axis, as JSON; docs/protocol.md lists the fields.

#: Fields of the learner's diagnostics that a status repeats.
_QUALITY: Final = (
    "recent_rms_error_pct", "rms_error_pct", "share_within_std", "std_V", "gain", "offset_V", "valid", "fallback",
    "window_residual_V", "window_cholesky",
)  # fmt: skip


def axis_fields(loop: AxisLoop, stale: bool = False, losses: str = "") -> dict[str, Any]:
    """What the loop of an axis tells of itself; JSON values only. From any thread.

    ``stale`` : whether its newest sample is too old. ``losses`` : name of the way in which samples are lost, on the way
    here or to the disk.
    """
    axis, queue, figures = loop.axis, loop.queue, loop.figures
    # One snapshot and one set of counts for all fields: others may come meanwhile.
    served, counts, learn = axis.newest, axis.counts, axis.config.learn
    trouble = served.trouble or losses
    queue_dropped, thinned = queue.dropped, loop.thinner.thinned
    return {
        "dt_s": axis.dt_s,
        "served": served.default,
        "learning": learn if axis.learning else None,
        "models": {
            name: {"kind": stored_kind(model), "memory_size": model.memory_size}
            for name, model in served.models.items()
        },
        "limits": axis.limits.to_json(),
        "seq": counts.seq,
        "snapshot_seq": served.seq,
        "snapshot_every": axis.config.snapshot_every,
        "snapshots_kept": axis.config.snapshots_kept,
        "delta_hz": axis.config.delta_hz,
        "correction": asdict(axis.config.correction) if axis.config.correction.on else None,
        "repetition": asdict(axis.config.repetition) if axis.config.repetition.on else None,
        "corrected": None if axis.correction is None else axis.correction.status(),
        "sample_age_s": queue.age_s(time.monotonic()),
        "samples": {
            **counts.samples,
            "received": counts.samples["received"] + queue_dropped + thinned,
            "thinned": thinned,
            "dropped": queue_dropped,
            "malformed": queue.malformed,
            "waiting": queue.waiting,
            "learnt": counts.gates.get("learnt", 0),
            "gates": counts.gates,
        },
        "learner": figures.counters,
        "quality": {name: figures.diagnostics[name] for name in _QUALITY if name in figures.diagnostics},
        "competition": figures.standing,
        "retuning": None if loop.tuner is None else loop.tuner.status(),
        "recorder": None if loop.sink is None else loop.sink.counters(),
        "diagnosis": None if loop.watcher is None else loop.watcher.status(),
        "thinning": loop.thinner.factor,
        "stale": stale,
        "trouble": trouble,
        "trouble_why": axis.trouble_why(trouble),
        "trust": served.trust,
        "stand_in": served.stand_in,
        "answering": axis.answering(),
        "frozen": axis.frozen,
        "fingerprint": fingerprint(served.models[learn]) if learn else "",
        "warnings": list(axis.warnings.values()),
    }


#: Time over which the rate of writing is taken, s: some checkpoints.
_RATE_S: Final = 60.0


class WriteRate:
    """Bytes that an axis writes to the disk, and how many a second."""

    def __init__(self) -> None:
        self._marks: deque[tuple[float, int]] = deque()

    def look(self, now_s: float, total: int) -> dict[str, float | None]:
        """``bytes`` in all, and ``bytes_per_s``, the mean of the last minute; null in the first second."""
        marks = self._marks
        if not marks or now_s - marks[-1][0] >= 1.0:
            marks.append((now_s, total))
        while len(marks) > 2 and now_s - marks[1][0] >= _RATE_S:
            marks.popleft()
        passed_s = now_s - marks[0][0]
        return {"bytes": total, "bytes_per_s": round((total - marks[0][1]) / passed_s, 1) if passed_s >= 1.0 else None}


# --- Publishes what changes on an axis: models, diagnostics, status and events.

STATUS_PERIOD_S: Final = 1.0


class Publications:
    """The publishers of one axis: all of them while it serves; a standby publishes its status alone.

    One thread at a time calls it.

    Parameters
    ----------
    instance : sender of the events, and name under which a standby publishes its status.
    answers : encodes the models. status : makes the status. deltas : the models whose changes are published.
    authenticator : signs models, changes and status.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        instance: str,
        loop: AxisLoop,
        latency: LatencyMeter,
        answers: QueryAnswers,
        status: Callable[[], dict[str, Any]],
        deltas: DeltaStreams,
        authenticator: Authenticator = NO_KEY,
    ) -> None:
        self._by = authenticator
        self._deltas = deltas
        self._session, self._keys, self._instance = session, keys, instance
        self._axis, self._loop, self._latency = loop.axis, loop, latency
        self._answers, self._status = answers, status
        self._published = self._axis.newest
        self._published_at_s = 0.0
        self._diagnostics: dict[str, Any] = {}
        self._status_at_s = 0.0
        self._publishers: dict[str, Any] = {}

    def _declare(self, name: str, key: str, drop: bool = True, **options: Any) -> Any:
        congestion = zenoh.CongestionControl.DROP if drop else SURELY
        publisher = self._session.declare_publisher(key, congestion_control=congestion, **options)
        self._publishers[name] = publisher
        return publisher

    def listen(self) -> None:
        """Publish the status of a standby from now on."""
        self._declare("standby", self._keys.standby(self._instance), encoding=JSON)

    def serve(self) -> None:
        """Publish everything from now on."""
        keys = self._keys
        self._declare("model", keys.model)
        self._declare("champion", keys.champion)
        self._declare("diagnostics", keys.diagnostics, encoding=JSON)
        self._declare("status", keys.status, encoding=JSON)
        self._declare("event", keys.event, drop=False, encoding=JSON)
        if self._axis.config.delta_hz > 0.0 and self._axis.config.learn:
            for key, name in ((keys.model_delta, self._axis.config.learn), (keys.champion_delta, AUTO)):
                if name in self._axis.newest.models:
                    # A class of its own: in that of the samples, which pass through here, two waiting messages fill
                    # the queue, and a change would be dropped.
                    publisher = self._declare(key, key, express=True, priority=zenoh.Priority.INTERACTIVE_HIGH)
                    self._deltas.publish(name, partial(self._put, key), partial(is_followed, publisher))

    def stand_down(self) -> None:
        """Publish the events that wait, and then only the status of a standby."""
        self.publish_events()
        self._deltas.close()
        for name in self._publishers.keys() - {"standby"}:
            self._publishers.pop(name).undeclare()

    def close(self) -> None:
        """End what `listen` began; after `stand_down`."""
        if standby := self._publishers.pop("standby", None):
            standby.undeclare()

    def tick(self, now_s: float) -> None:
        """Publish what is due at ``now_s`` (``time.monotonic``)."""
        due = now_s - self._status_at_s >= STATUS_PERIOD_S
        if due:
            self._status_at_s = now_s
        if "status" in self._publishers:
            self._deltas.tick(now_s)
            self._publish_models(now_s)
            self._publish_diagnostics()
            if due:
                self._loop.figures.follow(is_followed(self._publishers["diagnostics"]))
                self._put("status", to_json(self._status()))
            self.publish_events()
        elif due and "standby" in self._publishers:
            self._put("standby", to_json(self._status()))

    def _put(self, name: str, payload: bytes) -> None:
        """Publish what others act upon."""
        publisher = self._publishers[name]
        publisher.put(payload, attachment=self._by.published(str(publisher.key_expr), payload))

    def _publish_models(self, now_s: float) -> None:
        newest, config, publishers = self._axis.newest, self._axis.config, self._publishers
        if newest is self._published or now_s - self._published_at_s < 1.0 / config.model_hz:
            return
        if config.learn and is_followed(publishers["model"]):
            self._put("model", self._answers.encoded(config.learn))
        if AUTO in newest.models and is_followed(publishers["champion"]):
            self._put("champion", self._answers.encoded(AUTO))
        self._published, self._published_at_s = newest, now_s

    def _publish_diagnostics(self) -> None:
        figures = self._loop.figures
        diagnostics = figures.diagnostics
        if diagnostics is self._diagnostics:
            return
        self._diagnostics = diagnostics
        latency = self._latency.summary()
        extra = {"counters": figures.counters, "query_us": {"p50": latency["p50_us"], "p99": latency["p99_us"]}}
        self._publishers["diagnostics"].put(to_json({**diagnostics, **extra}))

    def publish_events(self) -> None:
        """Publish the events that wait."""
        # A standby keeps its events until it serves.
        publisher = self._publishers.get("event")
        if publisher is None:
            return
        for event in self._axis.take_events():
            publisher.put(json.dumps({**event, "instance": self._instance}))
