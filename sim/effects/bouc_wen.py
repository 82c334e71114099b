"""The Bouc-Wen actuator of the chapter, (2.1) and (2.2) with n = 1: displacement ``d u - h``.

``h`` is driven by ``u`` alone. Along a rising ``u`` it obeys ``dh/du = alpha d - beta h - gamma |h|``, along a
falling one ``-h`` obeys the same equation in ``-u``; on either side of zero that is linear, so one step with
monotone ``u`` is a closed form whatever its length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from adaptive.compiled import compiled
from sim.effects.base import Context, Kind, Parameter, Place, block


@compiled
def decay(h: float, drive: float, rate: float, length: float) -> float:
    """Solution after ``length`` of ``dh/dx = drive - rate h``; rate may be 0 or negative."""
    q = rate * length
    mean = length if abs(q) < 1e-9 else -math.expm1(-q) / rate
    return h * math.exp(-q) + drive * mean


@compiled
def advance(h: float, rise: float, drive: float, beta: float, gamma: float) -> float:
    """``h`` after a monotone change ``rise`` of the voltage, (2.2) with n = 1; ``drive`` = alpha d."""
    sign = 1.0 if rise >= 0.0 else -1.0
    g, length = sign * h, abs(rise)
    if g < 0.0:
        rate = beta - gamma
        inside = 1.0 - rate * g / drive
        # the voltage after which h crosses zero and the other branch holds
        if inside > 0.0:
            crossing = -g / drive if abs(rate) < 1e-9 else math.log(inside) / rate
        else:
            crossing = math.inf
        if crossing >= length:
            return sign * decay(g, drive, rate, length)
        g, length = 0.0, length - crossing
    return sign * decay(g, drive, beta + gamma, length)


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: d, alpha d, beta, gamma, offset. s: h in µm, voltage so far."""
    for k in range(n):
        s[0] = advance(s[0], x[k] - s[1], p[1], p[2], p[3])
        s[1] = x[k]
        x[k] = p[4] + p[0] * s[1] - s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    d = values["d_um_per_V"]
    return d, max(values["alpha"] * d, 1e-12), values["beta_per_V"], values["gamma_per_V"], values["offset_um"]


KIND = Kind(
    name="bouc_wen",
    place=Place.ACTUATOR,
    parameters=(
        Parameter("d_um_per_V", "µm/V", 1e-6, 1e5, 11.351, "piezoelectric coefficient d", log=True),
        Parameter("alpha", "1", 0.0, 1.0, 0.4754, "share of d that hysteresis takes away"),
        Parameter("beta_per_V", "1/V", 0.0, 10.0, 0.8718, "loop shape beta"),
        Parameter("gamma_per_V", "1/V", -10.0, 10.0, 0.9925, "loop shape gamma"),
        Parameter("offset_um", "µm", -1e4, 1e4, 0.0, "displacement at 0 V"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0),
    block=run,
    signature="symmetric loops without nonlocal memory, the same at every rate",
    source="identified values of Table 2.1",
    cause=False,
)
