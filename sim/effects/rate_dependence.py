"""A loop that widens with the rate of the voltage: plays whose thresholds grow with the rate.

The effect adds the difference between plays with grown thresholds and the same plays without growth, so it vanishes at
low rate. ``growth_per_decade`` is relative to the loop of height ``width_um``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.hysteresis_loops import (
    bouc_wen_paced,
    filtered_rate,
    grown_plays,
    loop_numbers,
)
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.cycles import loop_widths
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


RATE_PLAYS = 8
#: Time constant of the rate, s; shorter than any period of interest, so it is not a parameter.
RATE_TAU_S = 0.004


@block
def run_rate_dependence(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: pole, weight of a change, growth, 1/corner, thresholds, weights. s: rate, voltage, both sets of plays."""
    for k in range(n):
        u = v[k]
        s[0] = p[0] * s[0] + p[1] * abs(u - s[1])
        s[1] = u
        grown = 1.0 + p[2] * math.log1p(s[0] * p[3])
        for j in range(RATE_PLAYS):
            r, still, moving = p[4 + j], s[2 + j], s[2 + RATE_PLAYS + j]
            still = min(max(still, u - r), u + r)
            moving = min(max(moving, u - r * grown), u + r * grown)
            s[2 + j], s[2 + RATE_PLAYS + j] = still, moving
            x[k] += p[4 + RATE_PLAYS + j] * (moving - still)


def derive_rate_dependence(values: Mapping[str, float], context: Context) -> Sequence[float]:
    a = math.exp(-context.dt_s / RATE_TAU_S)
    r = values["largest_V"] * (np.arange(RATE_PLAYS) + 0.5) / RATE_PLAYS
    weight = np.full(RATE_PLAYS, values["width_um"] / (2.0 * float(r.sum())))
    growth = values["growth_per_decade"] / math.log(10.0)
    return [a, (1.0 - a) / context.dt_s, growth, 1.0 / values["corner_V_per_s"], *r, *weight]


# Its form in a diagnosis.


@dataclass(frozen=True)
class RateDependence(CauseModel):
    """A loop that widens with log10(1 + rate/v0).

    ``variant`` "width": the loop's width follows the rate at once, and its driving term does; the loop may widen about
    another line than its own middle, so that the gain changes with the rate as well. "thresholds" and "added": plays
    whose thresholds grow by a share, or by as many volts, less the same plays at rest. ``with_slope``: the driving term
    of the nominal loop follows the rate, too. Where a loop of another shape has taken the place of the nominal one,
    nothing shows its number.
    """

    test_answers_to_others: bool = True
    model_error: float = 0.3
    never_zero: bool = True
    variant: str = "width"
    with_slope: bool = True
    #: Time constant of the lag that filters the rate, s; with ``free_rate_lag`` the start value of its fit.
    rate_lag_s: float = 0.004
    free_rate_lag: bool = False

    def missing(self, data: FitData) -> str:
        # At one period the rate goes with the height, in strokes of one rate with nothing.
        spans = (float(np.ptp(np.log(x))) if x.size else 0.0 for x in data.strokes)
        return "" if min(spans) >= np.log(3.0) else "strokes of two durations and rates, a factor of three apart"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 0.003 <= self.reported(p, data)["growth_per_decade"][0] <= 0.6

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        v = data.swing_V
        pace = ModelParameter(
            "log_v0", "1", float(np.log(v)), float(np.log(0.05 * v)), float(np.log(300.0 * v)), 0.5, ActsOn.STATIC
        )
        if self.variant != "width":
            g = data.range_um / max(v, 1e-9)
            w = tuple(
                ModelParameter(f"weight{j}_um_per_V", "µm/V", 0.0, -g, g, 0.1 * g, ActsOn.STATIC) for j in (1, 2, 3)
            )
            return (*w, pace)
        most = 1.0 if self.with_slope else 0.0
        own = (
            ModelParameter("width_per_decade", "1", 0.0, -1.0, 1.0, 0.02, ActsOn.STATIC),
            ModelParameter("slope_per_decade", "1", 0.0, -most, most, 0.02, ActsOn.STATIC),
            ModelParameter("gain_per_decade", "1", 0.0, -0.05, 0.05, 1e-3, ActsOn.STATIC),
            pace,
        )
        felt = ModelParameter(
            "log_felt_s", "1", float(np.log(self.rate_lag_s)), float(np.log(2e-4)), 0.0, 0.2, ActsOn.STATIC
        )
        return (*own, felt) if self.free_rate_lag else own

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        if left_floors <= 1.2 or self.free_rate_lag:
            return None
        free = replace(self, variant="width", free_rate_lag=True)
        known = p if self.variant == "width" else np.array([0.02, 0.0, 0.0, np.log(2.0 * data.swing_V)])
        return free, [np.append(known, np.log(rate_lag_s)) for rate_lag_s in (0.004, 0.02)]

    def _paced(self, p: FloatArray) -> tuple[float, float]:
        """Rate above which the loop grows (V/s), and the time constant of the rate filter (s)."""
        if self.free_rate_lag:
            return float(np.exp(p[-2])), float(np.exp(p[-1]))
        return float(np.exp(p[-1])), self.rate_lag_s

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        parameters = self.parameters(data)
        out = []
        for f in (0.2, 2.0, 20.0, 200.0):
            rows = []
            for i in (i for i, one in enumerate(parameters[:-1]) if one.high > one.low):
                row = np.zeros(len(parameters))
                row[-1] = np.log(f * data.swing_V)
                row[i] = parameters[i].step
                rows.append(row)
            out.append(rows)
        return out

    def _growth(self, data: FitData) -> tuple[FloatArray, float, float]:
        """Thresholds at rest (V), and their growth per decade as a factor and in V."""
        if self.variant == "added":
            return np.array([0.0, 0.1, 0.3]) * data.swing_V, 0.0, 0.01 * data.swing_V
        return np.array([0.06, 0.18, 0.36]) * data.swing_V, 0.05, 0.0

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        if self.variant != "width":
            if not np.any(p[:3]):
                return None
            radii, factor, added = self._growth(data)
            pace = self._pace(u_V, p, data)
            return np.asarray(grown_plays(u_V, radii, np.ascontiguousarray(p[:3]), 1.0 + factor * pace, added * pace))
        if not np.any(p[1:3]):
            return None
        pace = self._pace(u_V, p, data)
        out = -p[2] * w_um * pace
        if p[1] != 0.0 and data.nominal_kind == "bouc_wen":
            slope, beta, gamma = loop_numbers(nominal)
            # The loop diverges if the driving term changes its sign.
            pace = np.maximum(pace, -0.9 / p[1]) if p[1] > 0.0 else np.minimum(pace, -0.9 / p[1])
            out -= bouc_wen_paced(u_V, slope, beta, gamma, float(h_um[0]), pace, float(p[1])) - h_um
        return np.asarray(out)

    def on_loop(
        self, u_V: FloatArray, loop_um: Callable[[], FloatArray], p: FloatArray, data: FitData
    ) -> FloatArray | None:
        return None if self.variant != "width" or p[0] == 0.0 else -p[0] * loop_um() * self._pace(u_V, p, data)

    def _pace(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        """(n,) decades of the rate above the corner."""
        corner_V_per_s, rate_lag_s = self._paced(p)
        rate = filtered_rate(u_V, float(np.exp(-data.dt_s / rate_lag_s)) if rate_lag_s > 0.0 else 0.0, data.dt_s)
        return np.asarray(np.log10(1.0 + rate / corner_V_per_s))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        v0, _ = self._paced(p)
        row, corner = np.zeros(p.size), np.zeros(p.size)
        corner[-2 if self.free_rate_lag else -1] = v0
        if self.variant != "width":
            # Growth of the loop height relative to the stroke.
            radii, factor, added = self._growth(data)
            row[:3] = 2.0 * (factor * radii + added) / data.range_um
        else:
            row[:2] = 1.0
        return {"growth_per_decade": (float(row @ p), row), "corner_V_per_s": (v0, corner)}


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    start = RATE_DEPENDENCE.clipped(
        growth_per_decade=0.1,
        corner_V_per_s=v["corner_V_per_s"],
        width_um=0.1 * data.range_um,
        largest_V=0.35 * data.swing_V,
    )
    return InLibrary((start,), refit=True)


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """Loop width over the rate: a part that goes with the logarithm, beside one of the height and a lag's part.

    The relative width that a lag leaves goes with the frequency, that of a loop with the height; the rest is due to
    the rate. Cycles of one height and rate are one observation.
    """
    kinds: dict[tuple[int, int], list[tuple[float, float, float, float]]] = {}
    for one in readings.once(loop_widths):
        kinds.setdefault((round(math.log(one[0]) / 0.1), round(math.log(one[1]) / 0.1)), []).append(one)
    rows = np.array([np.median(np.array(same), axis=0) for same in kinds.values()]).reshape(-1, 4)
    height, period, width = rows[:, 0], rows[:, 1], rows[:, 2]
    rate = 2.0 * height / np.maximum(period, 1e-12)
    if width.size < 7 or float(np.max(rate)) < 9.0 * float(np.min(rate)):
        words = f"{width.size} kinds of closed cycles; seven, over a decade of rates, are needed"
        return Sight(None, words)
    h = np.log(height / float(np.median(height)))
    lines = [np.ones_like(h), h, h * h, float(np.min(period)) / period, np.log10(rate / float(np.median(rate)))]
    columns = np.array(lines)
    solved, *_ = np.linalg.lstsq(columns.T, width, rcond=None)
    left = width - solved @ columns
    cover = np.linalg.pinv(columns @ columns.T) * float(left @ left) / max(1, width.size - columns.shape[0])
    mean = abs(float(solved[0])) + 1e-12
    growth, sigma = float(solved[-1]) / mean, float(np.sqrt(cover[-1, -1])) / mean
    words = (
        f"the loop widens by {100 * growth:.2g} ± {196 * sigma:.1g} % per decade of rate ({width.size} kinds of cycles "
        f"over {float(np.log10(np.max(rate) / np.min(rate))):.2g} decades, the parts of height and lag taken off)"
    )
    if growth > 6.0 * sigma and growth > 0.01:
        return Sight(True, words)
    return Sight(False if sigma < 0.003 and growth < 0.003 else None, words)


RATE_DEPENDENCE = Kind(
    name="rate_dependence",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter("growth_per_decade", "1", -0.3, 1.0, 0.1, "relative growth of the loop per decade of rate"),
        Parameter("corner_V_per_s", "V/s", 0.01, 1e5, 10.0, "rate above which it grows"),
        Parameter("width_um", "µm", 0.01, 100.0, 11.0, "height of the loop that it acts on"),
        Parameter("largest_V", "V", 0.05, 200.0, 2.0, "largest threshold of that loop"),
    ),
    derive=derive_rate_dependence,
    rest=lambda values, context: [0.0] * (2 + 2 * RATE_PLAYS),
    block=run_rate_dependence,
    signature="loop width varies with the rate beyond what one linear filter explains",
    mistaken_for=("amplifier_lag", "sensor_lag", "delay", "resonance", "hysteresis_shape"),
    tells_apart="fit the linear part first, then test again at another amplitude",
    source="a few percent over decades of rate (common knowledge of the field); Fig. 2.3 of the chapter",
    cause=Cause(
        sign="the loop widens with the logarithm of the rate, beside the parts of height and lag (seven kinds of "
        "cycles)",
        forms=(
            RateDependence(),
            RateDependence(rate_lag_s=0.04),
            RateDependence(with_slope=False),
            RateDependence(variant="thresholds"),
            RateDependence(variant="added"),
            RateDependence(variant="added", rate_lag_s=0.04),
        ),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.over_rate,
    ),
)
