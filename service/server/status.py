"""What an axis publishes: status, models, diagnostics and events; docs/protocol.md lists the fields."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from service.protocol.container import JSON, to_json
from service.protocol.keys import AUTO, Keys
from service.protocol.model_classes import stored_kind
from service.protocol.samples import VERSION
from service.runtime.memory import in_use
from service.runtime.session import SURELY, is_followed
from service.security.refusals import refusal_counters
from service.server.axis import SampleCounts
from service.server.axis_loop import AxisLoop
from service.server.health import Health
from service.server.learner_supervisor import fingerprint
from service.server.query_answers import LatencyMeter, QueryAnswers

# --- The status of one axis, as JSON; docs/protocol.md lists the fields.

SCHEMA: Final = 1
#: Fields of the learner's diagnostics that a status repeats.
_QUALITY: Final = (
    "recent_rms_error_pct", "rms_error_pct", "share_within_std", "std_V", "gain", "offset_V", "valid", "fallback",
    "window_residual_V", "window_cholesky",
)  # fmt: skip


def axis_status(
    keys: Keys,
    instance: str,
    loop: AxisLoop,
    latency: LatencyMeter,
    *,
    role: str = "primary",
    epoch: int = 0,
    synced: bool = True,
    stale: bool = False,
    checkpoints: dict[str, Any] | None = None,
    operations: dict[str, int] | None = None,
    health: Health | None = None,
) -> dict[str, Any]:
    """The fields for clients, operators and viewers; JSON values only. From any thread.

    ``checkpoints``, ``operations`` : their counters.
    """
    axis, queue, figures = loop.axis, loop.queue, loop.figures
    # One snapshot and one set of counts for all fields: others may come meanwhile.
    served, counts, learn = axis.newest, axis.counts, axis.config.learn
    queue_dropped, thinned = queue.dropped, loop.thinner.thinned
    status = {
        "schema": SCHEMA,
        "wire": VERSION,
        "stage": keys.stage,
        "axis": keys.axis,
        "instance": instance,
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
        "sample_age_s": queue.age_s(time.monotonic()),
        "samples": {
            **_samples(counts, queue_dropped + thinned),
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
        "queries": latency.summary(),
        "diagnosis": None if loop.watcher is None else loop.watcher.status(),
        "refused": refusal_counters(),
        "memory": in_use(),
        "role": role,
        "epoch": epoch,
        "synced": synced,
        "stale": stale,
        "trouble": served.trouble,
        "trust": served.trust,
        "stand_in": served.stand_in,
        "frozen": axis.frozen,
        "checkpoints": checkpoints,
        "operations": operations,
        "fingerprint": fingerprint(served.models[learn]) if learn else "",
    }
    health = health or Health()
    state, reason = health.state(status, loop.thinner.factor)
    return {
        **status,
        "state": state,
        "state_reason": reason,
        "warnings": list(axis.warnings.values()),
        "rate_per_s": None if health.per_s is None else round(health.per_s, 1),
        "thinning": loop.thinner.factor,
    }


def _samples(counts: SampleCounts, not_handled: int) -> dict[str, int]:
    """The counters by order of arrival. Samples that came and were not handled are received, and none of the lost."""
    samples = counts.samples
    received, lost = samples["received"] + not_handled, max(0, samples["lost"] - not_handled)
    return {**samples, "received": received, "lost": lost}


# --- Publishes what changes on an axis: models, diagnostics, status and events.

STATUS_PERIOD_S: Final = 1.0


class Publications:
    """The publishers of one axis: all of them while it serves; a standby publishes its status alone.

    One thread at a time calls it.

    Parameters
    ----------
    instance : sender of the events, and name under which a standby publishes its status.
    answers : encodes the models. status : makes the status.
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
    ) -> None:
        self._session, self._keys, self._instance = session, keys, instance
        self._axis, self._loop, self._latency = loop.axis, loop, latency
        self._answers, self._status = answers, status
        self._published = self._axis.newest
        self._published_at_s = 0.0
        self._diagnostics: dict[str, Any] = {}
        self._status_at_s = 0.0
        self._publishers: dict[str, Any] = {}
        self._standby: Any = None

    def listen(self) -> None:
        """Publish the status of a standby from now on."""
        self._standby = self._session.declare_publisher(
            self._keys.standby(self._instance), congestion_control=zenoh.CongestionControl.DROP, encoding=JSON
        )

    def serve(self) -> None:
        """Publish everything from now on."""
        session, keys = self._session, self._keys
        drop = zenoh.CongestionControl.DROP
        self._publishers = {
            "model": session.declare_publisher(keys.model, congestion_control=drop),
            "champion": session.declare_publisher(keys.champion, congestion_control=drop),
            "diagnostics": session.declare_publisher(keys.diagnostics, congestion_control=drop, encoding=JSON),
            "status": session.declare_publisher(keys.status, congestion_control=drop, encoding=JSON),
            "event": session.declare_publisher(keys.event, congestion_control=SURELY, encoding=JSON),
        }

    def stand_down(self) -> None:
        """Publish the events that wait, and then only the status of a standby."""
        self._publish_events()
        publishers, self._publishers = self._publishers, {}
        for publisher in publishers.values():
            publisher.undeclare()

    def close(self) -> None:
        """End what `listen` began; after `stand_down`."""
        if self._standby is not None:
            self._standby.undeclare()
            self._standby = None

    def tick(self, now_s: float) -> None:
        """Publish what is due at ``now_s`` (``time.monotonic``)."""
        due = now_s - self._status_at_s >= STATUS_PERIOD_S
        if due:
            self._status_at_s = now_s
        if self._publishers:
            self._publish_models(now_s)
            self._publish_diagnostics()
            if due:
                self._loop.figures.follow(is_followed(self._publishers["diagnostics"]))
                self._publishers["status"].put(to_json(self._status()))
            self._publish_events()
        elif due and self._standby is not None:
            self._standby.put(to_json(self._status()))

    def _publish_models(self, now_s: float) -> None:
        newest, config, publishers = self._axis.newest, self._axis.config, self._publishers
        if newest is self._published or now_s - self._published_at_s < 1.0 / config.model_hz:
            return
        if config.learn and is_followed(publishers["model"]):
            publishers["model"].put(self._answers.encoded(config.learn))
        if AUTO in newest.models and is_followed(publishers["champion"]):
            publishers["champion"].put(self._answers.encoded(AUTO))
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

    def _publish_events(self) -> None:
        # A standby keeps its events until it serves.
        publisher = self._publishers.get("event")
        if publisher is None:
            return
        for event in self._axis.take_events():
            publisher.put(json.dumps({**event, "instance": self._instance}))
