"""Additional hysteresis: plays on the voltage, with nonlocal memory.

Ten plays (2.4) have thresholds up to ``largest_V`` with decreasing density. Their linear part is subtracted, so the
effect is the loop alone and cannot be confused with a gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim.effects.base import Context, Kind, Parameter, Place, block

PLAYS = 10


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: thresholds, weights. s: play outputs."""
    for k in range(n):
        u = v[k]
        for j in range(PLAYS):
            z = min(max(s[j], u - p[j]), u + p[j])
            s[j] = z
            x[k] += p[PLAYS + j] * (z - u)


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    r = values["largest_V"] * (np.arange(PLAYS) + 0.5) / PLAYS
    raw = np.exp(-r / values["largest_V"] * values["fading"])
    # a stroke of four times the largest threshold and more opens a loop of height 2 sum(weight r)
    weight = values["width_um"] * raw / (2.0 * float(raw @ r))
    return [*r, *weight]


KIND = Kind(
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
    derive=derive,
    rest=lambda values, context: [0.0] * PLAYS,
    block=run,
    signature="a loop that persists as the frequency goes to zero; odd harmonics; the residual repeats with the loop",
    mistaken_for=("asymmetry", "rate_dependence", "delay", "stick_slip"),
    tells_apart="the loop of a delay vanishes as the frequency goes to zero",
    source="loop height 2 % (small signal) to 10-15 % (full stroke) of the stroke, piezo actuator tutorials",
)
