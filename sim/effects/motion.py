"""Slow changes of the displacement, and the share of the other axis in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.counter_noise import normal
from sim.effects.holds import first_order

# --- creep ---
# Creep: after a step the displacement continues to grow with the logarithm of time.
#
# It is a sum of first-order lags, two per decade from 0.1 to 1000 s, each with half the gain per decade. Within that
# span it equals ``y0 (1 + g log10(t/t0))`` with a ripple below 3 % of the creep. Each lag is stepped in closed form.

#: Time constants relative to the shortest: two per decade over four decades.
CREEP_RATIOS = 10.0 ** (np.arange(9) / 2.0)
CREEP_POLES = len(CREEP_RATIOS)


@block
def run_creep(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain of a pole, then (a, b0, b1) of each. s: slow parts, input so far, µm."""
    for k in range(n):
        now, total = x[k], 0.0
        for j in range(CREEP_POLES):
            s[j] = p[1 + 3 * j] * s[j] + p[2 + 3 * j] * s[CREEP_POLES] + p[3 + 3 * j] * now
            total += s[j]
        s[CREEP_POLES] = now
        x[k] = now + p[0] * total


def derive_creep(values: Mapping[str, float], context: Context) -> Sequence[float]:
    p = [values["gain_per_decade"] / 2.0]
    for ratio in CREEP_RATIOS:
        p.extend(first_order(values["t0_s"] * float(ratio), context.dt_s, context.hold_per_s))
    return p


CREEP = Kind(
    name="creep",
    place=Place.CREEP,
    parameters=(
        Parameter("gain_per_decade", "1", -0.02, 0.1, 0.015, "growth per decade of time, relative to the step"),
        Parameter("t0_s", "s", 0.005, 1.0, 0.1, "shortest time constant; the longest is ten thousand times that"),
    ),
    derive=derive_creep,
    rest=lambda values, context: [0.0] * (CREEP_POLES + 1),
    block=run_creep,
    signature="holds rise linearly in log t, in proportion to the last step and with its sign",
    mistaken_for=("thermal_drift", "gain_drift"),
    tells_apart="thermal drift does not follow the steps",
    source="0.01 to 0.02 per decade, t0 = 0.1 s (piezo manufacturers' tutorials)",
)


# --- cross_talk ---
# Cross-talk: a share of the other axis's displacement and velocity appears on this one.


@block
def run_cross_talk(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: static share, weight of a change. s: the other axis so far, µm, and whether it is known."""
    for k in range(n):
        if s[1] == 0.0:
            s[0], s[1] = w[k], 1.0
        x[k] += p[0] * w[k] + p[1] * (w[k] - s[0])
        s[0] = w[k]


CROSS_TALK = Kind(
    name="cross_talk",
    place=Place.CROSS_TALK,
    parameters=(
        Parameter("static", "1", -0.2, 0.2, 0.0117, "share of the other axis's displacement"),
        Parameter("rate_s", "s", -0.01, 0.01, 0.0, "share of the other axis's velocity"),
    ),
    derive=lambda values, context: (values["static"], values["rate_s"] / context.dt_s),
    rest=lambda values, context: (0.0, 0.0),
    block=run_cross_talk,
    signature="correlates with the other axis",
    tells_apart="drive the axes separately",
    source="1.17 % in the chapter (Fig. 2.2); 0.01 to 1 % in the field",
)


# --- thermal_drift ---
# Additive slow drift: a relaxation towards another temperature, a steady ramp, and a random walk.


@block
def run_thermal_drift(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: offset, amplitude, dt/tau, ramp per sample, step of the walk, seed. s: walk, µm."""
    for k in range(n):
        index = k0 + k
        if p[4] > 0.0:
            s[0] += p[4] * normal(p[5], index)
        x[k] += p[0] - p[1] * math.expm1(-p[2] * index) + p[3] * index + s[0]


def derive_thermal_drift(values: Mapping[str, float], context: Context) -> Sequence[float]:
    dt = context.dt_s
    walk = values["walk_um_per_sqrt_min"] * math.sqrt(dt / 60.0)
    ramp = values["ramp_um_per_min"] * dt / 60.0
    return values["offset_um"], values["amplitude_um"], dt / values["tau_s"], ramp, walk, float(context.seed)


THERMAL_DRIFT = Kind(
    name="thermal_drift",
    place=Place.DRIFT,
    parameters=(
        Parameter("amplitude_um", "µm", -20.0, 20.0, 0.5, "total way of the relaxation"),
        Parameter("tau_s", "s", 1.0, 1e5, 300.0, "its time constant"),
        Parameter("ramp_um_per_min", "µm/min", -10.0, 10.0, 0.0, "steady drift"),
        Parameter("walk_um_per_sqrt_min", "µm/√min", 0.0, 1.0, 0.0, "random walk, standard deviation after a minute"),
        Parameter("offset_um", "µm", -1e3, 1e3, 0.0, "constant offset"),
    ),
    derive=derive_thermal_drift,
    rest=lambda values, context: (0.0,),
    block=run_thermal_drift,
    signature="also there at zero input; follows the temperature where that is logged",
    mistaken_for=("creep", "gain_drift"),
    tells_apart="it does not follow the steps, creep does",
    source="up to 1 µm per kelvin and 50 mm of aluminium (expansion 23e-6 per kelvin)",
)


# --- gain_drift ---
# Gain drift ``y = (1 + g(t)) H[u]``, from ageing, temperature or a change in the amplifier.


@block
def run_gain_drift(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain, ramp per sample, amplitude, dt/tau, step of the walk, seed. s: walk."""
    for k in range(n):
        index = k0 + k
        if p[4] > 0.0:
            s[0] += p[4] * normal(p[5], index)
        x[k] *= 1.0 + p[0] + p[1] * index - p[2] * math.expm1(-p[3] * index) + s[0]


def derive_gain_drift(values: Mapping[str, float], context: Context) -> Sequence[float]:
    dt = context.dt_s
    walk = values["walk_per_sqrt_min"] * math.sqrt(dt / 60.0)
    ramp = values["ramp_per_min"] * dt / 60.0
    return values["gain"], ramp, values["amplitude"], dt / values["tau_s"], walk, float(context.seed)


GAIN_DRIFT = Kind(
    name="gain_drift",
    place=Place.GAIN,
    parameters=(
        Parameter("gain", "1", -0.5, 0.5, 0.0, "constant relative change of the gain"),
        Parameter("ramp_per_min", "1/min", -0.2, 0.2, 0.01, "steady relative change"),
        Parameter("amplitude", "1", -0.5, 0.5, 0.0, "relative change by relaxation"),
        Parameter("tau_s", "s", 1.0, 1e5, 300.0, "time constant of the relaxation"),
        Parameter("walk_per_sqrt_min", "1/√min", 0.0, 0.05, 0.0, "random walk, standard deviation after a minute"),
    ),
    derive=derive_gain_drift,
    rest=lambda values, context: (0.0,),
    block=run_gain_drift,
    signature="residual in proportion to the displacement, the slope changes over time",
    mistaken_for=("creep", "thermal_drift"),
    tells_apart="gain drift by temperature needs a log of the temperature",
    source="0.05 to 0.3 % per kelvin (common knowledge of the field)",
)
