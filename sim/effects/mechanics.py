"""The mechanics: modes, their payload, hysteresis of the restoring force, and friction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from baselines.bouc_wen.step import hysteresis_step
from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import second_order

# --- mechanics ---
# The chapter's mechanics, the left side of (2.1): mass, damping and stiffness as Table 2.1 gives them.
#
# They are stiff and overdamped (poles at 396 and 3.2e6 rad/s) and are stepped in closed form.


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
    cause=False,
)


# --- resonance ---
# A lightly damped mode of the stage's mechanics, with the mass of a payload.


def derive_resonance(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # a payload adds mass; spring and dashpot, and so the DC gain, stay
    mass = (1.0 + values["payload_ratio"]) * (1.0 + context.payload_ratio)
    omega = 2.0 * math.pi * values["frequency_Hz"] / math.sqrt(mass)
    return second_order(omega, values["damping_ratio"] / math.sqrt(mass), context.dt_s, context.hold_per_s)


RESONANCE = Kind(
    name="resonance",
    place=Place.MECHANICS,
    parameters=(
        Parameter("frequency_Hz", "Hz", 5.0, 1e5, 400.0, "undamped frequency without payload"),
        Parameter("damping_ratio", "1", 0.001, 100.0, 0.03, "damping ratio without payload"),
        Parameter("payload_ratio", "1", 0.0, 20.0, 0.0, "mass of the payload relative to the moved mass"),
    ),
    derive=derive_resonance,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run_mode,
    signature="ringing after steps; a peak and -180° in the response",
    mistaken_for=("mains_hum", "payload_change"),
    tells_apart="hum is a fixed line that is there without excitation",
    source="300 to 500 Hz, damping 0.01 to 0.05 for a 100 µm flexure stage (common knowledge of the field)",
)


# --- mechanical_hysteresis ---
# A mode with hysteresis in its restoring force, as in the mechanical Bouc-Wen oscillator.
#
#     y'' + 2 zeta w y' + w² (y + share Z) = w² x,      Z' = y' - (beta |y'| Z + gamma y' |Z|)
#
# Z obeys (2.2) with n = 1 and the displacement in place of the voltage; it is exact over a sub-step in which y is
# monotone. The linear part is exact for a force that is linear within a sub-step; the force is predicted and corrected
# once.

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
    cause=False,
)


# --- payload_change ---
# A payload on the stage: the known mode moves to ``f0 sqrt(m/(m+M))``, the DC gain does not.
#
# It multiplies the mass of `resonance` or `mechanics` in the same chain; a chain without either is refused.

PAYLOAD_CHANGE = Kind(
    name="payload_change",
    place=Place.MECHANICS,
    parameters=(Parameter("payload_ratio", "1", 0.0, 20.0, 1.0, "added mass relative to the moved mass"),),
    derive=lambda values, context: (),
    block=None,
    signature="the known mode moves, the DC gain does not",
    mistaken_for=("resonance",),
    tells_apart="a change of stiffness moves the DC gain too",
    source="-30 % of f0 when the mass doubles: f0 sqrt(m/(m+M))",
)


# --- stick_slip ---
# Stick-slip: friction in the guidance holds the displacement until the pull exceeds it.


@block
def run_stick_slip(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: half-width µm, share still stuck. s: where it sticks µm, 1 while slipping."""
    for k in range(n):
        away = x[k] - s[0]
        # sliding ends when the pull no longer exceeds sliding friction
        if s[1] * away <= p[0] * p[1]:
            s[1] = 0.0
        # it sticks until the pull exceeds static friction, then jumps and slides
        if s[1] == 0.0 and abs(away) > p[0]:
            s[1] = 1.0 if away > 0.0 else -1.0
        if s[1] != 0.0:
            s[0] = x[k] - s[1] * p[0] * p[1]
        x[k] = s[0]


STICK_SLIP = Kind(
    name="stick_slip",
    place=Place.FRICTION,
    parameters=(
        Parameter("width_um", "µm", 0.0, 5.0, 0.03, "half-width of the flat part after a reversal"),
        Parameter("sliding_share", "1", 0.0, 1.0, 0.5, "sliding friction as a share of static friction; 1: no jump"),
    ),
    derive=lambda values, context: (values["width_um"], values["sliding_share"]),
    rest=lambda values, context: (0.0, 0.0),
    block=run_stick_slip,
    signature="flat after each reversal, then a jump; constant width at all amplitudes",
    mistaken_for=("hysteresis_shape", "quantisation"),
    tells_apart="the loop of piezoelectric hysteresis shrinks with the amplitude",
    source="about 0 in flexures, tens of nm in loose ones (common knowledge of the field)",
)
