"""The chapter's mechanics, the left side of (2.1): mass, damping and stiffness as Table 2.1 gives them.

They are stiff and overdamped (poles at 396 and 3.2e6 rad/s) and are stepped in closed form.
"""

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
    m = (values["mass_kg"] + values["payload_kg"]) * (1.0 + context.payload_ratio)
    b, k = values["damping_N_s_per_m"], values["stiffness_N_per_m"]
    return second_order(math.sqrt(k / m), b / (2.0 * math.sqrt(k * m)), context.dt_s, context.hold_per_s)


KIND = Kind(
    name="mechanics",
    place=Place.MECHANICS,
    parameters=(
        Parameter("mass_kg", "kg", 1e-6, 1e3, 0.2789, "moved mass m"),
        Parameter("damping_N_s_per_m", "N s/m", 1e-3, 1e9, 8.9055e5, "damping b"),
        Parameter("stiffness_N_per_m", "N/m", 1.0, 1e12, 3.5244e8, "stiffness k"),
        Parameter("payload_kg", "kg", 0.0, 1e3, 0.0, "mass of a payload"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run,
    signature="with the chapter's values a lag of 2.5 ms",
    source="identified values of Table 2.1",
    cause=False,
)
