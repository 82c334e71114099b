"""The family of random stages itself: the same by its seed, hysteretic, ringing where it should, and changeable."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.lab.rehearsal.plant import Change, Changeable, Plant
from tests.foreign.plants import (
    BOUC_WEN,
    DUHEM,
    HYSTERESIS,
    PLAYS,
    PREISACH,
    StageFactory,
    issue_plant,
    random_plant,
    with_traits,
)


def of_kind(kind: int) -> StageFactory:
    """The first stage drawn of a kind, quiet, at 1 kHz, quasi-static."""
    factory = next(
        random_plant(seed) for seed in range(200) if random_plant(seed).traits.hysteresis == HYSTERESIS[kind]
    )
    return with_traits(
        factory, dt_s=1e-3, u_min_V=0.0, u_max_V=100.0, range_um=80.0, offset_um=0.0, creep=(), creep_s=(), modes=(),
        drift_um=0.0, noise_um=0.0, amplifier_s=0.0, bend2=0.0, bend3=0.0,
    )  # fmt: skip


def ringing(share: float = 0.01) -> StageFactory:
    """An issue's stage with one mode at 200 Hz, without noise and creep."""
    return with_traits(
        issue_plant(1), modes=((200.0, share, 1.0),), noise_um=0.0, creep=(), creep_s=(), amplifier_s=0.0, dt_s=5e-4
    )


def triangle(low_V: float, high_V: float, n: int) -> np.ndarray:
    up = np.linspace(low_V, high_V, n)
    return np.concatenate([up, up[::-1]])


@pytest.mark.parametrize("seed", range(12))
def test_a_seed_makes_the_same_stage_whatever_the_blocks(seed: int) -> None:
    factory = random_plant(seed)
    traits = factory.traits
    one, other = factory(), factory()
    assert isinstance(one, Plant)
    assert isinstance(one, Changeable)
    u_V = traits.u_min_V + (traits.u_max_V - traits.u_min_V) * np.random.default_rng(seed).uniform(size=2000)
    whole = one.run(u_V)
    parts = [other.run(part) for part in np.split(u_V, [3, 500, 505, 1999])]
    for i in range(2):
        assert np.array_equal(whole[i], np.concatenate([part[i] for part in parts]))
        assert np.isfinite(whole[i]).all()
    assert random_plant(seed).traits == traits


@pytest.mark.parametrize("kind", [PLAYS, PREISACH, BOUC_WEN, DUHEM])
def test_the_largest_loop_is_as_wide_as_told_and_the_voltage_leads(kind: int) -> None:
    factory = of_kind(kind)
    plant = factory()
    loop = triangle(0.0, 100.0, 20_000)
    plant.run(loop)
    true_um, _ = plant.run(loop)
    up, down = true_um[1:20_000], true_um[20_001:][::-1]
    gap = down - up
    assert gap.max() / np.ptp(true_um) == pytest.approx(factory.traits.width, rel=0.05)
    # It closes at its ends, and nowhere does the way back lie below the way there.
    assert gap.min() > -1e-3 * np.ptp(true_um)
    # Higher voltage, higher displacement: the stage can be inverted.
    assert (np.diff(up) > 0.0).all()


@pytest.mark.parametrize("seed", [130000474, 131000039, 130000016, 40000162, 12])
def test_a_stage_moves_with_the_voltage_also_just_after_a_turn(seed: int) -> None:
    """No piezo moves against its voltage. The first four would, with loops as wide as they were drawn."""
    traits = random_plant(seed).traits
    factory = with_traits(random_plant(seed), modes=(), creep=(), creep_s=(), drift_um=0.0, noise_um=0.0)
    plant = factory()
    low_V, high_V = traits.u_min_V, traits.u_max_V
    turn_V = low_V + 0.6 * (high_V - low_V)
    plant.run(np.linspace(low_V, turn_V, 20_000))
    rest_um, _ = plant.run(np.full(2000, turn_V))
    back_um, _ = plant.run(np.linspace(turn_V, turn_V - 0.02 * (high_V - low_V), 2000))
    moved = (back_um[-1] - rest_um[-1]) / traits.range_um
    assert -0.03 < moved < -0.001


def test_a_step_rings_at_the_frequency_and_damping_of_the_mode() -> None:
    factory = ringing()
    plant = factory()
    plant.run(np.full(2000, 4.0))
    true_um, _ = plant.run(np.full(4096, 4.5))
    swing = true_um[1:] - true_um[-500:].mean()
    spectrum = np.abs(np.fft.rfft(swing * np.hanning(swing.size)))
    assert np.fft.rfftfreq(swing.size, factory.traits.dt_s)[spectrum.argmax()] == pytest.approx(200.0, abs=1.0)
    # The envelope falls by exp(-zeta omega t): between 0 and 0.1 s.
    early, late = (np.abs(swing[k : k + 40]).max() for k in (0, 200))
    assert late / early == pytest.approx(np.exp(-0.01 * 2.0 * np.pi * 200.0 * 0.1), rel=0.1)


def test_changes_are_taken_and_scale_as_told() -> None:
    factory = with_traits(ringing(0.3), modes=())
    u_V = np.full(4000, 6.0)
    plain = factory()
    plain.run(u_V)
    before_um = float(plain.run(u_V)[0][-1])
    gained = factory()
    gained.run(u_V)
    assert gained.change(Change("gain", 0.06))
    assert gained.run(u_V)[0][-1] == pytest.approx(1.06 * before_um, rel=1e-9)
    shifted = factory()
    shifted.run(u_V)
    assert shifted.change(Change("zero", -2.5, over_s=0.2))
    true_um, _ = shifted.run(u_V)
    assert true_um[200] - before_um == pytest.approx(-1.25, abs=0.02)  # half way at 0.1 s
    assert true_um[-1] - before_um == pytest.approx(-2.5, rel=1e-9)
    assert not factory().change(Change("knock", 1.0))  # nothing there that rings
    assert not factory().change(Change("unheard of", 1.0))
