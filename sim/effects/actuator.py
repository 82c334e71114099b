"""The actuator from voltage to displacement; a stage has one of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dehyst.baselines.bouc_wen.step import hysteresis_step
from dehyst.sim.effects.base import Context, Kind, Parameter, Place, block

# --- linear_actuator ---
# An actuator without hysteresis: displacement in proportion to voltage.


@block
def run_linear_actuator(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain, µm/V; offset, µm."""
    for k in range(n):
        x[k] = p[1] + p[0] * x[k]


LINEAR_ACTUATOR = Kind(
    name="linear_actuator",
    place=Place.ACTUATOR,
    parameters=(
        Parameter("gain_um_per_V", "µm/V", -1e4, 1e4, 11.35, "displacement per volt of command"),
        Parameter("offset_um", "µm", -1e4, 1e4, 0.0, "displacement at 0 V"),
    ),
    derive=lambda values, context: (values["gain_um_per_V"], values["offset_um"]),
    block=run_linear_actuator,
    signature="a straight line",
    source="d of Table 2.1: 1.1351e-5 m/V",
)


# --- bouc_wen ---
# The Bouc-Wen actuator of the chapter, (2.1) and (2.2) with n = 1: displacement ``d u - h``.
#
# The voltage alone drives ``h``. `baselines.bouc_wen.step` advances it exactly over a monotone change of any size.


@block
def run_bouc_wen(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: d, alpha d, beta, gamma, offset. s: h in µm, voltage so far."""
    for k in range(n):
        s[0] = hysteresis_step(s[0], x[k] - s[1], p[1], p[2], p[3])
        s[1] = x[k]
        x[k] = p[4] + p[0] * s[1] - s[0]


def derive_bouc_wen(values: Mapping[str, float], context: Context) -> Sequence[float]:
    d = values["d_um_per_V"]
    return d, max(values["alpha"] * d, 1e-12), values["beta_per_V"], values["gamma_per_V"], values["offset_um"]


BOUC_WEN = Kind(
    name="bouc_wen",
    place=Place.ACTUATOR,
    parameters=(
        Parameter("d_um_per_V", "µm/V", 1e-6, 1e5, 11.351, "piezoelectric coefficient d"),
        Parameter("alpha", "1", 0.0, 1.0, 0.4754, "share of d that hysteresis takes away"),
        Parameter("beta_per_V", "1/V", 0.0, 10.0, 0.8718, "loop shape beta"),
        Parameter("gamma_per_V", "1/V", -10.0, 10.0, 0.9925, "loop shape gamma"),
        Parameter("offset_um", "µm", -1e4, 1e4, 0.0, "displacement at 0 V"),
    ),
    derive=derive_bouc_wen,
    rest=lambda values, context: (0.0, 0.0),
    block=run_bouc_wen,
    signature="symmetric loops without nonlocal memory, the same at every rate",
    source="identified values of Table 2.1",
)


# --- generalised_play ---
# A hysteretic actuator of sixty generalised plays, richer than the models that are fitted to it.
#
# Thresholds are unevenly spaced and weights uneven. Each play lies between a lower and an upper envelope of different
# slope, so loops are asymmetric and change with the level: generalised plays are in the Preisach class, beyond the
# Prandtl-Ishlinskii one. The thresholds grow with the smoothed rate of the voltage. The memory is nonlocal. At
# vanishing rate it has the wiping-out and congruency properties, at a finite rate neither.

GENERALISED_PLAYS = 60
#: Voltage that the parameters of asymmetry refer to, V.
BEND_V = 10.0


@block
def run_generalised_play(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: see derive. s: smoothed rate, voltage so far, play outputs."""
    plays = int(p[0])
    for k in range(n):
        u = x[k]
        s[0] = p[1] * s[0] + p[2] * abs(u - s[1])
        s[1] = u
        grown = p[3] * math.log1p(s[0] * p[4])
        lower, upper = 1.0 + p[5] * u, 1.0 + p[6] * u
        total = p[7] + p[8] * u + p[9] * u * u
        for j in range(plays):
            r = p[10 + j] + grown
            low, high = u - r * lower, u + r * upper
            z = s[2 + j]
            z = low if z < low else z
            z = high if z > high else z
            s[2 + j] = z
            total += p[10 + plays + j] * z
        x[k] = total


def _play_thresholds_V(largest_V: float) -> Any:
    """Thresholds (60,), V: denser near zero."""
    return largest_V * ((np.arange(GENERALISED_PLAYS) + 1.0) / GENERALISED_PLAYS) ** 1.6


def _play_weights(values: Mapping[str, float]) -> Any:
    """Weights (60,), µm/V: a fading density with a fixed, uneven ripple, summing to ``play_um_per_V``."""
    r = _play_thresholds_V(values["largest_V"])
    width = np.diff(np.concatenate(([0.0], r)))
    index = np.arange(GENERALISED_PLAYS)
    ripple = 1.0 + 0.35 * np.sin(2.3 * index + 0.4) * np.cos(0.7 * index * index)
    raw = width * np.exp(-r / values["spread_V"]) * ripple
    return values["play_um_per_V"] * raw / raw.sum()


def derive_generalised_play(values: Mapping[str, float], context: Context) -> Sequence[float]:
    a = math.exp(-context.dt_s / values["rate_tau_s"])
    head = (
        float(GENERALISED_PLAYS),
        a,
        (1.0 - a) / context.dt_s,
        values["rate_growth_V"],
        1.0 / values["rate_corner_V_per_s"],
        values["lower_slope"] / BEND_V,
        values["upper_slope"] / BEND_V,
        values["offset_um"],
        values["linear_um_per_V"],
        values["square_um_per_V2"],
    )
    return [*head, *_play_thresholds_V(values["largest_V"]), *_play_weights(values)]


GENERALISED_PLAY = Kind(
    name="generalised_play",
    place=Place.ACTUATOR,
    parameters=(
        Parameter("linear_um_per_V", "µm/V", 0.0, 1e4, 6.0, "reversible part"),
        Parameter("square_um_per_V2", "µm/V²", -10.0, 10.0, 0.0, "curvature of the reversible part"),
        Parameter("play_um_per_V", "µm/V", 0.0, 1e4, 4.0, "sum of the weights of the plays"),
        Parameter("largest_V", "V", 0.1, 1000.0, 4.5, "largest threshold"),
        Parameter("spread_V", "V", 0.05, 1000.0, 1.5, "decay of the density of thresholds"),
        Parameter("lower_slope", "1", -0.9, 0.9, 0.10, "growth of the lower half-width per 10 V"),
        Parameter("upper_slope", "1", -0.9, 0.9, -0.08, "growth of the upper half-width per 10 V"),
        Parameter("rate_growth_V", "V", 0.0, 10.0, 0.04, "growth of all thresholds with ln(1 + rate/corner)"),
        Parameter("rate_corner_V_per_s", "V/s", 0.01, 1e5, 20.0, "rate from which thresholds grow"),
        Parameter("rate_tau_s", "s", 1e-5, 1.0, 0.004, "time over which the rate is felt"),
        Parameter("offset_um", "µm", -1e4, 1e4, 0.0, "displacement at 0 V"),
    ),
    derive=derive_generalised_play,
    rest=lambda values, context: [0.0] * (2 + GENERALISED_PLAYS),
    block=run_generalised_play,
    signature="loops that widen with amplitude and rate, rising and falling branches of different shape",
    source="shape after the generalised Prandtl-Ishlinskii literature; loop widths of the catalogue (10 to 15 % of a "
    "full stroke, 2 % small-signal); growth with the rate as in Fig. 2.3",
)
