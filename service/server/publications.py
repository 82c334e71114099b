"""Publishes what changes on an axis: models, diagnostics, status and events."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, Final

import zenoh

from service.protocol.json_message import JSON, to_json
from service.protocol.keys import AUTO, Keys
from service.runtime.delivery import SURELY, is_followed
from service.server.axis_loop import AxisLoop
from service.server.latency import LatencyMeter
from service.server.query_answers import QueryAnswers

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
