"""The branches of closed cycles: whether they mirror each other, and how far they are apart."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Cycle, Readings


_GRID = np.linspace(-0.94, 0.94, 48)


def _branches(readings: Readings, cycle: Cycle) -> tuple[FloatArray, FloatArray] | None:
    """The branches of a cycle (µm): rising at the places `_GRID` of the felt voltage, falling at -`_GRID`.

    -1 and 1 are the ends of the cycle. None where the cycle is too short, or was repaired.
    """
    u, y = readings.felt_V, readings.data.y_um
    late = round(readings.lag_s / readings.data.dt_s)
    stop = min(cycle.stop + late, readings.data.n)
    if not readings.mask[cycle.start : stop].all():
        return None
    whole = u[cycle.start + late : stop]
    if whole.size < 20:
        # It is shorter than the lag, or ends with the recording.
        return None
    top = cycle.top + late if late else cycle.top
    top = cycle.start + int(np.argmax(u[cycle.start : stop])) if top >= stop else top
    low, high = float(np.min(whole)), float(np.max(whole))
    if high - low < 0.3 * cycle.amplitude_V(readings.data.u_V):
        return None
    out = []
    for part, way in ((slice(cycle.start + late, top + 1), 1.0), (slice(top, stop), -1.0)):
        x = way * (u[part] - 0.5 * (low + high)) / (0.5 * (high - low))
        # Only samples that go on in the direction of the branch.
        ahead = np.flatnonzero(np.diff(np.maximum.accumulate(x), prepend=-2.0) > 0.0)
        if ahead.size < 10:
            return None
        out.append(np.interp(_GRID, x[ahead], y[part][ahead]))
    return out[0], out[1]


def mirrored_branches(readings: Readings) -> Sight:
    """Sum of both branches mirrored about the middle: constant for any point-symmetric loop, curved for others.

    A linear part is left out, since a drift has one as well. Cycles of one height are one kind, and each kind is asked
    alone: a bow grows with the square of the height, and small cycles need not pass the place where the gain changes.
    """
    data = readings.data
    kinds: dict[int, list[tuple[float, float, float]]] = {}
    parabola = _GRID**2 - np.mean(_GRID**2)
    parabola = parabola / float(parabola @ parabola) * float(np.max(parabola) - np.min(parabola))
    for cycle in readings.cycles:
        height = cycle.amplitude_V(data.u_V)
        branches = _branches(readings, cycle) if height > 0.25 * data.swing_V else None
        if branches is None:
            continue
        total = 0.5 * (branches[0] + branches[1])
        even = 0.5 * (total + total[::-1])
        per_point = max(1.0, (cycle.stop - cycle.start) / (2.0 * _GRID.size))
        error = readings.sigma_um * float(np.linalg.norm(parabola)) / math.sqrt(min(per_point, 4.0))
        kinds.setdefault(round(math.log(height / data.swing_V) / 0.1), []).append(
            (float(parabola @ even), error, height)
        )
    if not kinds:
        return Sight(None, "no closed cycle of a quarter of the range")
    every = [one for kind in kinds.values() for one in kind]
    # The first cycle of a height need not close. Of three, the median does.
    asked = [kind for kind in kinds.values() if len(kind) >= 3] or [every]
    bend, error, height = (float(x) for x in max((np.median(kind, axis=0) for kind in asked), key=lambda m: abs(m[0])))
    curved, sizeable = abs(bend) > 4.0 * error, abs(bend) > 1.5e-4 * data.range_um
    tallest = max(float(np.median([m[2] for m in kind])) for kind in asked)
    # Straight cycles exclude a bow only if they span the range. A bow that is too small to be named is not excluded.
    straight = not curved and tallest > 0.9 * data.swing_V
    seen = True if curved and sizeable else False if straight else None
    words = (
        f"of {len(every)} closed cycles, in those of {height:.3g} V the mean of the mirrored branches bends by "
        f"{bend:.2g} µm (noise {error:.1g})"
    )
    return Sight(seen, words)


def loop_widths(readings: Readings) -> list[tuple[float, float, float, float]]:
    """Height (V), period (s), loop width over loop height, and its standard error, of each closed cycle."""
    out = []
    for cycle in readings.cycles:
        branches = _branches(readings, cycle)
        if branches is None:
            continue
        rising, falling = branches[0], branches[1][::-1]
        middle = np.abs(_GRID) < 0.5
        size = max(float(np.ptp(rising)), 1e-12)
        width = float(np.mean((falling - rising)[middle]))
        error = readings.sigma_um * math.sqrt(2.0 / float(middle.sum()))
        height = cycle.amplitude_V(readings.data.u_V)
        out.append((height, cycle.period_s(readings.data.dt_s), width / size, error / size))
    return out
