"""The intervals of named numbers: what correlated noise, differing motions and the form of the loop contribute."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.search.held_out import Split
from dehyst.sim.diagnosis.search.intervals import (
    WIDER,
    ParameterErrors,
    across_zero,
    numbers,
    over_ties,
    parameter_errors,
)
from dehyst.sim.diagnosis.search.search import Search, Thresholds
from dehyst.sim.effects.delay import Delay
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import CauseModel, ModelFit
from dehyst.sim.readings.readings import Readings

N = 2000
PARTS = Split(np.arange(21) * 100, np.arange(20) % 4)


@dataclass(frozen=True)
class Gain(CauseModel):
    """One number, reported as its double."""

    name: str = "gain"

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        return {"twice": (2.0 * float(p[0]), np.array([2.0]))}


class Blurred(Gain):
    """A number that no recording gives to better than 0.25."""

    def unresolved(self, data: FitData) -> dict[str, float]:
        return {"twice": 0.25}


def fit_of(cause: CauseModel, p: float, row: FloatArray, residual_um: FloatArray) -> ModelFit:
    """A linear model of one number whose column is ``row`` (n,)."""
    bounds = SimpleNamespace(low=-10.0, high=10.0, step=0.1)
    model = SimpleNamespace(
        parameters=(bounds,),
        causes=(cause,),
        n_nominal=0,
        data=None,
        jacobian=lambda p, signals, free: row[None, :],
        slice_of=lambda index: slice(0, 1),
        parameters_of=lambda p, index: p,
    )
    fit = SimpleNamespace(model=model, p=np.array([p]), free=(0,), signals=None, residual_um=residual_um)
    return cast(ModelFit, fit)


def errors_of(cause: CauseModel, freer: float) -> ParameterErrors:
    fit = fit_of(cause, 1.0, np.ones(N), np.zeros(N))
    return ParameterErrors(fit, np.array([0]), np.array([[0.01]]), np.zeros((4, 1)), np.array([freer]))


@pytest.mark.parametrize(("freer", "low", "high"), [(0.0, 0.0, 0.0), (0.7, 0.0, 1.4), (-0.3, -0.6, 0.0)])
def test_an_interval_reaches_to_the_number_beside_a_loop_of_free_form(freer: float, low: float, high: float) -> None:
    values, spans = numbers(errors_of(Gain(), freer), 0)
    half = WIDER * 1.96 * 2.0 * 0.1
    assert values["twice"] == 2.0
    assert spans["twice"] == pytest.approx((2.0 + low - half, 2.0 + high + half))


def test_a_loop_shape_is_not_compared_with_itself() -> None:
    _, spans = numbers(errors_of(replace(Gain(), approximates=True), 0.7), 0)
    assert spans["twice"] == pytest.approx((2.0 - WIDER * 0.392, 2.0 + WIDER * 0.392))


def test_the_interval_of_a_delay_is_wider_by_half_a_sample_of_the_recorders_hold() -> None:
    data = FitData(2e-3, np.linspace(0.0, 1.0, N), np.linspace(0.0, 1.0, N))
    assert Delay().unresolved(data) == {"tau_s": 1e-3}
    errors = errors_of(Blurred(), 0.0)
    low, high = numbers(errors, 0)[1]["twice"]
    assert high - low == pytest.approx(2.0 * (WIDER * 0.392 + 0.25))


def test_folds_that_differ_count_by_their_spread() -> None:
    """The jackknife in closed form: moves of ±d give a standard error of d sqrt(3) over four folds."""
    moves = np.array([[0.1], [-0.1], [0.1], [-0.1]])
    _, spans = numbers(replace(errors_of(Gain(), 0.0), moves=moves), 0)
    half = WIDER * 3.182446 * 2.0 * np.sqrt(0.75 * 0.04)
    assert spans["twice"] == pytest.approx((2.0 - half, 2.0 + half))


def test_what_a_loop_of_another_form_took_from_a_number_is_given_back() -> None:
    """y = c x + w play(x), fitted by c x alone: c is off by what x has of the play, and the freer loop says so."""
    t = np.arange(N) / 1000.0
    u = np.sin(2.0 * np.pi * 1.5 * t) * (1.0 + t)
    play, s = np.empty(N), float(u[0])
    for k in range(N):
        s = min(max(s, u[k] - 0.6), u[k] + 0.6)
        play[k] = s
    noise = 1e-4 * np.random.default_rng(1).standard_normal(N)
    x = np.gradient(u)
    y = 0.3 * x + 0.05 * play + noise
    c = float(x @ y / (x @ x))
    assert abs(c - 0.3) > 0.05
    fit = fit_of(Gain(), c, x, y - c * x)
    mask = np.ones(N, dtype=np.bool_)
    errors = parameter_errors(fit, mask, PARTS, Readings(FitData(1e-3, u, y), mask, 1e-4))
    assert c + errors.freer[0] == pytest.approx(0.3, abs=0.02)
    low, high = numbers(errors, 0)[1]["twice"]
    assert low < 0.6 < high


@pytest.mark.parametrize(("freer", "held"), [(0.0, False), (-0.7, False), (-0.9, True)])
def test_a_number_may_be_zero_where_its_interval_holds_zero(freer: float, held: bool) -> None:
    """1 ± 0.196, and as far as the number beside a freer loop."""
    assert across_zero(errors_of(Gain(), freer), 0) is held


@pytest.mark.parametrize("small", [False, True])
def test_a_single_number_that_may_be_zero_is_dropped_however_much_it_removes(small: bool) -> None:
    """A gain of nothing, and one of 1 whose interval is far from zero."""
    mask, noise = np.ones(N, dtype=np.bool_), np.random.default_rng(3).standard_normal(N)
    search = Search(mask, PARTS, 1.0, Thresholds(), 0, lambda stage, share: None)
    assert search.may_be_zero(fit_of(Gain(), 0.0, np.ones(N), noise), 0, small)
    assert not search.may_be_zero(fit_of(Gain(), 1.0, np.ones(N), noise), 0, small)


@pytest.mark.parametrize(("width", "held"), [(0.1, True), (0.5, False)])
def test_what_the_nominal_stage_may_give_away_is_not_asked_to_be_zero(width: float, held: bool) -> None:
    """A weight of 2 ± 0.2, which the nominal stage lacks, beside a width of ``width`` ± 0.4."""

    @dataclass(frozen=True)
    class Loop(Gain):
        shared: tuple[str, ...] = ("weight",)

        def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
            return {"width": (width, np.array([2.0])), "weight": (2.0, np.array([1.0]))}

    assert across_zero(errors_of(Loop(), 0.0), 0) is held


@dataclass(frozen=True)
class Silent(Gain):
    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        return {}


def test_a_cause_without_numbers_is_not_nothing() -> None:
    assert not across_zero(errors_of(Silent(), 0.0), 0)


@dataclass(frozen=True)
class Number(CauseModel):
    """A cause with one number."""

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        return {"tau_s": (float(p[0]), np.ones(1))}


class Tie:
    """A fit of causes with one number each."""

    def __init__(self, **of: float) -> None:
        self.model, self.p = self, np.array(list(of.values()))
        self.causes, self.data = tuple(Number(name=name) for name in of), None

    def parameters_of(self, p: FloatArray, index: int) -> FloatArray:
        return p[index : index + 1]


@pytest.mark.parametrize(
    ("tie", "span"),
    [
        # Another name of this cause has its own number, and this cause another one beside another name of a second.
        (Tie(hysteresis_shape=9.0, delay=4.0), (2.0, 5.0)),
        (Tie(sensor_lag=1.0, rate_dependence=9.0), (0.0, 4.0)),
        (Tie(sensor_lag=3.5, rate_dependence=9.0), (2.0, 4.5)),
        (Tie(), (2.0, 4.0)),
    ],
)
def test_an_interval_holds_the_number_in_every_fit_that_does_as_well(tie: Tie, span: tuple[float, float]) -> None:
    said = over_ties({"tau_s": 3.0}, {"tau_s": (2.0, 4.0)}, "sensor_lag", [cast(ModelFit, tie)])
    assert said == {"tau_s": span}
