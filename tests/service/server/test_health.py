"""The state of an axis is ok only while it learns what it is sent; its counters add up under faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.types import InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.intake.sample_queue import Arrived
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis_loading import load_axis, make_learner
from dehyst.service.server.axis_loop import AxisLoop
from dehyst.service.server.health import Health
from dehyst.service.server.status import axis_fields
from dehyst.service.storage.model_file import Bundle, BundleMeta
from tests.service.axes import loop_of

DT_S = 1e-3


Make = Callable[..., AxisLoop]


@pytest.fixture
def axis_loop(models: dict[str, InverseModel]) -> Make:
    def make(meta: BundleMeta, **changes: Any) -> AxisLoop:
        config = replace(AxisConfig("x", Path("x.npz"), Limits(0.0, 9.0, 2000.0), compete=()), **changes)
        return loop_of(load_axis("demo", config, make_learner, Bundle(models, meta)))

    return make


META = BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0, u_min_V=0.0, u_max_V=8.0)


def test_limits_narrower_than_the_model_and_a_clipped_recording_are_warned_of_at_the_start(axis_loop: Make) -> None:
    assert axis_fields(axis_loop(META))["warnings"] == []
    wide = replace(META, u_min_V=5.0, u_max_V=120.0, notes={"clipped": ["y_um: flat top at 90"]})
    loop = axis_loop(wide)
    narrow, clipped = axis_fields(loop)["warnings"]
    assert "limits of 0 to 9 V are narrower than the 5 to 120 V" in narrow
    assert "flat top at 90" in clipped
    assert [event["event"] for event in loop.axis.take_events()] == ["limits_narrow", "model_clipped"]


def batches(seed: int, n: int) -> list[SampleBatch]:
    """Messages with doubles, swaps, gaps, NaN and numbers far ahead."""
    rng = np.random.default_rng(seed)
    seq = np.arange(n)
    seq = seq[rng.random(n) > 0.02]
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * seq * DT_S)
    u_V = (y_um - 1.0) / 11.0
    y_um[rng.random(seq.size) < 0.01] = np.nan
    order = np.arange(seq.size)
    order[rng.integers(0, seq.size, 20)] = rng.integers(0, seq.size, 20)
    seq, y_um, u_V = seq[order], y_um[order], u_V[order]
    seq[rng.integers(0, seq.size, 3)] += 10**7
    return [
        SampleBatch(seq[k : k + 25], seq[k : k + 25] * DT_S, u_V[k : k + 25], y_um[k : k + 25])
        for k in range(0, seq.size, 25)
    ]


def outrun(axis_loop: Make, monkeypatch: pytest.MonkeyPatch) -> AxisLoop:
    """A loop that is not started, for a stage that is faster than it: 50 samples at a time, 0.1 s each."""
    monkeypatch.setattr("dehyst.service.intake.sample_queue.MOST_TOGETHER", 50)
    now_s = iter(0.1 * k for k in range(10_000))
    monkeypatch.setattr("dehyst.service.server.axis_loop.time", SimpleNamespace(monotonic=lambda: next(now_s)))
    return axis_loop(META, queue_samples=300)


def offer(loop: AxisLoop, batch: SampleBatch, number: int) -> None:
    """Offer a message; what waits is handled with every fourth."""
    loop.offer(batch)
    if number % 4 == 3 and loop.queue.waiting and isinstance(item := loop.queue.take(), Arrived):
        loop.take(item)


@pytest.mark.parametrize("seed", range(3))
def test_received_is_what_was_learnt_refused_thinned_and_dropped(
    axis_loop: Make, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, sent = outrun(axis_loop, monkeypatch), batches(seed, 4000)
    # A message longer than the queue is dropped whole.
    k = np.arange(5000, 15_000)
    sent.append(SampleBatch(k, k * DT_S, np.full(k.size, 4.0), np.full(k.size, 45.0)))
    for number, batch in enumerate(sent):
        offer(loop, batch, number)
    loop.start()
    loop.close()
    samples = axis_fields(loop)["samples"]
    assert samples["received"] == sum(map(len, sent))
    assert min(samples["thinned"], samples["dropped"]) > 0
    assert sum(samples["gates"].values()) + samples["thinned"] + samples["dropped"] == samples["received"]
    assert samples["lost"] >= 0


def test_numbers_handled_add_up_at_every_moment_while_samples_are_left_out(
    axis_loop: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left out counts at once, its numbers are passed when those before it have been handled."""
    loop, rng, seq = outrun(axis_loop, monkeypatch), np.random.default_rng(0), np.arange(4000)
    # The network loses some, of which no notice must be lost either.
    seq = seq[(rng.random(seq.size) > 0.02) | (seq < 10)]
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * seq * DT_S)
    columns = (np.array_split(column, 160) for column in (seq, seq * DT_S, (y_um - 1.0) / 11.0, y_um))
    for number, part in enumerate(zip(*columns, strict=True)):
        offer(loop, SampleBatch(*part), number)
        status = axis_fields(loop)
        s = status["samples"]
        handled = s["received"] - s["thinned"] - s["dropped"]
        assert status["seq"] + 1 == handled - s["late"] + s["lost"] + s["left_out"]
        missing = status["seq"] + 1 - int(np.count_nonzero(seq <= status["seq"]))
        # A number that the network lost beside those left out may be told from them a message later.
        assert abs(s["lost"] - missing) <= 50
    assert min(s["thinned"], s["dropped"], s["left_out"] - 500) > 0


def health_after(per_s: dict[str, float], seconds: int = 12, dropped: float = 0.0) -> Health:
    health = Health()
    for k in range(seconds):
        gates = {name: int(rate * k) for name, rate in per_s.items()}
        health.update(float(k), sum(gates.values()), int(dropped * k), gates)
    return health


def test_the_state_names_what_keeps_it_from_learning(axis_loop: Make) -> None:
    loop = axis_loop(META)
    assert Health().state(axis_fields(loop)) == ("no samples", "none has come since the start")
    loop.offer(batches(0, 25)[0])
    loop.start()
    loop.close()
    base = axis_fields(loop)
    good = health_after({"learnt": 100, "passed": 900})
    assert good.per_s == pytest.approx(1000)
    assert good.state(base) == ("ok", "")
    assert good.state({**base, "thinning": 3})[0] == "thinned 1/3"
    assert "1000 samples/s" in good.state({**base, "thinning": 3})[1]
    assert health_after({"unexcited": 1000}).state(base)[0] == "ok"
    refusing = health_after({"learnt": 100, "glitch": 600, "timing": 300})
    assert refusing.state(base) == ("refusing", "most samples of the last 10 s are not learnt: glitch")
    dropping = health_after({"learnt": 1000}, dropped=5.0).state(base)
    assert dropping[0] == "dropping"
    assert "client.wait_learnt(seq)" in dropping[1]
    assert good.state({**base, "stale": True}) == ("stale", "no samples come")
    behind = good.state({**base, "stale": True, "samples": {**base["samples"], "waiting": 9000}})
    assert behind[0] == "stale"
    assert "9000 samples wait" in behind[1]
    assert "client.wait_learnt(seq)" in behind[1]
    assert good.state({**base, "trouble": "rail"})[0] == "rail"
    assert good.state({**base, "learning": None})[0] == "not learning"
    assert good.state({**base, "quality": {"valid": 0.0}})[0] == "unsure"
