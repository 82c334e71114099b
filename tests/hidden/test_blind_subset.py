"""A few of the blind cases (`make blind` runs them all): what is hidden is named, what is healthy is left alone."""

from __future__ import annotations

import pytest

from tests.hidden.blind import judge, run_case
from tests.hidden.cases import healthy, pair, single
from tests.hidden.stage import Truth


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("single", 8), ("single", 10), ("healthy", 8), ("healthy", 11)])
def test_the_truth_is_found(kind: str, seed: int) -> None:
    outcome = run_case(kind, seed)
    assert outcome.right, outcome
    # The truth is in the library here: what is left is noise.
    assert outcome.over_floor < 1.5


def test_a_wrong_name_is_not_taken_for_right() -> None:
    assert judge("single", single(8), "effects", (("saturation",),)).right
    assert not judge("single", single(8), "effects", (("creep",),)).contained
    assert not judge("single", single(8), "unexplained", (("saturation",),)).contained
    assert not judge("healthy", healthy(1), "effects", (("creep",),)).right
    one, two = pair(1).effects
    assert not judge("pair", pair(1), "effects", ((one,),)).contained
    assert judge("pair", pair(1), "effects", ((two,), (one,))).right


def test_an_extra_name_is_not_exact() -> None:
    extra = judge("single", single(8), "effects", (("saturation",), ("creep",)))
    assert extra.contained
    assert not extra.right
    assert extra.extra == ("creep",)
    # A second name for one lag is one too many; an alternative within a group is not.
    lag = Truth(0, effects={"amplifier_lag": {"f_Hz": 200.0}})
    assert judge("single", lag, "effects", (("sensor_lag", "delay"),)).right
    assert judge("single", lag, "effects", (("sensor_lag",), ("amplifier_lag",))).extra == ("amplifier_lag",)


def test_what_is_smaller_than_the_noise_may_be_missed_but_not_misnamed() -> None:
    hum = Truth(0, effects={"mains_hum": {"f_Hz": 50.0, "amplitude_um": 0.001}})
    assert judge("small", hum, "adequate", ()).right
    assert judge("small", hum, "effects", (("mains_hum",),)).right
    assert not judge("small", hum, "effects", (("resonance",),)).right
    assert not judge("small", hum, "unexplained", ()).right
