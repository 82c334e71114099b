"""What a soak says of memory: growth is told from what is in use for a moment, with its doubt."""

from __future__ import annotations

import numpy as np
import pytest

from lab.soak.verdict.invariants import memory_slopes, resident_growth
from lab.soak.verdict.observations import Counters, Observations
from tests.lab.soak.soaked import broken, healthy, verdict


def slope_of(observed: Observations) -> float:
    return memory_slopes(observed)[0].slope


def test_memory_that_is_used_for_a_moment_is_no_growth() -> None:
    observed = healthy()
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 1500.0, 1.0)
    held = np.where(rng.random(t.size) < 0.5, rng.uniform(0.0, 20_000.0, t.size), 0.0)
    observed.memory["a"] = [(float(s), 200_000.0 + 0.1 * s + more, 17) for s, more in zip(t, held, strict=True)]
    assert slope_of(observed) == pytest.approx(360.0, rel=0.05)


def test_memory_is_that_of_one_process_after_its_warm_up() -> None:
    observed = healthy()
    assert memory_slopes(observed) == []
    t = np.arange(0.0, 1000.0, 1.0)
    # Start-up grows, then it is flat; a second life of the same service begins lower.
    observed.memory["a"] = [(float(s), 200_000.0 + min(s, 150.0) * 50.0, 17) for s in t]
    observed.memory["b"] = [(float(s), 150_000.0 + 0.1 * s, 18) for s in t[:600]]
    assert slope_of(observed) == pytest.approx(0.0, abs=1e-6)
    observed.memory["b"] = [(float(s), 150_000.0 + 0.1 * s, 18) for s in np.arange(0.0, 1200.0)]
    assert slope_of(observed) == pytest.approx(360.0)


def in_use(t_s: float, malloc_kb: float, blocks: float = 0.0) -> tuple[float, str, Counters]:
    return (
        t_s,
        "i17-ab",
        Counters({"serves": 1.0, "memory.malloc_bytes": 1024.0 * malloc_kb, "memory.python_blocks": blocks}),
    )


def test_what_is_in_use_tells_the_slope_where_the_allocator_can_say() -> None:
    observed = healthy()
    t = np.arange(0.0, 1200.0, 1.0)
    # What lies free comes and goes; what is in use grows by 0.1 kB a second.
    rng = np.random.default_rng(2)
    observed.memory["a"] = [(float(s), 200_000.0 + rng.uniform(0.0, 20_000.0), 17) for s in t]
    observed.counters = [in_use(float(s), 90_000.0 + 0.1 * s) for s in t]
    assert slope_of(observed) == pytest.approx(360.0)
    # So do small objects of Python's.
    observed.counters = [in_use(float(s), 90_000.0, 200_000.0 + 1.024 * s) for s in t]
    assert slope_of(observed) == pytest.approx(360.0)
    observed.counters = [in_use(float(s), 90_000.0 + 5.0 * np.sin(s)) for s in t]
    assert slope_of(observed) == pytest.approx(0.0, abs=30.0)


def test_a_growth_that_half_an_hour_cannot_tell_is_not_judged() -> None:
    observed = healthy()
    t = np.arange(0.0, 1800.0, 1.0)
    level = np.repeat(np.random.default_rng(3).uniform(0.0, 10_000.0, 30), 60)
    observed.counters = [in_use(float(s), 90_000.0 + float(up)) for s, up in zip(t, level, strict=True)]
    found = verdict(observed)["invariants"]["memory"]
    assert found["held"] is None
    assert "not judged" in found["text"]
    # A leak that stands out is one all the same.
    observed.counters = [in_use(float(s), 90_000.0 + 40.0 * s + float(up)) for s, up in zip(t, level, strict=True)]
    assert "memory" in broken(verdict(observed))
    # Ten minutes of two levels, as seen: the one that served a while ago stands by now.
    levels = [166.4, 167.3, 164.3, 163.9, 168.0, 169.3, 168.9, 168.8, 163.9, 176.7]
    level = np.repeat(np.concatenate([np.full(10, 167.0), levels]), 60) * 1000.0
    t = np.arange(0.0, 1200.0, 1.0)
    observed.counters = [in_use(float(s), float(at)) for s, at in zip(t, level, strict=True)]
    assert verdict(observed)["invariants"]["memory"]["held"] is None
    t = np.arange(0.0, 1800.0, 1.0)
    level = np.repeat(np.random.default_rng(3).uniform(0.0, 10_000.0, 30), 60)
    observed.faults = []
    # Without faults nothing but a sum of small things is left, and half an hour tells.
    observed.counters = [in_use(float(s), 90_000.0 + 0.001 * float(up)) for s, up in zip(t, level, strict=True)]
    assert verdict(observed)["invariants"]["memory"]["held"] is True


def two(t_s: np.ndarray, first_kb: np.ndarray, second_kb: np.ndarray) -> Observations:
    observed = healthy()
    observed.faults = []
    for s, a, b in zip(t_s, first_kb, second_kb, strict=True):
        observed.counters += [in_use(float(s), float(a)), (float(s), "i18-cd", in_use(float(s), float(b))[2])]
    return observed


def test_both_of_a_pair_that_lived_as_long_are_judged() -> None:
    t = np.arange(0.0, 2100.0, 1.0)
    level, grows = np.full(t.size, 90_000.0), 90_000.0 + 1.0 * t
    assert verdict(two(t, level, level))["invariants"]["memory"]["held"] is True
    for pair in ((level, grows), (grows, level)):
        observed = two(t, *pair)
        assert slope_of(observed) == pytest.approx(3600.0)
        assert "memory" in broken(verdict(observed))
    # One of them cannot be told: neither can the pair.
    steps = 90_000.0 + np.repeat(np.random.default_rng(3).uniform(0.0, 5_000.0, 35), 60)
    assert verdict(two(t, level, steps))["invariants"]["memory"]["held"] is None


def test_what_is_level_and_below_the_limit_for_sure_is_held() -> None:
    t = np.arange(0.0, 2100.0, 1.0)
    minute = t // 60.0
    # As seen: a standby that ended half a megabyte lower, and whose minutes differ by as much.
    falls = 139_500.0 + 300.0 * ((7.0 * minute) % 3.0 - 1.0) - np.where(minute > 27, 500.0, 0.0)
    found = verdict(two(t, falls, falls))["invariants"]["memory"]
    assert found["held"] is True
    assert found["worst"] < 0.0
    # Five megabytes less tell nothing of what grows meanwhile.
    found = verdict(two(t, falls, falls - np.where(minute > 20, 5_000.0, 0.0)))["invariants"]["memory"]
    assert found["held"] is None


def test_resident_memory_is_judged_by_what_it_ends_at() -> None:
    observed = healthy()
    t = np.arange(0.0, 1300.0, 1.0)
    observed.memory["a"] = [(float(s), 200_000.0 + 1024.0 * (40.0 if s > 850.0 else 0.0), 17) for s in t]
    assert resident_growth(observed) == pytest.approx(40.0)
    assert "memory_resident" in broken(verdict(observed))
    observed.memory["a"] = [(float(s), 200_000.0 + 1024.0 * (40.0 if 400.0 < s < 900.0 else 0.0), 17) for s in t]
    assert resident_growth(observed) == pytest.approx(0.0)
    assert verdict(observed)["invariants"]["memory_resident"]["held"] is True
    observed.memory["a"] = observed.memory["a"][:700]
    assert resident_growth(observed) is None


def test_too_short_a_run_says_that_it_does_not_tell() -> None:
    for mode, why in (("real_time", "too short a run"), ("fast", "in one process")):
        observed = healthy()
        observed.mode = mode
        found = verdict(observed)
        for name in ("memory", "memory_resident"):
            assert found["invariants"][name]["held"] is None
            assert found["invariants"][name]["why"] == why
            assert name in found["not_judged"]
        assert found["verdict"] == "held"
