"""What an axis tells without being asked: its models as they change, diagnostics, status and events."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, Final

import zenoh

from service.answers.latency import LatencyMeter
from service.intake.intake import Intake
from service.protocol.keys import AUTO, Keys
from service.runtime.delivery import SURELY, is_followed
from service.server.axis import Axis
from service.server.axis_answers import JSON, Answers, plain

STATUS_PERIOD_S: Final = 1.0


class Publications:
    """The publishers of one axis: all of them while it serves; one that stands by tells its status alone.

    Not for two threads at once.

    Parameters
    ----------
    instance : whose events they are, and under what name it tells its status as a standby.
    answers : encodes the models. status : makes the status.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        instance: str,
        axis: Axis,
        intake: Intake,
        latency: LatencyMeter,
        answers: Answers,
        status: Callable[[], dict[str, Any]],
    ) -> None:
        self._session, self._keys, self._instance = session, keys, instance
        self._axis, self._intake, self._latency = axis, intake, latency
        self._answers, self._status = answers, status
        self._published = axis.newest
        self._published_at = 0.0
        self._told: dict[str, Any] = {}
        self._status_at = 0.0
        self._publishers: dict[str, Any] = {}
        self._standby: Any = None

    def listen(self) -> None:
        """Tell the status of a standby from now on."""
        self._standby = self._session.declare_publisher(
            self._keys.standby(self._instance), congestion_control=zenoh.CongestionControl.DROP, encoding=JSON
        )

    def serve(self) -> None:
        """Tell everything from now on."""
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
        """Tell what has happened, and then only the status of a standby."""
        self._tell_events()
        publishers, self._publishers = self._publishers, {}
        for publisher in publishers.values():
            publisher.undeclare()

    def close(self) -> None:
        """The end of what `listen` began, after `stand_down`."""
        if self._standby is not None:
            self._standby.undeclare()
            self._standby = None

    def tick(self, now_s: float) -> None:
        """Tell what is due at ``now_s`` on a clock that never goes back."""
        due = now_s - self._status_at >= STATUS_PERIOD_S
        if due:
            self._status_at = now_s
        if self._publishers:
            self._tell_models(now_s)
            self._tell_diagnostics()
            if due:
                self._intake.want_diagnostics = is_followed(self._publishers["diagnostics"])
                self._publishers["status"].put(json.dumps(self._status(), default=plain))
            self._tell_events()
        elif due and self._standby is not None:
            self._standby.put(json.dumps(self._status(), default=plain))

    def _tell_models(self, now_s: float) -> None:
        newest, config, publishers = self._axis.newest, self._axis.config, self._publishers
        if newest is self._published or now_s - self._published_at < 1.0 / config.model_hz:
            return
        if config.learn and is_followed(publishers["model"]):
            publishers["model"].put(self._answers.encoded(config.learn))
        if AUTO in newest.models and is_followed(publishers["champion"]):
            publishers["champion"].put(self._answers.encoded(AUTO))
        self._published, self._published_at = newest, now_s

    def _tell_diagnostics(self) -> None:
        told = self._intake.diagnostics
        if told is self._told:
            return
        self._told = told
        latency = self._latency.summary()
        extra = {"counters": self._intake.counters, "query_us": {"p50": latency["p50_us"], "p99": latency["p99_us"]}}
        self._publishers["diagnostics"].put(json.dumps({**told, **extra}, default=plain))

    def _tell_events(self) -> None:
        # A standby keeps them until it serves, when they tell what has happened.
        publisher = self._publishers.get("event")
        if publisher is None:
            return
        for event in self._axis.take_events():
            publisher.put(json.dumps({**event, "instance": self._instance}))
