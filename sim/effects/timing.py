"""Faults of the time base: readings that repeat the one before, and a sensor clock that runs slow."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.counter_noise import uniform

#: Largest lateness of a slow clock, s; it stays there.
LATEST_S = 0.05


def _slots(context: Context) -> int:
    return math.ceil(LATEST_S / context.dt_s) + 2


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: probability of a repeat, lateness per sample, slots, seed. s: last reading, slot (-1: not begun), ring."""
    slots = int(p[2])
    for k in range(n):
        index = k0 + k
        if s[1] < 0.0:
            s[0] = x[k]
            for j in range(slots):
                s[2 + j] = x[k]
        newest = (int(s[1]) + 1) % slots
        s[1] = newest
        s[2 + newest] = x[k]
        late = min(p[1] * index, slots - 2.0)
        whole = int(late)
        first = s[2 + (newest - whole + slots) % slots]
        second = s[2 + (newest - whole - 1 + 2 * slots) % slots]
        reading = first + (late - whole) * (second - first)
        if p[0] > 0.0 and uniform(p[3], index) < p[0]:
            reading = s[0]
        s[0] = reading
        x[k] = reading


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["repeat_probability"], values["slow_ppm"] * 1e-6, float(_slots(context)), float(context.seed)


KIND = Kind(
    name="timing",
    place=Place.TIMING,
    parameters=(
        Parameter("repeat_probability", "1", 0.0, 0.5, 0.001, "share of readings that repeat the one before"),
        Parameter("slow_ppm", "ppm", 0.0, 1000.0, 0.0, "how slow the sensor's clock is"),
    ),
    derive=derive,
    rest=lambda values, context: [0.0, -1.0] + [0.0] * _slots(context),
    block=run,
    signature="gaps, zero differences; a phase that grows with time",
    mistaken_for=("delay",),
    tells_apart="a delay is constant",
    source="10 to 100 ppm between two crystals (common knowledge of the field)",
)
