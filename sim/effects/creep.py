"""Creep: after a step the displacement continues to grow with the logarithm of time.

It is a sum of first-order lags, two per decade from 0.1 to 1000 s, each with half the gain per decade. Within that span
it equals ``y0 (1 + g log10(t/t0))`` with a ripple below 3 % of the creep. Each lag is stepped in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import first_order

#: Time constants relative to the shortest: two per decade over four decades.
RATIOS = 10.0 ** (np.arange(9) / 2.0)
POLES = len(RATIOS)


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain of a pole, then (a, b0, b1) of each. s: slow parts, input so far, µm."""
    for k in range(n):
        now, total = x[k], 0.0
        for j in range(POLES):
            s[j] = p[1 + 3 * j] * s[j] + p[2 + 3 * j] * s[POLES] + p[3 + 3 * j] * now
            total += s[j]
        s[POLES] = now
        x[k] = now + p[0] * total


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    p = [values["gain_per_decade"] / 2.0]
    for ratio in RATIOS:
        p.extend(first_order(values["t0_s"] * float(ratio), context.dt_s, context.hold_per_s))
    return p


KIND = Kind(
    name="creep",
    place=Place.CREEP,
    parameters=(
        Parameter("gain_per_decade", "1", -0.02, 0.1, 0.015, "growth per decade of time, relative to the step"),
        Parameter("t0_s", "s", 0.005, 1.0, 0.1, "shortest time constant; the longest is ten thousand times that"),
    ),
    derive=derive,
    rest=lambda values, context: [0.0] * (POLES + 1),
    block=run,
    signature="holds rise linearly in log t, in proportion to the last step and with its sign",
    mistaken_for=("thermal_drift", "gain_drift"),
    tells_apart="thermal drift does not follow the steps",
    source="0.01 to 0.02 per decade, t0 = 0.1 s (piezo manufacturers' tutorials)",
)
