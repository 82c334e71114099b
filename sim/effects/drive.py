"""The drive: D/A converter, amplifier, its rails and its slew limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import first_order

# --- dac ---
# D/A converter: voltages on a grid, held over the sample.


@block
def run_dac(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: step, V (0: none), lowest, highest code."""
    if p[0] > 0.0:
        for k in range(n):
            code = round(x[k] / p[0])
            x[k] = min(max(code, p[1]), p[2]) * p[0]


def derive_dac(values: Mapping[str, float], context: Context) -> Sequence[float]:
    step = values["span_V"] / 2.0 ** values["bits"] if values["bits"] > 0.0 else 0.0
    half = 2.0 ** (values["bits"] - 1.0)
    return step, -half, half - 1.0


DAC = Kind(
    name="dac",
    place=Place.DAC,
    parameters=(
        Parameter("bits", "bit", 0.0, 24.0, 16.0, "resolution; 0 switches the grid off"),
        Parameter("span_V", "V", 1.0, 1000.0, 20.0, "from the lowest to the highest voltage, symmetric about 0"),
    ),
    derive=derive_dac,
    block=run_dac,
    signature="voltage levels on a grid of a few tenths of a millivolt",
    source="the chapter's DS1103 controller: 16 bit over -10 to 10 V (section 2.2.1)",
    cause=False,
)


# --- amplifier_lag ---
# First-order lag of the amplifier that drives the actuator's capacitance.


@block
def run_amplifier_lag(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: pole, weight of the held command. s: output, V."""
    for k in range(n):
        s[0] = p[0] * s[0] + p[1] * x[k]
        x[k] = s[0]


def derive_amplifier_lag(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # the input is the held level of the converter; later effects take the output's shape from Context.hold_per_s
    a, _, b = first_order(values["tau_s"], context.dt_s, float("inf"))
    return a, b


AMPLIFIER_LAG = Kind(
    name="amplifier_lag",
    place=Place.AMPLIFIER,
    parameters=(Parameter("tau_s", "s", 0.0, 5e-3, 6.4e-5, "time constant; corner frequency 1/(2 pi tau)"),),
    derive=derive_amplifier_lag,
    rest=lambda values, context: (0.0,),
    block=run_amplifier_lag,
    signature="small-signal roll-off of first order, the same at every amplitude",
    mistaken_for=("sensor_lag", "delay"),
    tells_apart="a monitor of the voltage; a delay loses no gain",
    source="RC of amplifier and actuator, corners of 1 to 6 kHz (common knowledge of the field); default 2.5 kHz",
)


# --- slew_limit ---
# Slew limit: the actuator is a capacitor, so the amplifier's current limit I limits the voltage rate to I/C.


@block
def run_slew_limit(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: largest change per sample, V. s: output, V."""
    for k in range(n):
        s[0] += min(max(x[k] - s[0], -p[0]), p[0])
        x[k] = s[0]


SLEW_LIMIT = Kind(
    name="slew_limit",
    place=Place.SLEW,
    parameters=(Parameter("rate_V_per_s", "V/s", 10.0, 1e6, 2000.0, "largest rate, at the command's scale"),),
    derive=lambda values, context: (values["rate_V_per_s"] * context.dt_s,),
    rest=lambda values, context: (0.0,),
    block=run_slew_limit,
    signature="triangle-like output, only above a rate; straight ramps after steps",
    mistaken_for=("saturation", "amplifier_lag"),
    tells_apart="saturation depends on the level, a lag does not depend on the amplitude",
    source="about 20 V/ms at the actuator, that is 2 V/ms at the command of a tenfold amplifier (field knowledge)",
)


# --- saturation ---
# Saturation: the amplifier limits the voltage to its rails.


@block
def run_saturation(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: lowest, highest voltage, V."""
    for k in range(n):
        x[k] = min(max(x[k], p[0]), p[1])


SATURATION = Kind(
    name="saturation",
    place=Place.RAILS,
    parameters=(
        Parameter("low_V", "V", -1000.0, 0.0, -3.0, "lower rail, at the command's scale"),
        Parameter("high_V", "V", 0.1, 1000.0, 12.0, "upper rail, at the command's scale"),
    ),
    derive=lambda values, context: (values["low_V"], values["high_V"]),
    block=run_saturation,
    signature="flat tops at the same voltage at every rate",
    mistaken_for=("slew_limit",),
    tells_apart="a sensor that ends is told apart by a monitor of the voltage",
    source="-30 to 130 V at the actuator behind a tenfold amplifier (E-503 class data sheet range)",
)
