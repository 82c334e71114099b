"""Stick-slip: friction in the guidance holds the displacement until the pull exceeds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
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


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["width_um"], values["sliding_share"]


KIND = Kind(
    name="stick_slip",
    place=Place.FRICTION,
    parameters=(
        Parameter("width_um", "µm", 0.0, 5.0, 0.03, "half-width of the flat part after a reversal"),
        Parameter("sliding_share", "1", 0.0, 1.0, 0.5, "sliding friction as a share of static friction; 1: no jump"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0),
    block=run,
    signature="flat after each reversal, then a jump; constant width at all amplitudes",
    mistaken_for=("hysteresis_shape", "quantisation"),
    tells_apart="the loop of piezoelectric hysteresis shrinks with the amplitude",
    source="about 0 in flexures, tens of nm in loose ones (common knowledge of the field)",
)
