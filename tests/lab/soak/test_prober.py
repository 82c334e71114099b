"""The client that probes a soak: how long there was no answer, and which answers broke a promise."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.soak import prober as prober_of
from dehyst.lab.soak.controller import ControlTask
from dehyst.lab.soak.prober import Prober
from dehyst.service.protocol.errors import NoReplyError
from dehyst.service.protocol.query import Answer, Point

CONTROL = ControlTask(1e-3, 10.0, 90.0, 1, 0.0, 100.0, 1000.0)


def a_point(u_V: float) -> Point:
    return Answer(u_V, 0.1, 0, np.zeros(3), 5, "lssvm")


def test_what_is_answered_and_what_is_not_is_counted() -> None:
    answers: list[Point | Exception] = [
        a_point(50.0), a_point(50.9), NoReplyError("none"), a_point(80.0), a_point(90.0), a_point(101.0),
        a_point(float("nan")), InputError("cannot be decoded"),
    ]  # fmt: skip
    asked: list[Point | None] = []

    def ask(before: Point | None) -> Point:
        asked.append(before)
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    prober = Prober(CONTROL, ask)
    for _ in range(8):
        prober.probe()
    counts = json.loads(prober.report())
    assert asked[3] is None, "the model may have changed"
    assert (counts["failed"], counts["unsafe"]) == (1, 4), "a step of 10 V, two beyond what may be, one unreadable"
    assert len(counts["trips_us"]) == 6
    assert prober.counts["failed"] == 0, "a new second"


def test_a_silence_is_told_while_it_lasts_and_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    answers, now_s = iter([True, False, True]), 5.0
    monkeypatch.setattr(prober_of, "time", SimpleNamespace(monotonic=lambda: now_s, perf_counter=lambda: now_s))

    def ask(_: Point | None) -> Point:
        if next(answers):
            return a_point(50.0)
        raise NoReplyError("none")

    prober = Prober(CONTROL, ask)
    prober.probe()
    now_s += 0.1
    prober.probe()
    assert json.loads(prober.report())["silent_s"] == pytest.approx(0.1)
    now_s += 0.1
    prober.probe()
    assert json.loads(prober.report())["silent_s"] == pytest.approx(0.2)
