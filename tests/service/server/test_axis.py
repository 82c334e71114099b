"""One axis in the service: learning, answers, status counters and events."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.intake.sequence import RESTART_AFTER
from dehyst.service.protocol.query import FeedforwardQuery, Trajectory
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis, EventLog
from dehyst.service.server.axis_loading import load_axis, make_learner
from dehyst.service.server.status import axis_fields
from dehyst.service.storage.model_file import Bundle, BundleMeta
from tests.service.axes import loop_of

# --- One axis without wire or threads: snapshots, as_of, memory, numbers that go wrong, models that go wrong.

DT_S = 1e-3
LIMITS = Limits(0.0, 10.0, 2000.0, 0.0, 90.0)
CONFIG = AxisConfig("x", Path("x.npz"), LIMITS, compete=())
META = BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0)


def recording(n: int, first: int = 0) -> SampleBatch:
    """n samples of a stage with 5 % less gain than the models believe, moving at 3 Hz."""
    k = np.arange(first, first + n)
    y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * DT_S)
    return SampleBatch(k, k * DT_S, (y - 1.0) / (11.0 * 0.95), y)


def parts(batch: SampleBatch, size: int) -> list[SampleBatch]:
    cuts = range(0, len(batch), size)
    return [SampleBatch(*(getattr(batch, f)[i : i + size] for f in ("seq", "t_s", "u_V", "y_um"))) for i in cuts]


def make_axis(models: dict[str, InverseModel], **changes: Any) -> Axis:
    return load_axis("demo", replace(CONFIG, **changes), make_learner, Bundle(models, META))


def ask(axis: Axis, y: float = 40.0, n: int = 20, **fields: Any) -> Trajectory:
    t = np.arange(n) * DT_S
    return axis.answer(FeedforwardQuery(y + 100.0 * t, np.full(n, 100.0), np.zeros(n), **fields))


def test_the_same_samples_give_the_same_voltages_to_the_last_bit_however_they_arrive(
    models: dict[str, InverseModel],
) -> None:
    def answers(size: int) -> list[FloatArray]:
        axis = make_axis(models)
        got = []
        for part in parts(recording(700), size):
            axis.handle(part)
        for as_of in (0, 19, 20, 350, 699):
            reply = ask(axis, as_of=as_of)
            got.append(np.concatenate([reply.u_V, reply.std_V, reply.memory, [reply.snapshot_seq]]))
        return got

    ones, many = answers(1), answers(137)
    for a, b in zip(ones, many, strict=True):
        np.testing.assert_array_equal(a, b)
    assert [int(a[-1]) for a in ones] == [0, 0, 20, 340, 680]
    # It did learn: or all of this would hold of a model that never changes.
    assert abs(ones[0][0] - ones[-1][0]) > 0.02


def test_as_of_says_when_it_is_behind_and_when_it_is_gone(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models, snapshots_kept=3)
    for part in parts(recording(111), 1):
        axis.handle(part)
    assert not ask(axis, as_of=110).behind
    assert not ask(axis, as_of=119).behind  # nothing up to 119 can change the answer
    assert ask(axis, as_of=120).behind
    axis.handle(recording(9, first=111))
    assert ask(axis, as_of=120).behind
    axis.handle(recording(1, first=120))
    assert not ask(axis, as_of=120).behind
    assert ask(axis, as_of=80).snapshot_seq == 80
    with pytest.raises(InputError, match="snapshots_kept"):
        ask(axis, as_of=79)


def test_memory_travels_and_a_cut_trajectory_is_the_same_trajectory(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    axis.handle(recording(200))
    y = 45.0 + 20.0 * np.sin(np.linspace(0.0, 6.0, 60))
    zero = np.zeros(60)
    whole = axis.answer(FeedforwardQuery(y, zero, zero))
    memory, u, before = None, [], math.nan
    for i in range(0, 60, 15):
        s = slice(i, i + 15)
        reply = axis.answer(FeedforwardQuery(y[s], zero[s], zero[s], memory, u_before_V=before))
        assert reply.tracked_memory is (memory is None)
        memory, before = reply.memory, float(reply.u_V[-1])
        u.append(reply.u_V)
    np.testing.assert_array_equal(np.concatenate(u), whole.u_V)
    np.testing.assert_array_equal(memory, whole.memory)


def test_sequence_numbers_that_go_wrong_are_counted(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    batch = recording(100)
    axis.handle(batch)
    axis.handle(parts(batch, 30)[1])  # twice
    axis.handle(recording(50, first=110))  # ten never came
    assert axis.sequence.counters() == {"received": 180, "lost": 10, "late": 30, "restarts": 0}
    assert axis.handled_seq == 159
    assert axis.newest.seq == 140
    assert axis.gates["learnt"] > 0


def test_a_stage_that_counts_anew_goes_on_being_learnt(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    axis.handle(recording(5000))
    model_before = axis.model("lssvm_adaptive")[0]
    began_at = time.time()
    verdicts = axis.handle(recording(2000))
    ended_at = time.time()
    assert axis.sequence.restarts == 1
    assert axis.handled_seq == 1999
    (event,) = axis.take_events()
    assert event["event"] == "stage_restarted"
    # When it happened, not when somebody asks: a standby tells its events only once it serves.
    assert began_at <= event["time_unix_s"] <= ended_at
    assert axis.newest.seq == 1980
    # What came before the restart was noticed is refused as late; from then on it is learnt.
    assert verdicts[: RESTART_AFTER - 1] == ["out_of_order"] * (RESTART_AFTER - 1)
    assert sum(verdict in ("learnt", "passed") for verdict in verdicts[RESTART_AFTER:]) > 1500
    after = axis.model("lssvm_adaptive")[0]
    zero = np.zeros(1)
    u = [m.feedforward(zero + 45.0, zero, zero, m.rest_memory(45.0)).u_V[0] for m in (model_before, after)]
    assert abs(u[0] - u[1]) < 0.2  # nothing of what was learnt is lost


def test_learner_settings_are_checked_by_name(models: dict[str, InverseModel]) -> None:
    for settings, words in (
        ({"windw": 3}, r"learner\.windw.*window"),
        ({"window": "many"}, r"learner\.window"),
        ({"window": 1}, "window"),
        ({"admission": {"setle": 1}}, r"learner\.admission\.setle"),
        ({"admission": 5}, r"learner\.admission.*a table"),
    ):
        with pytest.raises(InputError, match=words):
            make_axis(models, learner=settings)
    with pytest.raises(InputError, match="learn"):
        make_axis(models, learn="linear")
    with pytest.raises(InputError, match="served"):
        make_axis(models, served="mpi")


def test_queries_are_answered_while_samples_are_handled(models: dict[str, InverseModel]) -> None:
    """Thousands of queries beside a thread that learns: every one safe, snapshots only ever newer."""
    axis = make_axis(models)
    loop = loop_of(axis)
    loop.start()
    try:
        last, count = -1, 0
        for part in parts(recording(6000), 10):
            assert loop.offer(part)
        until = threading.Event()
        while loop.queue.waiting and not until.wait(0):
            reply = ask(axis, n=3)
            assert np.isfinite(reply.u_V).all()
            assert reply.snapshot_seq >= last
            last, count = reply.snapshot_seq, count + 1
    finally:
        loop.close()
    assert axis.handled_seq == 5999
    assert count > 20


@pytest.mark.parametrize("compete", [(), ("linear",)], ids=["alone", "competing"])
def test_the_counters_of_the_window_reach_the_status(models: dict[str, InverseModel], compete: tuple[str, ...]) -> None:
    axis = make_axis(models, compete=compete, learner={"window": 30, "learn_every": 2})
    loop = loop_of(axis)
    for part in parts(recording(1000), 20):
        loop.handle(part)
    learner: Any = axis.learner
    window = (learner.favourite if compete else learner).parts.window
    told = json.loads(json.dumps(axis_fields(loop), allow_nan=False))
    counts = {f"window_{name}": count for name, count in window.counters().items()}
    assert {name: count for name, count in told["learner"].items() if name.startswith("window_")} == counts
    assert counts["window_steps"] > 100
    assert 0.0 <= told["quality"]["window_residual_V"] < 1e-6


# --- Events of an axis: kept for the publisher, limited, and logged through the standard library.


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
