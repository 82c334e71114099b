"""Thinning: a rate beyond the learner's is met by a stated factor, and no sample is counted twice or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.service.intake.sample_queue import Thinner
from dehyst.service.protocol.samples import SampleBatch


def batch(first: int, n: int) -> SampleBatch:
    k = np.arange(first, first + n)
    return SampleBatch(k, k * 5e-5, np.zeros(n), np.zeros(n))


def run(rate_hz: float, learnt_per_s: float, seconds: float, capacity: int = 20_000) -> tuple[list[int], int, int]:
    """Factors over time, samples dropped and thinned, of a stage and a learner of constant rates."""
    thinner, waiting, dropped, seq, factors = Thinner(1 / rate_hz, capacity), 0.0, 0, 0, []
    step_s = 0.01
    for step in range(round(seconds / step_s)):
        n = round(rate_hz * step_s)
        thinner.watch(int(waiting), step * step_s)
        kept, _ = thinner.split(batch(seq, n))
        seq += n
        count = 0 if kept is None else len(kept)
        if waiting + count > capacity:
            dropped += count
        else:
            waiting += count
        waiting = max(0.0, waiting - learnt_per_s * step_s)
        factors.append(thinner.factor)
    return factors, dropped, thinner.thinned


@pytest.mark.parametrize(
    ("rate_hz", "learnt", "expected"), [(20_000, 12_400, 2), (1000, 12_400, 1), (20_000, 5500, 4), (20_000, 3500, 6)]
)
def test_the_factor_settles_where_the_learner_keeps_up_and_nothing_is_dropped(
    rate_hz: float, learnt: float, expected: int
) -> None:
    factors, dropped, thinned = run(rate_hz, learnt, 20.0)
    assert dropped == 0
    assert max(factors) <= expected + 1
    assert (thinned > 0) == (expected > 1)
    assert factors[len(factors) // 2] >= expected


@pytest.mark.parametrize(("rate_hz", "learnt"), [(100_000, 12_400), (100_000, 3500), (200_000, 12_400)])
def test_a_queue_that_is_full_within_the_first_fraction_of_a_second_drops_nothing(
    rate_hz: float, learnt: float
) -> None:
    factors, dropped, thinned = run(rate_hz, learnt, 20.0)
    assert dropped == 0
    assert 0 < thinned < 20 * rate_hz
    assert rate_hz / learnt < factors[-1] < 1.5 * rate_hz / learnt + 1


def test_all_samples_come_again_when_the_stage_is_slower_and_vain_trials_become_rarer() -> None:
    thinner = Thinner(1e-3, 1000)
    assert not thinner.watch(600, 0.0)
    assert thinner.split(batch(0, 1000))[1] is None
    assert thinner.watch(700, 0.6)  # 900 of 1000 were handled
    assert thinner.factor == 2
    assert not thinner.watch(10, 5.0)
    assert thinner.watch(10, 10.7)
    assert thinner.factor == 1
    # The factor was needed: it waits twice as long before the next trial.
    thinner.watch(600, 11.0)
    thinner.split(batch(0, 1000))
    assert thinner.watch(700, 11.6)
    assert not thinner.watch(10, 25.0)
    assert thinner.watch(10, 31.7)


def test_whole_stretches_are_handled_and_every_sample_is_in_one_part() -> None:
    thinner = Thinner(5e-5, 5000)
    thinner.watch(4500, 0.0)
    thinner.split(batch(0, 500))
    thinner.watch(4700, 1.0)
    assert thinner.factor == 2
    thinner.watch(1000, 1.1)
    kept, left = thinner.split(batch(500, 3000))
    assert kept is not None
    assert left is not None
    assert sorted([*kept.seq.tolist(), *left.seq.tolist()]) == list(range(500, 3500))
    assert kept.seq.tolist() == [*range(500, 1000), *range(2000, 3000)]
    assert thinner.thinned == len(left) == 1500
