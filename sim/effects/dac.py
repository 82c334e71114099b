"""D/A converter: voltages on a grid, held over the sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dehyst.sim.effects.base import Context, Kind, Parameter, Place, block


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
)
