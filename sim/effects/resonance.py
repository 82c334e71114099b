"""A lightly damped mode of the stage's mechanics, with the mass of a payload."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import second_order


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: the eight coefficients of `second_order`. s: position µm, velocity µm/s, input so far µm."""
    for k in range(n):
        now = x[k]
        position = p[0] * s[0] + p[1] * s[1] + p[2] * s[2] + p[3] * now
        s[1] = p[4] * s[0] + p[5] * s[1] + p[6] * s[2] + p[7] * now
        s[0], s[2] = position, now
        x[k] = position


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # a payload adds mass; spring and dashpot, and so the DC gain, stay
    mass = (1.0 + values["payload_ratio"]) * (1.0 + context.payload_ratio)
    omega = 2.0 * math.pi * values["frequency_Hz"] / math.sqrt(mass)
    return second_order(omega, values["damping_ratio"] / math.sqrt(mass), context.dt_s, context.hold_per_s)


KIND = Kind(
    name="resonance",
    place=Place.MECHANICS,
    parameters=(
        Parameter("frequency_Hz", "Hz", 5.0, 1e5, 400.0, "undamped frequency without payload"),
        Parameter("damping_ratio", "1", 0.001, 100.0, 0.03, "damping ratio without payload"),
        Parameter("payload_ratio", "1", 0.0, 20.0, 0.0, "mass of the payload relative to the moved mass"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run,
    signature="ringing after steps; a peak and -180° in the response",
    mistaken_for=("mains_hum", "payload_change"),
    tells_apart="hum is a fixed line that is there without excitation",
    source="300 to 500 Hz, damping 0.01 to 0.05 for a 100 µm flexure stage (common knowledge of the field)",
)
