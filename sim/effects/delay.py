"""A pure delay between the motion and its reading."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block

LONGEST_S = 0.005


def _slots(context: Context) -> int:
    return math.ceil(LONGEST_S / context.dt_s) + 2


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: slots, whole samples, fraction. s: newest slot (-1: not begun), then a ring of past values, µm."""
    slots, whole = int(p[0]), int(p[1])
    for k in range(n):
        if s[0] < 0.0:  # start at rest
            for j in range(slots):
                s[1 + j] = x[k]
        newest = (int(s[0]) + 1) % slots
        s[0] = newest
        s[1 + newest] = x[k]
        late = s[1 + (newest - whole + slots) % slots]
        later = s[1 + (newest - whole - 1 + 2 * slots) % slots]
        x[k] = late + p[2] * (later - late)


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    samples = values["delay_s"] / context.dt_s
    whole = math.floor(samples)
    return float(_slots(context)), float(whole), samples - whole


KIND = Kind(
    name="delay",
    place=Place.DELAY,
    parameters=(
        Parameter("delay_s", "s", 0.0, LONGEST_S, 5e-4, "delay; between samples the motion is a straight line"),
    ),
    derive=derive,
    rest=lambda values, context: [-1.0] + [0.0] * _slots(context),
    block=run,
    signature="phase in proportion to the frequency at gain 1",
    mistaken_for=("amplifier_lag", "sensor_lag", "hysteresis_shape"),
    tells_apart="a lag also loses gain; the loop of a hysteresis persists as the frequency goes to zero",
    source="0.1 to 2 ms of converters and buses (common knowledge of the field)",
)
