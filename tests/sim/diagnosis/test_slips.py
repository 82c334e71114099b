"""Lost samples: where they were lost, to the sample, and what is no lost sample."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.effects.timing import (
    best_slip_move,
    date_slips,
    find_slips,
    merge_close_slips,
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
