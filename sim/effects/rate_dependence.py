"""A loop that widens with the rate of the voltage: plays whose thresholds grow with the rate.

The effect adds the difference between plays with grown thresholds and the same plays without growth, so it vanishes at
low rate. ``growth_per_decade`` is relative to the loop of height ``width_um``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim.effects.base import Context, Kind, Parameter, Place, block

PLAYS = 8
#: Time constant of the rate, s; shorter than any period of interest, so it is not a parameter.
RATE_TAU_S = 0.004


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: pole, weight of a change, growth, 1/corner, thresholds, weights. s: rate, voltage, both sets of plays."""
    for k in range(n):
        u = v[k]
        s[0] = p[0] * s[0] + p[1] * abs(u - s[1])
        s[1] = u
        grown = 1.0 + p[2] * math.log1p(s[0] * p[3])
        for j in range(PLAYS):
            r, still, moving = p[4 + j], s[2 + j], s[2 + PLAYS + j]
            still = min(max(still, u - r), u + r)
            moving = min(max(moving, u - r * grown), u + r * grown)
            s[2 + j], s[2 + PLAYS + j] = still, moving
            x[k] += p[4 + PLAYS + j] * (moving - still)


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    a = math.exp(-context.dt_s / RATE_TAU_S)
    r = values["largest_V"] * (np.arange(PLAYS) + 0.5) / PLAYS
    weight = np.full(PLAYS, values["width_um"] / (2.0 * float(r.sum())))
    growth = values["growth_per_decade"] / math.log(10.0)
    return [a, (1.0 - a) / context.dt_s, growth, 1.0 / values["corner_V_per_s"], *r, *weight]


KIND = Kind(
    name="rate_dependence",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter("growth_per_decade", "1", -0.3, 1.0, 0.1, "relative growth of the loop per decade of rate"),
        Parameter("corner_V_per_s", "V/s", 0.01, 1e5, 10.0, "rate above which it grows"),
        Parameter("width_um", "µm", 0.01, 100.0, 11.0, "height of the loop that it acts on"),
        Parameter("largest_V", "V", 0.05, 200.0, 2.0, "largest threshold of that loop"),
    ),
    derive=derive,
    rest=lambda values, context: [0.0] * (2 + 2 * PLAYS),
    block=run,
    signature="loop width varies with the rate beyond what one linear filter explains",
    mistaken_for=("amplifier_lag", "sensor_lag", "delay", "resonance", "hysteresis_shape"),
    tells_apart="fit the linear part first, then test again at another amplitude",
    source="a few percent over decades of rate (common knowledge of the field); Fig. 2.3 of the chapter",
)
