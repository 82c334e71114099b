"""The numbers of the samples: one that is absurd changes nothing, and from every count good samples lead back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dehyst.adaptive.state import restore, save
from dehyst.adaptive.types import InverseModel
from dehyst.service.intake.sequence import (
    AHEAD,
    IN_ORDER,
    LATE,
    NEW_COUNT,
    RESTART_AFTER,
    RESTARTED,
    SequenceTracker,
)
from dehyst.service.intake.sequence import (
    MOST_CONFIRMATIONS as MOST,
)
from dehyst.service.protocol.model import fingerprint
from dehyst.service.protocol.samples import MAX_SEQ, SampleBatch
from dehyst.service.replay import sequence
from dehyst.service.server.axis import Axis
from dehyst.sim.recordings import Recording
from tests.service.server.test_axis import make_axis, recording

DT_S = 1e-3
Row = tuple[int, float]


def rows(first: int, n: int, ahead_s: float = 0.0, dt_s: float = DT_S) -> list[Row]:
    """n samples in a row, with the time of their numbers and ``ahead_s``, s."""
    return [(k, k * dt_s + ahead_s) for k in range(first, first + n)]


def taken(tracker: SequenceTracker, samples: list[Row]) -> list[str]:
    return [tracker.take(*row) for row in samples]


def begun(n: int = 1000, dt_s: float = DT_S) -> SequenceTracker:
    tracker = SequenceTracker(dt_s)
    assert taken(tracker, rows(0, n, dt_s=dt_s)) == [IN_ORDER] * n
    return tracker


def number(tracker: SequenceTracker) -> int:
    return tracker.number(tracker.last)


def test_a_gap_is_taken_at_once_where_the_time_tells_of_it_or_is_none() -> None:
    for t_s in (2.0, math.nan, math.inf):
        tracker = begun()
        assert tracker.take(2000, t_s) == IN_ORDER
        assert tracker.lost == 1000
    for missing, expected in ((MOST, IN_ORDER), (MOST + 1, AHEAD)):
        tracker = begun()
        assert tracker.take(1000 + missing, 1.0) == expected


@pytest.mark.parametrize("outage_s", [1.002, 30.0, 86_000.0])
def test_a_real_outage_is_borne_out_by_some_samples_and_its_numbers_are_lost(outage_s: float) -> None:
    tracker = begun()
    first = 1000 + round(outage_s / DT_S)
    assert taken(tracker, rows(first, 100)) == [AHEAD] * (MOST - 1) + [IN_ORDER] * (101 - MOST)
    assert tracker.counters() == {"received": 1100, "lost": first - 1000, "late": 0, "restarts": 0}
    assert number(tracker) == tracker.last == first + 99


def test_a_first_number_that_is_absurd_gives_way_to_the_next_ones() -> None:
    tracker = SequenceTracker(DT_S)
    assert tracker.take(MAX_SEQ, 0.0) == IN_ORDER
    said = taken(tracker, rows(7, 100))
    assert said == [LATE] * (MOST - 1) + [RESTARTED] + [IN_ORDER] * (100 - MOST)
    assert number(tracker) == 1000 + 99


# ---- whatever happens

Stage = dict[str, Any]


def absurd(stage: Stage, size: int, value: int) -> Iterator[Row]:
    """Numbers ahead, in a row, with a time that is true, that of the number, or none."""
    first = min(stage["seq"] + 1 + value, MAX_SEQ - size)
    for k in range(size):
        yield first + k, (stage["t_s"], (first + k) * DT_S, math.nan, 1e300)[value % 4]


def gap(stage: Stage, size: int, value: int) -> Iterator[Row]:
    missing = value % 200_000
    stage["seq"], stage["t_s"] = stage["seq"] + missing, stage["t_s"] + missing * DT_S
    yield from ()


def jump(stage: Stage, size: int, value: int) -> Iterator[Row]:
    stage["seq"] = value % (MAX_SEQ // 2)
    yield from ()


def restart(stage: Stage, size: int, value: int) -> Iterator[Row]:
    stage["seq"], stage["t_s"] = 0, float(value % 1000)
    yield from ()


def clock_set(stage: Stage, size: int, value: int) -> Iterator[Row]:
    stage["t_s"] += float(value % 10**9) - 5e8
    yield from ()


def wrong_times(stage: Stage, size: int, value: int) -> Iterator[Row]:
    for row in good(stage, size, value):
        yield row[0], (math.nan, 1e300, -1e18, 2.0**62, math.inf, float(value % 10**7))[value % 6]


def doubled(stage: Stage, size: int, value: int) -> Iterator[Row]:
    for row in good(stage, size, value):
        yield row
        yield row


def again(stage: Stage, size: int, value: int) -> Iterator[Row]:
    sent = list(good(stage, size, value))
    yield from sent
    yield from sent


def reversed_(stage: Stage, size: int, value: int) -> Iterator[Row]:
    yield from reversed(list(good(stage, size, value)))


def lossy(stage: Stage, size: int, value: int) -> Iterator[Row]:
    for k, row in enumerate(good(stage, size, value)):
        if (k * 7919 + value) % 3:
            yield row


def good(stage: Stage, size: int, value: int = 0) -> Iterator[Row]:
    for _ in range(size):
        stage["seq"], stage["t_s"] = stage["seq"] + 1, stage["t_s"] + DT_S
        yield stage["seq"], stage["t_s"]


EVENTS: tuple[Callable[[Stage, int, int], Iterator[Row]], ...] = (
    absurd, gap, jump, restart, clock_set, wrong_times, doubled, again, reversed_, lossy, good,
)  # fmt: skip
happenings = st.lists(
    st.tuples(
        st.sampled_from(EVENTS),
        st.one_of(st.just(1), st.integers(2, 40), st.integers(100, 700)),
        st.one_of(st.integers(0, 3000), st.integers(0, 10**6), st.integers(0, MAX_SEQ)),
    ),
    max_size=12,
)
#: Good samples that are to lead back from anything: two seconds at 1 kHz, and more than is needed at any time.
BACK = 2000


@settings(max_examples=100)
@given(happenings, st.integers(0, 2**31))
def test_whatever_happened_good_samples_lead_back(events: list[tuple[Any, int, int]], cut: int) -> None:
    stage: Stage = {"seq": -1, "t_s": 0.0}
    sent = [row for happens, size, value in events for row in happens(stage, size, value)]
    sent += good(stage, BACK)
    one, two = SequenceTracker(DT_S), SequenceTracker(DT_S)
    cut %= len(sent)
    internal, accounted = -1, None
    for k, (seq, t_s) in enumerate(sent):
        if k == cut:
            restore(two, save(one))
        lost = one.lost
        said = one.take(seq, t_s)
        if k >= cut:
            assert two.take(seq, t_s) == said
        assert one.received == k + 1
        if said in NEW_COUNT:
            accounted = None
        if said in (IN_ORDER, *NEW_COUNT):
            now = one.number(seq)
            # It never goes back, and goes on by what came and what was lost, or by the gap before another count.
            assert 0 <= now < 2**53
            assert 0 < now - internal <= one.lost - lost + MOST * RESTART_AFTER or internal < 0 or said in NEW_COUNT
            assert internal < now <= internal + 1000 + MOST * 1501 or internal < 0 or said not in NEW_COUNT
            internal = now
        if said == IN_ORDER:
            # Every number is accounted for: it was received, is late, or was lost.
            account = seq - (one.received - one.late + one.lost)
            assert account == accounted or accounted is None
            accounted = account
    assert said == IN_ORDER
    assert one.last == stage["seq"]
    for name, value in save(one).items():
        np.testing.assert_array_equal(value, save(two)[name])


def motion(samples: list[Row]) -> SampleBatch:
    """These numbers and times, with what a stage that moves at 3 Hz shows; 5 % less gain than the models believe."""
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * np.arange(len(samples)) * DT_S)
    seq, t_s = (np.array(column) for column in zip(*samples, strict=True))
    return SampleBatch(seq.astype(np.int64), t_s.astype(float), (y_um - 1.0) / (11.0 * 0.95), y_um)


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(happenings, st.integers(0, 5))
def test_whatever_happened_a_learner_learns_again(
    models: dict[str, InverseModel], events: list[tuple[Any, int, int]], first_is_wrong: int
) -> None:
    stage: Stage = {"seq": -1, "t_s": 0.0}
    sent = list(wrong_times(stage, 1, first_is_wrong))
    sent += [row for happens, size, value in events for row in happens(stage, size, value)]
    sent += good(stage, BACK)
    axis = make_axis(models)
    verdicts = axis.handle(motion(sent))
    assert not {AHEAD, "out_of_order", "duplicate", "timing", "not_finite", "gap"} & set(verdicts[-300:])
    assert "learnt" in verdicts[-300:]
    assert axis.handled_seq == stage["seq"]
    assert axis.newest.seq == stage["seq"] // 20 * 20
    assert axis.sequence.number(axis.handled_seq) == save(axis.clock)["number_last"]


# ---- through an axis


def with_rows(batch: SampleBatch, at: int, *rows: tuple[int, float, float, float]) -> SampleBatch:
    """``batch`` with samples put in before its row ``at``."""
    columns = zip(*rows, strict=True)
    names = ("seq", "t_s", "u_V", "y_um")
    return SampleBatch(*(np.insert(getattr(batch, n), at, c) for n, c in zip(names, columns, strict=True)))


def model_of(axis: Axis) -> str:
    return fingerprint(axis.newest.models["lssvm_adaptive"])


@pytest.mark.parametrize("its_own_time", [False, True])
def test_learning_goes_on_at_once_as_if_nothing_had_happened_and_an_event_tells(
    models: dict[str, InverseModel], its_own_time: bool
) -> None:
    """It was silent for ever: no snapshot, no event, and not even a restart of the service helped."""
    axis, plain = make_axis(models), make_axis(models)
    false = [(n, n * DT_S if its_own_time else 1.0, 4.0, 45.0) for n in (101_000, 2**62)]
    verdicts = axis.handle(with_rows(recording(3000), 1000, *false))
    assert verdicts[1000:1002] == [AHEAD] * 2
    assert verdicts[:1000] + verdicts[1002:] == plain.handle(recording(3000))
    assert (axis.handled_seq, axis.newest.seq, model_of(axis)) == (2999, 2980, model_of(plain))
    (event,) = axis.take_events()
    assert (event["event"], event["seq"]) == ("numbers_ahead", 999)
    assert "101000 after 999" in event["detail"]
    assert axis.gates[AHEAD] == axis.counts.samples["late"] == 2
    np.testing.assert_array_equal(axis.newest.memories["lssvm_adaptive"], plain.newest.memories["lssvm_adaptive"])
    # A second of quiet later it is told again.
    axis.handle(with_rows(recording(10, first=3000), 5, (2**62, 0.0, 4.0, 45.0)))
    assert [e["event"] for e in axis.take_events()] == ["numbers_ahead"]


def test_a_count_that_really_jumps_is_told_and_learnt_on(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    axis.handle(recording(2000))
    batch = recording(1000, first=2000)
    verdicts = axis.handle(SampleBatch(batch.seq + 2**61, batch.t_s, batch.u_V, batch.y_um))
    assert verdicts[: MOST - 1] == [AHEAD] * (MOST - 1)
    assert sum(verdict in ("learnt", "passed") for verdict in verdicts[MOST:]) > 800
    assert "timing" not in verdicts
    assert [e["event"] for e in axis.take_events()] == ["numbers_jumped"]
    assert axis.handled_seq == 2**61 + 2999
    assert axis.newest.seq // 20 == axis.handled_seq // 20
    # The same stage is started again.
    axis.handle(recording(RESTART_AFTER))
    assert axis.handled_seq == axis.newest.seq == RESTART_AFTER - 1
    # No speed is taken from two counts.
    assert save(axis.tracker)["v"] == 0.0
    axis.handle(recording(1000 - RESTART_AFTER, first=RESTART_AFTER))
    assert (axis.handled_seq, axis.newest.seq) == (999, 980)
    assert [e["event"] for e in axis.take_events()] == ["stage_restarted"]


def test_a_recording_without_numbers_has_some_for_a_time_that_is_absurd_too() -> None:
    batch = recording(100)
    batch.t_s[[30, 60, 90]] = 1e300, math.nan, -1e19
    seq = sequence(Recording(t_s=batch.t_s, u_V=batch.u_V, y_um=batch.y_um, dt_s=DT_S, source="test"))
    np.testing.assert_array_equal(seq, np.arange(100))
