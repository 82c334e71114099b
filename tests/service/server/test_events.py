"""Events of an axis: kept for the publisher, limited, and logged through the standard library."""

from __future__ import annotations

import logging
import subprocess
import sys

import pytest

from service.server.events import EventLimiter, EventLog


def test_of_a_flood_one_event_is_told() -> None:
    limiter = EventLimiter(calm=100)
    told = [k for k in range(1000) if k % 50 == 0 and limiter.allows("a", k)]
    assert told == [0]
    assert limiter.allows("b", 1000)
    assert not limiter.allows("a", 1050)
    assert limiter.allows("a", 1151)


def test_every_event_is_logged_with_the_level_of_its_kind(caplog: pytest.LogCaptureFixture) -> None:
    events = EventLog("demo", "x")
    with caplog.at_level(logging.INFO, "dehyst"):
        events.note(7, "selected", "linear answers instead of auto", by="alice")
        events.note(8, "trouble", "sensor_frozen: the last good model is served")
        events.note(9, "learner_failed", "ZeroDivisionError: no")
    logged = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
    assert logged == [
        ("dehyst.axis.demo.x", "INFO", "selected: linear answers instead of auto (sample 7)"),
        ("dehyst.axis.demo.x", "WARNING", "trouble: sensor_frozen: the last good model is served (sample 8)"),
        ("dehyst.axis.demo.x", "ERROR", "learner_failed: ZeroDivisionError: no (sample 9)"),
    ]
    taken = events.take()
    assert [(event["seq"], event["event"], event.get("by")) for event in taken] == [
        (7, "selected", "alice"), (8, "trouble", None), (9, "learner_failed", None),
    ]  # fmt: skip
    assert events.take() == []


def test_a_flood_keeps_the_newest() -> None:
    events = EventLog("", "x")
    for seq in range(1000):
        events.note(seq, "numbers_ahead", "")
    assert [event["seq"] for event in events.take()] == list(range(744, 1000))


def test_a_program_without_logging_stays_quiet() -> None:
    program = "from service.server.events import EventLog; EventLog('demo', 'x').note(1, 'learner_failed', 'no')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
