"""Scenarios are data: seeded, pure, exact in their derivatives, and they happen when they say."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.sim.scenarios import SCENARIO_KINDS, Scenario, SensorGlitches, dwell, scenario
from dehyst.sim.signals.references import Sequenced, Tones


def shortened(kind: str, seed: int) -> Scenario:
    """The scenario of a kind; the dwell with a rest that a test can afford."""
    return dwell(seed, np.random.default_rng(seed), 4.0) if kind == "dwell" else scenario(kind, seed)


@pytest.mark.parametrize("kind", SCENARIO_KINDS)
def test_the_reference_stays_in_its_range_and_its_derivatives_are_its_own(kind: str) -> None:
    s = shortened(kind, 1)
    r, dt = s.reference(), s.stage.dt_s
    assert r.y_um.min() >= s.low_um - 1e-9
    assert r.y_um.max() <= s.high_um + 1e-9
    # central differences of a motion of up to 40 Hz at 1 kHz are good to (w dt)²/6, about 1 %
    for value, slope in ((r.y_um, r.v_um_per_s), (r.v_um_per_s, r.a_um_per_s2)):
        difference = (value[2:] - value[:-2]) / (2.0 * dt)
        assert np.max(np.abs(difference - slope[1:-1])) < 0.015 * np.max(np.abs(slope))


def test_the_dwell_rests_and_strokes_alike_before_and_after() -> None:
    s = dwell(1, np.random.default_rng(1), 5.0)
    assert s.quiet_s is not None
    r, dt = s.reference(), s.stage.dt_s
    start, stop = (round(t / dt) for t in s.quiet_s)
    assert np.ptp(r.y_um[start + 400 : stop - 400]) < 1e-9
    before, after = r.y_um[start - 5000 : start - 400], r.y_um[-5000:]
    assert np.ptp(before) == pytest.approx(s.range_um, rel=1e-3)
    assert np.ptp(after) == pytest.approx(s.range_um, rel=1e-3)
    assert scenario("dwell", 1).quiet_s == (25.0, 625.0)
    stopped = scenario("dwell", 1, 1.0)
    assert stopped.quiet_s == (25.0, 26.0)
    assert stopped.duration_s == 41.0
    assert np.array_equal(stopped.reference().y_um[:25_000], scenario("dwell", 1).reference().y_um[:25_000])


def test_glitches_spoil_their_samples_only_and_the_same_in_blocks() -> None:
    bad = SensorGlitches(((3, 2, 5.0), (9, 1, float("nan")), (12, 4, -1.0)))
    y = np.arange(20.0)
    kept = y.copy()
    whole = bad.applied(0, y)
    assert np.array_equal(y, kept)
    expected = y.copy()
    expected[3:5] += 5.0
    expected[9] = np.nan
    expected[12:16] -= 1.0
    assert np.array_equal(whole, expected, equal_nan=True)
    blocks = np.concatenate([bad.applied(k, y[k : k + 7]) for k in range(0, 20, 7)])
    assert np.array_equal(blocks, whole, equal_nan=True)


def test_what_cannot_be_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="kind: got 'earthquake'"):
        scenario("earthquake", 1)
    with pytest.raises(InputError, match="seed: got 0"):
        scenario("noise", 0)
    with pytest.raises(InputError, match="runs"):
        SensorGlitches(((3, 0, 1.0),))
    with pytest.raises(InputError, match="parts"):
        Sequenced(((0.3, Tones(1.0)),))
    with pytest.raises(InputError, match="frequency_Hz"):
        Tones(1.0, (1.0,), (), ())
