"""A mode with hysteresis in its restoring force, as in the mechanical Bouc-Wen oscillator.

    y'' + 2 zeta w y' + w² (y + share Z) = w² x,      Z' = y' - (beta |y'| Z + gamma y' |Z|)

Z obeys (2.2) with n = 1 and the displacement in place of the voltage; it is exact over a sub-step in which y is
monotone. The linear part is exact for a force that is linear within a sub-step; the force is predicted and corrected
once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from baselines.bouc_wen.step import hysteresis_step
from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import second_order

#: Sub-steps of a sample.
SUBSTEPS = 8


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: the eight coefficients of `second_order` for a sub-step, share, beta, gamma, and the input's way through a
    sample at the sub-steps' ends. s: position µm, velocity µm/s, input so far µm, Z and Z one sub-step ago, µm."""
    for k in range(n):
        came, goes = s[2], x[k]
        for j in range(SUBSTEPS):
            guess = 2.0 * s[3] - s[4]
            first = came + (goes - came) * p[11 + j] - p[8] * s[3]
            last = came + (goes - came) * p[12 + j] - p[8] * guess
            position = p[0] * s[0] + p[1] * s[1] + p[2] * first + p[3] * last
            late = p[8] * (guess - hysteresis_step(s[3], position - s[0], 1.0, p[9], p[10]))
            position += p[3] * late
            s[1] = p[4] * s[0] + p[5] * s[1] + p[6] * first + p[7] * (last + late)
            s[4] = s[3]
            s[3] = hysteresis_step(s[3], position - s[0], 1.0, p[9], p[10])
            s[0] = position
        s[2] = goes
        x[k] = s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # a payload adds mass; spring and dashpot, and so the DC gain, stay
    slower = 1.0 / math.sqrt(1.0 + context.payload_ratio)
    omega, zeta = 2.0 * math.pi * values["frequency_Hz"] * slower, values["damping_ratio"] * slower
    hold = context.hold_per_s
    if math.isinf(hold):
        way = [1.0] * (SUBSTEPS + 1)
    elif hold * context.dt_s < 1e-6:
        way = [j / SUBSTEPS for j in range(SUBSTEPS + 1)]
    else:
        whole = -math.expm1(-hold * context.dt_s)
        way = [-math.expm1(-hold * context.dt_s * j / SUBSTEPS) / whole for j in range(SUBSTEPS + 1)]
    loop = (values["stiffness_share"], values["beta_per_um"], values["gamma_per_um"])
    return (*second_order(omega, zeta, context.dt_s / SUBSTEPS, 0.0), *loop, *way)


KIND = Kind(
    name="mechanical_hysteresis",
    place=Place.MECHANICS,
    parameters=(
        Parameter("frequency_Hz", "Hz", 0.1, 1e5, 400.0, "undamped frequency of the spring alone"),
        Parameter("damping_ratio", "1", 1e-4, 100.0, 0.03, "damping ratio of the dashpot alone"),
        Parameter("stiffness_share", "1", 0.0, 30.0, 0.2, "stiffness of the loop at small motion, of the spring's"),
        Parameter("beta_per_um", "1/µm", 0.0, 1e3, 0.1, "beta of the loop, in displacement"),
        Parameter("gamma_per_um", "1/µm", -1e3, 1e3, 0.0, "gamma of the loop, in displacement"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0, 0.0, 0.0, 0.0),
    block=run,
    signature="a resonance whose frequency falls and whose damping changes with the amplitude",
    source="Noël, Schoukens, 'Hysteretic benchmark with a dynamic nonlinearity', 2016",
    cause=False,
)
