"""Mains hum: lines at the mains frequency and its third harmonic, independent of the input."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: amplitude, of the third harmonic, cycles per sample, phase in cycles."""
    for k in range(n):
        # whole cycles are subtracted before the sine, so that a run of months keeps its phase
        cycles = p[2] * (k0 + k)
        angle = 2.0 * math.pi * (cycles - math.floor(cycles) + p[3])
        x[k] += p[0] * math.sin(angle) + p[1] * math.sin(3.0 * angle)


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    amplitude = values["amplitude_um"]
    return amplitude, amplitude * values["third_share"], values["frequency_Hz"] * context.dt_s, values["phase_cycles"]


KIND = Kind(
    name="mains_hum",
    place=Place.HUM,
    parameters=(
        Parameter("amplitude_um", "µm", 0.0, 1.0, 0.01, "amplitude of the line"),
        Parameter("frequency_Hz", "Hz", 45.0, 65.0, 50.0, "50 or 60 Hz"),
        Parameter("third_share", "1", 0.0, 1.0, 0.2, "amplitude at three times the frequency, relative"),
        Parameter("phase_cycles", "1", -1.0, 1.0, 0.0, "phase at the first sample, in cycles"),
    ),
    derive=derive,
    block=run,
    signature="narrow lines, also at zero input",
    mistaken_for=("resonance",),
    tells_apart="change the sample rate to tell it from an alias",
    source="0.5 to 10 nm (common knowledge of the field)",
)
