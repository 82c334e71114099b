"""The review of accepted causes: what is dropped, and what may take the place of a cause."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.search import search as search_module
from dehyst.sim.diagnosis.search.held_out import HeldOut, Split
from dehyst.sim.diagnosis.search.screening import ScreenedCause
from dehyst.sim.diagnosis.search.search import AcceptedCause, CauseCandidate, Search, Thresholds, review
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, ModelFit
from dehyst.sim.readings.sight import Sight

#: Twelve stretches of two blocks of ten samples.
PARTS = Split(np.arange(25) * 10, np.repeat(np.arange(12) % 4, 2))
SIGMA_UM = 0.1


def held(per_stretch_um2: FloatArray) -> HeldOut:
    blocks = np.repeat(per_stretch_um2 / 2.0, 2)
    return HeldOut(blocks, float(blocks.sum()))


def changed(per_stretch_um: FloatArray) -> FloatArray:
    return np.repeat(per_stretch_um, 20)


@dataclass(frozen=True)
class Model:
    """Two causes and nothing to simulate."""

    causes: tuple[CauseModel, ...]
    data: None = None

    def parameters_of(self, p: FloatArray, index: int) -> FloatArray:
        return p


@dataclass(frozen=True)
class Fit:
    model: Model
    residual_um: FloatArray
    held: HeldOut
    p: FloatArray = field(default_factory=lambda: np.zeros(1))
    sse_um2: float = 1.0

    def without_signals(self) -> Fit:
        return self


@dataclass
class Reviewed(Search):
    """A search over made-up fits. ``size``: each cause by stretch (µm); each is fitted with a size of 1."""

    size: dict[str, FloatArray] = field(default_factory=dict)
    skipped: list[set[str]] = field(default_factory=list)
    #: What the refit of the causes that are left finds in the place of the one that was removed.
    rival: CauseCandidate | None = None
    #: Causes whose numbers may all be zero.
    zero: tuple[str, ...] = ()

    def fit_of(self, causes: tuple[CauseModel, ...]) -> ModelFit:
        names = {c.name for c in causes}
        left = np.zeros(12)
        for name, size in self.size.items():
            left = left + size - (name in names)
        return cast(ModelFit, Fit(Model(causes), changed(left), held(np.square(left) + 0.01)))

    def without(self, fit: ModelFit, index: int) -> ModelFit:
        return self.fit_of((*fit.model.causes[:index], *fit.model.causes[index + 1 :]))

    def held(self, fit: ModelFit) -> HeldOut:
        return cast(Fit, fit).held

    def filled(self, fit: ModelFit) -> tuple[ModelFit, HeldOut]:
        return fit, self.held(fit)

    def cost(self, fit: ModelFit, held: HeldOut, base: ModelFit) -> float:
        return held.sse_um2

    def looks(self, fit: ModelFit, skip: set[str]) -> tuple[list[ScreenedCause], list[CauseModel]]:
        self.skipped.append(skip)
        return [], []

    def refit(
        self, base: ModelFit, looks: list[ScreenedCause], count: int, least_um2: float, also: tuple[str, ...] = ()
    ) -> list[CauseCandidate]:
        return [self.rival] if self.rival else []

    def polish(self, candidate: CauseCandidate, base: ModelFit) -> CauseCandidate:
        return candidate

    def finer(self, accepted: CauseCandidate, base: ModelFit) -> CauseCandidate:
        return accepted

    def may_be_zero(self, fit: ModelFit, index: int, small: bool) -> bool:
        return fit.model.causes[index].name in self.zero


def reviewed(size: dict[str, FloatArray], sights: dict[str, Sight] | None = None) -> tuple[Reviewed, list[str]]:
    mask = np.ones(240, dtype=np.bool_)
    search = Reviewed(mask, PARTS, SIGMA_UM, Thresholds(), 0, lambda *_: None, size=size, sights=sights or {})
    fit = search.fit_of(tuple(replace(CauseModel(), name=name) for name in size))
    steps = {name: AcceptedCause(name, 0.001, 0.5) for name in size}
    _, _, found = review(search, fit, search.held(fit), steps)
    return search, [one.name for one in found]


@pytest.mark.parametrize(
    ("rival", "seen", "left_um2", "alternatives"),
    [
        ("creep", None, 0.03, ("creep",)),
        ("creep", None, 0.4, ()),
        # A loop is easily mistaken for a delay, unless a direct test sees it.
        ("delay", None, 0.06, ("delay",)),
        ("delay", None, 0.45, ("delay",)),
        ("delay", None, 0.55, ()),
        ("delay", True, 0.03, ("delay",)),
        ("delay", True, 0.4, ()),
    ],
)
def test_what_does_as_well_is_an_alternative_and_what_falls_short_only_of_what_is_not_seen(
    rival: str, seen: bool | None, left_um2: float, alternatives: tuple[str, ...]
) -> None:
    search, _ = reviewed({"hysteresis_shape": np.ones(12)}, sights={"hysteresis_shape": Sight(seen, "")})
    fit = search.fit_of((replace(CauseModel(), name="hysteresis_shape"),))
    other, left = replace(CauseModel(), name=rival), held(np.full(12, left_um2))
    there = cast(ModelFit, Fit(Model((other,)), changed(np.sqrt(np.full(12, left_um2))), left))
    search.rival = CauseCandidate(other, there, left, left.sse_um2)
    steps = {"hysteresis_shape": AcceptedCause("hysteresis_shape", 0.001, 0.9)}
    _, _, (found,) = review(search, fit, search.held(fit), steps)
    assert found.alternatives == alternatives


def test_the_search_goes_on_without_a_cause_whose_numbers_may_be_zero() -> None:
    search, _ = reviewed({"rate_dependence": np.ones(12)})
    search.zero, search.skipped = ("rate_dependence",), []
    fit = search.fit_of((replace(CauseModel(), name="rate_dependence"),))
    _, _, found = review(search, fit, search.held(fit), {})
    assert not found
    assert search.skipped == [{"rate_dependence"}]


@dataclass(frozen=True)
class Numbers(CauseModel):
    """Two reported numbers, of one parameter or of two."""

    parameters_told: int = 1

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        gradients = np.eye(2) if self.parameters_told == 2 else np.array([[1.0, 0.0], [3.0, 0.0]])
        return {"one": (0.1, gradients[0]), "other": (0.2, gradients[1])}


@pytest.mark.parametrize(("told", "small", "dropped"), [(1, False, True), (2, False, False), (2, True, True)])
def test_a_number_that_may_be_zero_counts_alone_and_one_of_several_only_in_a_small_cause(
    monkeypatch: pytest.MonkeyPatch, told: int, small: bool, dropped: bool
) -> None:
    monkeypatch.setattr(search_module, "parameter_errors", lambda *_: None)
    monkeypatch.setattr(search_module, "across_zero", lambda *_: True)
    search, _ = reviewed({"delay": np.ones(12)})
    fit = search.fit_of((Numbers(name="delay", parameters_told=told),))
    assert Search.may_be_zero(search, fit, 0, small) is dropped


def test_what_the_readings_show_is_tried_first() -> None:
    search, _ = reviewed({"creep": np.ones(12)}, sights={"creep": Sight(True, ""), "delay": Sight(None, "")})
    causes = [replace(CauseModel(), name=name) for name in ("delay", "hysteresis_shape", "creep")]
    fit = search.fit_of(())
    tried = [CauseCandidate(c, fit, search.held(fit), cost) for c, cost in zip(causes, (2.0, 1.0, 9.0), strict=True)]
    order = [c.cause.name for c in sorted(tried, key=search._with_witness)]
    assert order == ["creep", "hysteresis_shape", "delay"]


def test_the_other_one_of_a_set_is_no_rival_of_a_third_cause() -> None:
    """Actuator curve and sensor polynomial show only their sum: both would be named for one curve."""
    search, named = reviewed({"asymmetry": np.ones(12), "mains_hum": np.ones(12)})
    assert named == ["asymmetry", "mains_hum"]
    of_asymmetry, of_hum = search.skipped
    assert "sensor_nonlinearity" not in of_asymmetry
    assert {"asymmetry", "sensor_nonlinearity"} <= of_hum


@pytest.mark.parametrize(
    ("nominal_um2", "seen", "named"), [(590.0, None, ["delay"]), (610.0, None, []), (610.0, True, ["delay"])]
)
def test_what_no_direct_test_sees_removes_a_tenth_of_the_nominal_error(
    nominal_um2: float, seen: bool | None, named: list[str]
) -> None:
    """It removes 60 um2 of 108, the rest of which has no name. The review asks what the search asks."""
    search, _ = reviewed({"delay": np.ones(12)}, sights={"delay": Sight(seen, "")})
    search.size["unknown"] = np.full(12, 2.0)
    search.nominal_um2 = nominal_um2
    fit = search.fit_of((replace(CauseModel(), name="delay"),))
    steps = {"delay": AcceptedCause("delay", 0.001, 0.5)}
    _, _, found = review(search, fit, search.held(fit), steps)
    assert [one.name for one in found] == named


def test_what_removes_nearly_all_that_is_above_the_noise_is_named_however_little_that_is() -> None:
    search, _ = reviewed({"delay": np.ones(12)})
    search.nominal_um2 = 1e6
    fit = search.fit_of((replace(CauseModel(), name="delay"),))
    _, _, (found,) = review(search, fit, search.held(fit), {"delay": AcceptedCause("delay", 0.001, 0.9)})
    assert found.name == "delay"


@dataclass(frozen=True)
class Line(CauseModel):
    """A permanent line, with no number that matters here."""

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (ModelParameter("amplitude_um", "um", 0.0, -1.0, 1.0, 0.1, ActsOn.READING, True),)

    def line_hz(self, p: FloatArray) -> float | None:
        return 50.0


@pytest.mark.parametrize(("shows", "gain", "named"), [(False, 0.9, True), (False, 0.05, False), (True, 0.05, True)])
def test_a_line_that_a_larger_error_hides_in_the_spectrum_is_named_like_any_cause(
    shows: bool, gain: float, named: bool
) -> None:
    """One that the spectrum shows is named however little it removes."""

    class Search50(Reviewed):
        def is_line(self, cause: CauseModel, p: FloatArray, base: ModelFit) -> bool:
            return shows

    search = Search50(np.ones(240, dtype=np.bool_), PARTS, SIGMA_UM, Thresholds(), 0, lambda *_: None)
    search.nominal_um2 = 120.0
    before, after = held(np.full(12, 10.0)), held(np.full(12, 10.0 * (1.0 - gain)))
    line = Line(name="mains_hum")
    base, fit = (cast(ModelFit, Fit(Model(causes), np.zeros(240), before)) for causes in ((), (line,)))
    best = CauseCandidate(line, fit, after, after.sse_um2)
    assert search.acceptable(best, before, np.zeros(24), 0.001, base) is named
