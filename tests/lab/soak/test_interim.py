"""A soak is judged while it runs: each minute by itself, what cannot be told yet left out, and the files whole."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lab.soak.verdict import outcome
from lab.soak.verdict.interim import EVERY_S, InterimJudge
from lab.soak.verdict.invariants import TRACKING_PCT
from lab.soak.verdict.observations import FaultRecord, Observations
from service.storage import atomic_write
from tests.lab.soak.soaked import healthy, verdict


class Run:
    """A healthy run that is told to an `Interim` second by second, as a soak does."""

    def __init__(self, folder: Path, duration_s: int = 200, tracking_pct: float | None = TRACKING_PCT) -> None:
        self.whole = healthy(duration_s)
        self.seen = replace(self.whole, seconds=[], query_seconds=[], counters=[], faults=[])
        self.path = folder / "soak.json"
        self.said: list[str] = []
        self.interim = InterimJudge(self.seen, self.path, self.said.append, tracking_pct)

    def until(self, end_s: int) -> dict[str, Any]:
        """What ``soak.json`` holds after the seconds to ``end_s``; {} where there is none."""
        for k in range(len(self.seen.seconds), end_s):
            self.seen.seconds.append(self.whole.seconds[k])
            self.seen.query_seconds.append(self.whole.query_seconds[k])
            self.seen.counters.append(self.whole.counters[k])
            # A fault is there when it begins, and ended when it is over.
            self.seen.faults = [f if f.end_s <= k else replace(f, end_s=float("nan"))
                                for f in self.whole.faults if f.begin_s <= k]  # fmt: skip
            self.interim.due(k + 1.0, lambda: {"seen": 1})
        return dict(json.loads(self.path.read_text())) if self.path.exists() else {}


def test_every_minute_there_is_a_file_of_the_promised_form(tmp_path: Path) -> None:
    run = Run(tmp_path)
    assert run.until(59) == {}
    found = run.until(61)
    end = verdict(healthy(200))
    assert list(found) == list(end)
    assert set(found["invariants"]) == set(end["invariants"])
    assert found["verdict"] == "running"
    assert found["duration_s"] == 60.0
    assert found["faults"]["gap"] == end["faults"]["gap"]
    assert set(found["not_judged"]) == {
        "faults_happened", "no_record_lost", "memory", "memory_resident", "follower_age"
    }  # fmt: skip
    assert found["samples"] == {"seen": 1, "without_their_voltage_in_time": 0}
    assert run.until(125)["duration_s"] == 120.0
    assert run.said == []
    assert [path.name for path in tmp_path.iterdir()] == ["soak.json"], "nothing half written is left"


def test_a_stretch_at_a_time_tells_what_the_whole_does(tmp_path: Path) -> None:
    run = Run(tmp_path, 250)
    run.whole.faults += [FaultRecord("gap", 70.2, 71.0), FaultRecord("gap", 118.0, 119.0)]
    for k in (71, 118, 119):
        run.whole.seconds[k].error_sum_um *= 50.0
    run.whole.seconds[130].held = 3
    run.whole.query_seconds[130].silent_s = 0.11
    run.whole.seconds[190].error_sum_um *= 1.5
    for _, _, counters in run.whole.counters[70:]:
        counters["samples.lost"] += 5.0
        counters["samples.received"] -= 5.0
        counters["samples.gates.learnt"] -= 5.0
    for _, _, counters in run.whole.counters[118:]:
        counters["samples.lost"] += 5.0
        counters["samples.received"] -= 5.0
        counters["samples.gates.learnt"] -= 5.0
    found = run.until(250)
    end = verdict(replace(run.whole, seconds=run.whole.seconds[:236], query_seconds=run.whole.query_seconds[:236]))
    assert found["faults"] == end["faults"]
    for name, one in found["invariants"].items():
        if name not in found["not_judged"]:
            assert one["held"] is end["invariants"][name]["held"] is True, name
            assert one["worst"] == pytest.approx(end["invariants"][name]["worst"], abs=1e-6), name


def spoil(observed: Observations, name: str) -> None:
    if name == "voltages_finite":
        observed.seconds[80].sent_not_finite = 1
    elif name == "voltages_within_slew":
        observed.seconds[80].sent_step_V = 5.0
    elif name == "voltages_within_limits":
        observed.seconds[80].sent_beyond_V = 0.5
    elif name == "answers_safe":
        observed.query_seconds[80].unsafe = 1
    elif name == "queries_answered":
        observed.query_seconds[80].silent_s = 1.0
    elif name == "follower_age":
        for probe in observed.query_seconds[66:]:
            probe.ages_s = [0.2, 0.01]
    elif name == "tracking":
        for second in observed.seconds[66:]:
            second.error_sum_um *= 20.0
    elif name == "samples_accounted":
        observed.counters[80][2]["samples.gates.learnt"] -= 100.0
    elif name == "processes_alive":
        observed.ended.append((80.0, "viewer"))
    elif name == "faults_told":
        observed.faults.append(FaultRecord("gap", 75.0, 76.0))
    elif name == "recovers_by_itself":
        observed.faults.append(FaultRecord("payload", 75.0, 75.1))
        for second in observed.seconds[75:88]:
            second.error_sum_um = 300.0
    elif name == "answered_again":
        observed.faults.append(FaultRecord("payload", 75.0, 75.1))
        observed.query_seconds[76].silent_s = 3.0


@pytest.mark.parametrize(
    "name",
    ["voltages_finite", "voltages_within_slew", "voltages_within_limits", "answers_safe", "queries_answered",
     "follower_age", "tracking", "samples_accounted", "processes_alive", "faults_told", "recovers_by_itself",
     "answered_again"],
)  # fmt: skip
def test_the_first_breach_is_told_when_it_shows_and_is_not_forgotten(tmp_path: Path, name: str) -> None:
    run = Run(tmp_path, 260)
    if name == "processes_alive":
        assert run.until(61)["verdict"] == "running"
    spoil(run.whole, name)
    found = run.until(125)
    assert found["verdict"] == "broken so far"
    assert found["invariants"][name]["held"] is False
    (line,) = run.said
    assert line.startswith(f"  (!) {name}: first seen broken at 120 s: ")
    assert f"{name}: first seen broken at 120 s" in run.seen.notes, "and the report will say so"
    found = run.until(255)
    assert (found["duration_s"], found["verdict"]) == (240.0, "broken so far")
    assert len(run.said) == 1


def test_a_slow_start_is_no_alarm(tmp_path: Path) -> None:
    """A share of a hundredth is not told by the few looks of the first minute."""
    run = Run(tmp_path, 200)
    run.whole.query_seconds[2].ages_s = [0.33, 0.33]
    found = run.until(61)["invariants"]["follower_age"]
    assert (found["held"], found["why"]) == (None, "47 seconds so far")
    assert run.until(125)["invariants"]["follower_age"]["held"] is True
    assert run.said == []


def test_a_fault_that_is_still_open_is_not_settled(tmp_path: Path) -> None:
    run = Run(tmp_path, 200)
    run.whole.faults.append(FaultRecord("gap", 55.0, 57.0))
    for second in run.whole.seconds[55:62]:
        second.error_sum_um = 1000.0
    found = run.until(61)
    assert found["faults"]["gap"]["count"] == 1, "only the one before it"
    assert found["verdict"] == "running"
    assert all(not fault.reported_by and not fault.silent_s for fault in run.seen.faults), "the end settles them"
    found = run.until(125)
    assert found["faults"]["gap"]["count"] == 2
    assert found["invariants"]["faults_told"]["held"] is False, "nobody told of the second"


def test_a_limit_that_is_known_at_the_end_waits_for_it(tmp_path: Path) -> None:
    found = Run(tmp_path, 100, None).until(70)
    assert found["invariants"]["tracking"]["held"] is None
    assert "tracking" in found["not_judged"]


class Rows(list[Any]):
    """Rows of days: only slices of a few minutes may be taken of them, and nobody may go through them."""

    most = 0

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        if isinstance(key, slice):
            Rows.most = max(Rows.most, len(found))
        return found

    def __iter__(self) -> Any:
        raise AssertionError("all rows of a run")


def test_a_look_at_the_third_day_takes_no_more_than_one_at_the_first(tmp_path: Path) -> None:
    run = Run(tmp_path, 1200)
    day = run.seen
    for turn in range(20):
        shift = 1200.0 * turn
        day.seconds += [replace(s, t_s=s.t_s + shift) for s in run.whole.seconds]
        day.query_seconds += [replace(p, t_s=p.t_s + shift) for p in run.whole.query_seconds]
        day.counters += [(t_s + shift, who, counters) for t_s, who, counters in run.whole.counters]
        for begin_s in range(10, 1190, 15):
            day.faults.append(FaultRecord("payload", shift + begin_s, shift + begin_s))
    now_s = 20 * 1200.0
    run.interim.look(now_s - 60.0, {})
    for name in ("seconds", "query_seconds", "counters", "faults"):
        setattr(day, name, Rows(getattr(day, name)))
    begin = time.process_time()
    found = run.interim.look(now_s, {})
    assert time.process_time() - begin < 0.5, "some tens of ms on a machine that is free"
    assert 60 < Rows.most < 200
    assert found["faults"]["payload"]["count"] > 1500


def test_a_file_is_replaced_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "soak.json"
    outcome.write_summary(path, {"verdict": "running"})

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(atomic_write.os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        outcome.write_summary(path, {"verdict": "held"})
    assert json.loads(path.read_text()) == {"verdict": "running"}
    # A soak goes on without the file.
    run = Run(tmp_path)
    run.until(61)
    assert run.said == ["  soak.json of the run so far: no space left"]
    assert run.interim.look(90.0, {})["verdict"] == "running"
    assert EVERY_S == 60.0
