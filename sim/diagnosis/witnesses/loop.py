"""Asymmetry, sensor curve, rate dependence and loop widths, seen in closed cycles."""

from __future__ import annotations

import math

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.witnesses.readings import Cycle, Readings, Sight

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


def even_part(readings: Readings) -> list[Sight]:
    """Sum of both branches mirrored about the middle: constant for any point-symmetric loop, curved for others.

    A linear part is left out, since a drift has one as well.
    """
    data = readings.data
    names = ("asymmetry", "sensor_nonlinearity")
    bends: list[float] = []
    errors: list[float] = []
    parabola = _GRID**2 - np.mean(_GRID**2)
    parabola = parabola / float(parabola @ parabola) * float(np.max(parabola) - np.min(parabola))
    for cycle in readings.cycles:
        height = cycle.amplitude_V(data.u_V)
        branches = _branches(readings, cycle) if height > 0.25 * data.swing_V else None
        if branches is None:
            continue
        total = 0.5 * (branches[0] + branches[1])
        even = 0.5 * (total + total[::-1])
        bends.append(float(parabola @ even))
        per_point = max(1.0, (cycle.stop - cycle.start) / (2.0 * _GRID.size))
        errors.append(readings.sigma_um * float(np.linalg.norm(parabola)) / math.sqrt(min(per_point, 4.0)))
    if not bends:
        words = "no closed cycle of a quarter of the range"
        return [Sight(name, None, words) for name in names]
    bend = np.array(bends)
    error = np.array(errors)
    span = data.range_um
    z = np.abs(bend) / np.maximum(error, 1e-300)
    most = int(np.argmax(np.abs(bend)))
    seen = bool(np.median(z) > 4.0 and np.median(np.abs(bend)) > 1.5e-4 * span)
    words = (
        f"in {bend.size} closed cycles the mean of the mirrored branches bends by {float(np.median(bend)):.2g} µm "
        f"(at most {bend[most]:.2g}; noise {float(np.median(error)):.1g})"
    )
    return [Sight(name, seen, words) for name in names]


def _widths(readings: Readings) -> list[tuple[float, float, float, float]]:
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


def rate_dependence(readings: Readings) -> list[Sight]:
    """Loop width over the rate: a part that goes with the logarithm, beside one of the height and a lag's part.

    The relative width that a lag leaves goes with the frequency, that of a loop with the height; the rest is due to
    the rate. Cycles of one height and rate are one observation.
    """
    kinds: dict[tuple[int, int], list[tuple[float, float, float, float]]] = {}
    for one in _widths(readings):
        kinds.setdefault((round(math.log(one[0]) / 0.1), round(math.log(one[1]) / 0.1)), []).append(one)
    rows = np.array([np.median(np.array(same), axis=0) for same in kinds.values()]).reshape(-1, 4)
    height, period, width = rows[:, 0], rows[:, 1], rows[:, 2]
    rate = 2.0 * height / np.maximum(period, 1e-12)
    if width.size < 7 or float(np.max(rate)) < 9.0 * float(np.min(rate)):
        words = f"{width.size} kinds of closed cycles; seven, over a decade of rates, are needed"
        return [Sight("rate_dependence", None, words)]
    h = np.log(height / float(np.median(height)))
    lines = [np.ones_like(h), h, h * h, float(np.min(period)) / period, np.log10(rate / float(np.median(rate)))]
    columns = np.array(lines)
    solved, *_ = np.linalg.lstsq(columns.T, width, rcond=None)
    left = width - solved @ columns
    cover = np.linalg.pinv(columns @ columns.T) * float(left @ left) / max(1, width.size - columns.shape[0])
    mean = abs(float(solved[0])) + 1e-12
    growth, sigma = float(solved[-1]) / mean, float(np.sqrt(cover[-1, -1])) / mean
    words = (
        f"the loop widens by {100 * growth:.2g} ± {196 * sigma:.1g} % per decade of rate ({width.size} kinds of cycles "
        f"over {float(np.log10(np.max(rate) / np.min(rate))):.2g} decades, the parts of height and lag taken off)"
    )
    if growth > 6.0 * sigma and growth > 0.01:
        return [Sight("rate_dependence", True, words)]
    return [Sight("rate_dependence", False if sigma < 0.003 and growth < 0.003 else None, words)]


def widths(readings: Readings) -> list[Sight]:
    """Whether loops of several heights open at all: the shape of a loop can only be wrong where there is one."""
    found = _widths(readings)
    kinds: dict[int, list[tuple[float, float, float, float]]] = {}
    for one in found:
        kinds.setdefault(round(math.log(one[0]) / 0.3), []).append(one)
    if not kinds:
        return [Sight("hysteresis_shape", None, "no closed cycle")]
    table = [
        (float(np.median([k[0] for k in same])), float(np.median([k[2] for k in same])), max(k[3] for k in same))
        for _, same in sorted(kinds.items())
    ]
    words = ", ".join(f"{100 * w:.3g} % at {h:.3g} V" for h, w, _ in table[-4:])
    open_ = any(abs(w) > 5.0 * e for _, w, e in table)
    if len(table) < 2:
        return [Sight("hysteresis_shape", None, f"loops of one height only: {words} wide")]
    return [Sight("hysteresis_shape", open_, f"loops are {words} wide")]
