"""A smooth hysteretic part without return-point memory (Coleman and Hodgdon's Duhem model), added to the actuator.

Along a rising voltage ``dh/du = A (f(u) - h) + D``, along a falling one ``dh/du = -A (f(u) - h) + D``, with ``f(u) = f1
u + f2 u²``: linear in ``h``, hence solved in closed form over any monotone step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from dehyst.adaptive.compiled import compiled
from dehyst.sim.effects.base import Context, Kind, Parameter, Place, block


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
)
