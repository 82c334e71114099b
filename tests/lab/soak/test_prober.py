"""The client that probes a soak: what is slow is an answer, what is lost is none; and what it saw, by second."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from adaptive.errors import InputError
from lab.soak.controller import ControlTask
from lab.soak.prober import OverlappingQueries, Prober
from lab.soak.verdict.observations import FaultRecord, Observations
from lab.soak.verdict.outcome import COLUMNS, write_seconds
from service.protocol.errors import NoReplyError
from service.protocol.query import Answer, Point
from tests.lab.soak.soaked import healthy

AGAIN_S = 0.1


class Slow:
    """Answers ``points`` in turn, each after its time; more than one may be asked for at a time."""

    def __init__(self, *points: tuple[float, Point | Exception]) -> None:
        self._points, self._lock = list(points), threading.Lock()
        self.asked_s: list[float] = []

    def __call__(self, _: object) -> Point:
        with self._lock:
            self.asked_s.append(time.monotonic())
            wait_s, point = self._points.pop(0) if len(self._points) > 1 else self._points[0]
        time.sleep(wait_s)
        if isinstance(point, Exception):
            raise point
        return point


def a_point(u_V: float) -> Point:
    return Answer(u_V, 0.1, 0, np.zeros(3), 5, "lssvm")


@contextmanager
def probing(answers: Slow, ways: int = 4) -> Iterator[Prober]:
    control = ControlTask(1e-3, 10.0, 90.0, 1, 0.0, 100.0, 1000.0)
    with OverlappingQueries([answers] * ways, AGAIN_S) as points, OverlappingQueries([len], AGAIN_S) as echoes:
        yield Prober(control, points, echoes)


def ask_for(prober: Prober, time_s: float) -> None:
    until = time.monotonic() + time_s
    while time.monotonic() < until:
        prober.ask()
        prober.echo(b"12345")


@pytest.mark.alone
def test_answers_slower_than_the_next_question_end_the_silence() -> None:
    """Each takes half as long again as an answer is waited for: given up at that time there would never be one."""
    with probing(Slow((1.5 * AGAIN_S, a_point(50.0)))) as prober:
        ask_for(prober, 8 * AGAIN_S)
    told = prober.counts
    assert len(told["service_us"]) >= 4
    assert min(told["service_us"]) >= 1.5e6 * AGAIN_S, "their whole time"
    assert told["silent_s"] < 4 * AGAIN_S
    assert (told["failed"], told["unsafe"]) == (0, 0)
    assert len(told["echo_us"]) >= 4


@pytest.mark.alone
def test_a_lost_answer_costs_no_more_than_asking_again() -> None:
    answers = Slow((8 * AGAIN_S, NoReplyError("lost")), (0.0, a_point(50.0)))
    with probing(answers) as prober:
        prober.ask()
        assert not prober.counts["service_us"]
        prober.ask()
        assert len(prober.counts["service_us"]) == 1
        assert answers.asked_s[1] - answers.asked_s[0] < 4 * AGAIN_S
        time.sleep(9 * AGAIN_S)
        prober.ask()
    assert prober.counts["failed"] == 1
    assert prober.counts["error"] == "lost"


@pytest.mark.alone
def test_a_silence_is_told_while_it_lasts_and_no_more_are_asked_than_there_are_ways() -> None:
    answers = Slow((6 * AGAIN_S, NoReplyError("silent")))
    with probing(answers, ways=2) as prober:
        for _ in range(4):
            prober.ask()
        assert len(answers.asked_s) == 2
        assert '"silent_s": 0.' in prober.report()
        ask_for(prober, 4 * AGAIN_S)
        assert prober.counts["failed"] >= 2
        assert not prober.counts["service_us"]


@pytest.mark.parametrize(("second_V", "unsafe"), [(51.0, 0), (51.1, 1), (float("nan"), 1), (-0.5, 1)])
def test_what_an_answer_promised_is_held_against_the_voltage_before(second_V: float, unsafe: int) -> None:
    with probing(Slow((0.0, a_point(50.0)), (0.0, a_point(second_V)))) as prober:
        prober.ask()
        prober.ask()
    assert prober.counts["unsafe"] == unsafe
    assert len(prober.counts["service_us"]) == 2


def test_an_answer_that_cannot_be_read_is_unsafe() -> None:
    with probing(Slow((0.0, InputError("u_V: 3 bytes")))) as prober:
        prober.ask()
    assert (prober.counts["unsafe"], prober.counts["failed"], prober.counts["error"]) == (1, 0, "u_V: 3 bytes")


def rows_of(observed: Observations, path: Path) -> list[dict[str, str]]:
    write_seconds(path, observed)
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_second_of_a_run_has_its_row(tmp_path: Path) -> None:
    observed = healthy(40)
    observed.faults.append(FaultRecord("nan", 38.5))
    observed.loop_delays, observed.other_load = [(20.4, 0.012), (20.9, 0.3)], [(20.2, 0.25)]
    del observed.query_seconds[30], observed.seconds[30]
    rows = rows_of(observed, tmp_path / "seconds.csv")
    assert tuple(rows[0]) == COLUMNS
    assert [row["t_s"] for row in rows] == [str(k) for k in range(40)]
    assert [row["fault"] for row in rows] == [""] * 10 + ["gap"] * 2 + [""] * 26 + ["nan"] * 2
    assert [rows[k]["calm"] for k in (5, 11, 25, 39)] == ["1", "0", "1", "0"]
    seen = rows[20]
    assert (seen["samples"], seen["held"], seen["answers"], seen["failed"]) == ("1000", "0", "2", "0")
    assert (seen["error_mean_pct"], seen["error_max_pct"]) == (f"{3 / 76:.4f}", f"{200 / 76:.4f}")
    assert (seen["query_p50_us"], seen["query_max_us"], seen["echo_p50_us"], seen["echo_max_us"]) == (
        "210", "220", "155", "160"
    )  # fmt: skip
    assert (seen["silent_s"], seen["snapshot_age_max_s"]) == ("0.0200", "0.0300")
    assert (seen["bare_late_s"], seen["others_share"]) == ("0.30000", "0.25000")
    assert set(rows[30].values()) == {"30", "1", "", "0"}, "nothing was seen"
    assert rows[21]["bare_late_s"] == ""
