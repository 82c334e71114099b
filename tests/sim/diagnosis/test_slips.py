"""Lost samples: where they were lost, to the sample, and what is no lost sample."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.effects.timing import (
    best_slip_move,
    date_slips,
    find_slips,
    merge_close_slips,
    without_small_slips,
)
from dehyst.sim.readings.lateness import SlipList

N = 6000
NOISE_UM = 0.005


def motion() -> FloatArray:
    """Fast and slow motion, µm, at 2 kHz, never at rest."""
    t_s = np.arange(N + 40) / 2000.0
    return np.asarray(30.0 * np.sin(2 * np.pi * 5.0 * t_s) + 8.0 * np.sin(2 * np.pi * 31.0 * t_s + 0.4))


def slipped(found: SlipList, rng: np.random.Generator) -> FloatArray:
    """Readings (N,) of `motion` that slip so."""
    shifts = np.zeros(N, dtype=np.int64)
    for at, size in found:
        shifts[at:] += size
    return np.asarray(motion()[np.arange(N) + shifts] + NOISE_UM * rng.standard_normal(N))


@pytest.mark.parametrize(
    "truth", [((1234, 1),), ((900, 1), (2500, 1), (2700, 2)), ((700, 2), (3000, -1), (4100, -1), (5000, 3))]
)
def test_slips_are_dated_to_the_sample(truth: SlipList) -> None:
    y_um = slipped(truth, np.random.default_rng(1))
    there = np.ones(N, dtype=np.bool_)
    model = motion()[:N]
    rough = tuple((at + 7 * (-1) ** i, size) for i, (at, size) in enumerate(truth))
    assert date_slips(rough, y_um, model, there) == truth


def test_from_nothing_one_move_after_the_other_finds_them_all() -> None:
    truth: SlipList = ((900, 1), (2500, 1), (4100, -2))
    y_um, there, model = slipped(truth, np.random.default_rng(2)), np.ones(N, dtype=np.bool_), motion()[:N]
    found: SlipList = ()
    for _ in range(8):
        after, gain_um2 = best_slip_move(found, y_um, model, there)
        if gain_um2 < 40.0 * NOISE_UM**2:
            break
        found = date_slips(after, y_um, model, there)
    assert found == truth


def test_two_that_were_taken_for_one_come_apart() -> None:
    truth: SlipList = ((900, 1), (2500, 1), (4100, 1))
    y_um, there, model = slipped(truth, np.random.default_rng(6)), np.ones(N, dtype=np.bool_), motion()[:N]
    after, _ = best_slip_move(((900, 1), (2500, 2)), y_um, model, there)
    assert date_slips(after, y_um, model, there) == truth


def test_a_gain_is_the_squared_error_that_a_move_takes_off() -> None:
    truth: SlipList = ((1500, 1), (3000, 1))
    y_um, there, model = slipped(truth, np.random.default_rng(3)), np.ones(N, dtype=np.bool_), motion()[:N]

    def sse_um2(found: SlipList) -> float:
        shifts = np.zeros(N, dtype=np.int64)
        for at, size in found:
            shifts[at:] += size
        return float(np.sum((y_um - model[np.clip(np.arange(N) + shifts, 0, N - 1)]) ** 2))

    after, gain_um2 = best_slip_move(((1500, 1),), y_um, model, there)
    assert sse_um2(((1500, 1),)) - sse_um2(after) == pytest.approx(gain_um2, rel=1e-9)


def test_samples_that_do_not_count_date_nothing() -> None:
    y_um = slipped(((2000, 1),), np.random.default_rng(4))
    y_um[2100:2110] += 50.0
    there = np.ones(N, dtype=np.bool_)
    there[2100:2110] = False
    assert date_slips(((1990, 1),), y_um, motion()[:N], there) == ((2000, 1),)


def test_what_is_soon_taken_back_is_no_slip() -> None:
    assert merge_close_slips(((100, 3), (101, -3), (2000, 1))) == ((2000, 1),)
    assert merge_close_slips(((100, 4), (105, -3), (2000, 1))) == ((100, 1), (2000, 1))
    assert merge_close_slips(((100, 1), (400, 1))) == ((100, 1), (400, 1))
    assert merge_close_slips(()) == ()


def test_healthy_readings_do_not_slip() -> None:
    y_um, there, model = slipped((), np.random.default_rng(5)), np.ones(N, dtype=np.bool_), motion()[:N]
    assert find_slips(y_um, model, there) == ()
    assert best_slip_move((), y_um, model, there)[1] < 40.0 * NOISE_UM**2


def test_dropping_slips_ends_where_their_sizes_change_with_every_fit() -> None:
    fits: list[SlipList] = []

    def fitted(p: FloatArray, kept: SlipList) -> Any:
        fits.append(kept)
        # The largest of the sizes changes in every fit; the next slip shrinks to nothing.
        sizes = np.array([7.0 + len(fits), *(float(size) for _, size in kept[1:-1]), 0.1])[: len(kept)]
        return SimpleNamespace(p=sizes, sse_um2=1.0)

    found = tuple((1000 * i, 2) for i in range(1, 9))
    first = fitted(np.zeros(0), found)
    fits.clear()
    fit = without_small_slips(first, found, 0, fitted)
    assert [len(kept) for kept in fits] == [7, 6, 5]
    assert fit.p.size == 5
    fits.clear()
    steady = SimpleNamespace(p=np.array([9.0, 3.0]), sse_um2=1.0)
    assert without_small_slips(steady, ((1000, 2), (2000, 3)), 0, fitted) is steady
    assert not fits
