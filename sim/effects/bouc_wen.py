"""The Bouc-Wen actuator of the chapter, (2.1) and (2.2) with n = 1: displacement ``d u - h``.

The voltage alone drives ``h``. `baselines.bouc_wen.step` advances it exactly over a monotone change of any size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from baselines.bouc_wen.step import hysteresis_step
from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: d, alpha d, beta, gamma, offset. s: h in µm, voltage so far."""
    for k in range(n):
        s[0] = hysteresis_step(s[0], x[k] - s[1], p[1], p[2], p[3])
        s[1] = x[k]
        x[k] = p[4] + p[0] * s[1] - s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    d = values["d_um_per_V"]
    return d, max(values["alpha"] * d, 1e-12), values["beta_per_V"], values["gamma_per_V"], values["offset_um"]


KIND = Kind(
    name="bouc_wen",
    place=Place.ACTUATOR,
    parameters=(
        Parameter("d_um_per_V", "µm/V", 1e-6, 1e5, 11.351, "piezoelectric coefficient d"),
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
