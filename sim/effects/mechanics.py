"""The mechanics that a stage has: the chapter's, and a mode with hysteresis in its restoring force.

The chapter's mechanics are the left side of (2.1): mass, damping and stiffness as Table 2.1 gives them. They are stiff
and overdamped (poles at 396 and 3.2e6 rad/s) and are stepped in closed form.

The mode with hysteresis is a mechanical Bouc-Wen oscillator:

    y'' + 2 zeta w y' + w² (y + share Z) = w² x,      Z' = y' - (beta |y'| Z + gamma y' |Z|)

Z obeys (2.2) with n = 1 and the displacement in place of the voltage; it is exact over a sub-step in which y is
monotone. The linear part is exact for a force that is linear within a sub-step; the force is predicted and corrected
once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from dehyst.baselines.bouc_wen.step import hysteresis_step
from dehyst.sim.effects.base import Context, Kind, Parameter, Place, block
from dehyst.sim.effects.holds import second_order


@block
def run_mode(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: the eight coefficients of `second_order`. s: position µm, velocity µm/s, input so far µm."""
    for k in range(n):
        now = x[k]
        position = p[0] * s[0] + p[1] * s[1] + p[2] * s[2] + p[3] * now
        s[1] = p[4] * s[0] + p[5] * s[1] + p[6] * s[2] + p[7] * now
        s[0], s[2] = position, now
        x[k] = position


def derive_mechanics(values: Mapping[str, float], context: Context) -> Sequence[float]:
    m = (values["mass_kg"] + values["payload_kg"]) * (1.0 + context.payload_ratio)
    b, k = values["damping_N_s_per_m"], values["stiffness_N_per_m"]
    return second_order(math.sqrt(k / m), b / (2.0 * math.sqrt(k * m)), context.dt_s, context.hold_per_s)


MECHANICS = Kind(
    name="mechanics",
    place=Place.MECHANICS,
    parameters=(
        Parameter("mass_kg", "kg", 1e-6, 1e3, 0.2789, "moved mass m"),
        Parameter("damping_N_s_per_m", "N s/m", 1e-3, 1e9, 8.9055e5, "damping b"),
        Parameter("stiffness_N_per_m", "N/m", 1.0, 1e12, 3.5244e8, "stiffness k"),
        Parameter("payload_kg", "kg", 0.0, 1e3, 0.0, "mass of a payload"),
    ),
    derive=derive_mechanics,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run_mode,
    signature="with the chapter's values a lag of 2.5 ms",
    source="identified values of Table 2.1",
)


#: Sub-steps of a sample.
SUBSTEPS = 8


@block
def run_mechanical_hysteresis(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
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


def derive_mechanical_hysteresis(values: Mapping[str, float], context: Context) -> Sequence[float]:
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


MECHANICAL_HYSTERESIS = Kind(
    name="mechanical_hysteresis",
    place=Place.MECHANICS,
    parameters=(
        Parameter("frequency_Hz", "Hz", 0.1, 1e5, 400.0, "undamped frequency of the spring alone"),
        Parameter("damping_ratio", "1", 1e-4, 100.0, 0.03, "damping ratio of the dashpot alone"),
        Parameter("stiffness_share", "1", 0.0, 30.0, 0.2, "stiffness of the loop at small motion, of the spring's"),
        Parameter("beta_per_um", "1/µm", 0.0, 1e3, 0.1, "beta of the loop, in displacement"),
        Parameter("gamma_per_um", "1/µm", -1e3, 1e3, 0.0, "gamma of the loop, in displacement"),
    ),
    derive=derive_mechanical_hysteresis,
    rest=lambda values, context: (0.0, 0.0, 0.0, 0.0, 0.0),
    block=run_mechanical_hysteresis,
    signature="a resonance whose frequency falls and whose damping changes with the amplitude",
    source="Noël, Schoukens, 'Hysteretic benchmark with a dynamic nonlinearity', 2016",
)
