"""Hysteresis that is added to the displacement of the actuator."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adaptive.compiled import compiled
from sim.effects.base import Context, Kind, Parameter, Place, block

# --- duhem ---
# A smooth hysteretic part without return-point memory (Coleman and Hodgdon's Duhem model), added to the actuator.
#
# Along a rising voltage ``dh/du = A (f(u) - h) + D``, along a falling one ``dh/du = -A (f(u) - h) + D``, with ``f(u) =
# f1 u + f2 u²``: linear in ``h``, hence solved in closed form over any monotone step.


@compiled
def _duhem_branch(u: float, sign: float, f1: float, f2: float, a: float, d: float) -> float:
    """The solution that the branch of this direction (sign +1 rising, -1 falling) approaches."""
    return f1 * u + f2 * u * u - sign * (f1 + 2.0 * f2 * u) / a + 2.0 * f2 / (a * a) + sign * d / a


@block
def run_duhem(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: f1, f2, A, D. s: h in µm, voltage so far."""
    for k in range(n):
        rise = v[k] - s[1]
        if rise != 0.0:
            sign = 1.0 if rise > 0.0 else -1.0
            away = s[0] - _duhem_branch(s[1], sign, p[0], p[1], p[2], p[3])
            s[0] = _duhem_branch(v[k], sign, p[0], p[1], p[2], p[3]) + away * math.exp(-p[2] * abs(rise))
            s[1] = v[k]
        x[k] += s[0]


def derive_duhem(values: Mapping[str, float], context: Context) -> Sequence[float]:
    f1 = values["slope_um_per_V"]
    return f1, values["square_um_per_V2"], values["stiffness_per_V"], values["start_share"] * f1


DUHEM = Kind(
    name="duhem",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter("slope_um_per_V", "µm/V", 0.0, 1e4, 0.6, "slope of the curve that the loop lies around"),
        Parameter("square_um_per_V2", "µm/V²", -10.0, 10.0, 0.0, "curvature of that curve: asymmetry"),
        Parameter("stiffness_per_V", "1/V", 0.01, 100.0, 0.9, "how fast a branch is approached"),
        Parameter("start_share", "1", 0.0, 1.0, 0.15, "slope just after a reversal, as a share of the mean slope"),
    ),
    derive=derive_duhem,
    rest=lambda values, context: (0.0, 0.0),
    block=run_duhem,
    signature="minor loops that do not close on the point where they began",
    source="Coleman and Hodgdon 1986 (equation form); magnitude: 1 to 2 % of a full stroke",
    cause=False,
)


# --- hysteresis_shape ---
# Additional hysteresis: plays on the voltage, with nonlocal memory.
#
# Ten plays (2.4) have thresholds up to ``largest_V`` with decreasing density. Their linear part is subtracted, so the
# effect is the loop alone and cannot be confused with a gain.

SHAPE_PLAYS = 10


@block
def run_hysteresis_shape(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: thresholds, weights. s: play outputs."""
    for k in range(n):
        u = v[k]
        for j in range(SHAPE_PLAYS):
            z = min(max(s[j], u - p[j]), u + p[j])
            s[j] = z
            x[k] += p[SHAPE_PLAYS + j] * (z - u)


def derive_hysteresis_shape(values: Mapping[str, float], context: Context) -> Sequence[float]:
    r = values["largest_V"] * (np.arange(SHAPE_PLAYS) + 0.5) / SHAPE_PLAYS
    raw = np.exp(-r / values["largest_V"] * values["fading"])
    # a stroke of four times the largest threshold and more opens a loop of height 2 sum(weight r)
    weight = values["width_um"] * raw / (2.0 * float(raw @ r))
    return [*r, *weight]


HYSTERESIS_SHAPE = Kind(
    name="hysteresis_shape",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter(
            "width_um",
            "µm",
            -100.0,
            100.0,
            3.0,
            "height of the additional loop for strokes of four times the largest threshold and more",
        ),
        Parameter("largest_V", "V", 0.05, 200.0, 2.0, "largest threshold"),
        Parameter("fading", "1", -2.0, 6.0, 1.0, "how much rarer large thresholds are than small ones"),
    ),
    derive=derive_hysteresis_shape,
    rest=lambda values, context: [0.0] * SHAPE_PLAYS,
    block=run_hysteresis_shape,
    signature="a loop that persists as the frequency goes to zero; odd harmonics; the residual repeats with the loop",
    mistaken_for=("asymmetry", "rate_dependence", "delay", "stick_slip"),
    tells_apart="the loop of a delay vanishes as the frequency goes to zero",
    source="loop height 2 % (small signal) to 10-15 % (full stroke) of the stroke, piezo actuator tutorials",
)


# --- asymmetry ---
# Branches without point symmetry: a one-sided dead zone (2.8) on the output of a play (2.4).
#
# It is single-valued in the output of the play, but not in the voltage. Above the dead zone both the slope and the loop
# of the stage change, below it neither.


@block
def run_asymmetry(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: slope, dead zone, threshold. s: play output, V."""
    for k in range(n):
        z = min(max(s[0], v[k] - p[2]), v[k] + p[2])
        s[0] = z
        x[k] += p[0] * max(z - p[1], 0.0)


ASYMMETRY = Kind(
    name="asymmetry",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter("slope_um_per_V", "µm/V", -100.0, 100.0, 0.5, "slope added above the dead zone"),
        Parameter("dead_zone_V", "V", -200.0, 200.0, 4.0, "where the additional slope begins"),
        Parameter("threshold_V", "V", 0.0, 100.0, 1.0, "half-width of the play that the dead zone acts on"),
    ),
    derive=lambda values, context: (values["slope_um_per_V"], values["dead_zone_V"], values["threshold_V"]),
    rest=lambda values, context: (0.0,),
    block=run_asymmetry,
    signature="the two branches are not point-symmetric; even harmonics",
    mistaken_for=("sensor_nonlinearity", "hysteresis_shape"),
    tells_apart="a sensor's polynomial is single-valued and the same in both directions",
    source="0.5 to 3 % of the stroke (common knowledge of the field); form of the MPI model (2.8)-(2.10)",
)


# --- rate_dependence ---
# A loop that widens with the rate of the voltage: plays whose thresholds grow with the rate.
#
# The effect adds the difference between plays with grown thresholds and the same plays without growth, so it vanishes
# at low rate. ``growth_per_decade`` is relative to the loop of height ``width_um``.

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
)
