"""Slew limit and saturation, seen in the readings."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import stats

from adaptive.types import FloatArray
from sim.diagnosis.witnesses.readings import Readings, Sight


def slew_limit(readings: Readings) -> list[Sight]:
    """The greatest speed of the readings over the size of a step, or over the speed that a motion asks for.

    Without a limit the two are proportional (exponent 1); behind a limit the speed stays at one value (exponent 0).
    """
    data = readings.data
    sizes, speeds = _steps(readings)
    words = []
    for x, v, what in ((sizes, speeds, "steps"), (*_motions(readings), "motions")):
        if x.size < 3 or float(np.max(x)) < 1.6 * float(np.min(x)):
            continue
        # The largest ones decide: small steps may stay below the limit.
        upper = x > 0.4 * float(np.max(x))
        if int(upper.sum()) < 3 or float(np.ptp(np.log(x[upper]))) < 0.3:
            upper = np.ones(x.size, dtype=np.bool_)
        lx, lv = np.log(x[upper]), np.log(v[upper])
        # The median of the slopes between pairs: a lost sample beside one step must not decide.
        slope = float(stats.theilslopes(lv, lx).slope)
        top = float(np.max(v)) / max(abs(data.gain_um_per_V), 1e-12)
        words.append(f"the greatest speed of {x.size} {what} ({top:.3g} V/s) goes with their size to the {slope:.2g}")
        if slope < 0.7:
            return [Sight("slew_limit", True, words[-1])]
    if not words:
        return [Sight("slew_limit", None, "no steps or fast motions of several sizes")]
    return [Sight("slew_limit", False, "; ".join(words))]


def _steps(readings: Readings) -> tuple[FloatArray, FloatArray]:
    """Sizes (V) of single steps between rests and the greatest speed (µm/s) after each."""
    data = readings.data
    moved = np.abs(np.diff(data.u_V, prepend=data.u_V[0]))
    near = max(2, round(0.005 / data.dt_s))
    after = max(8, round(0.02 / data.dt_s))
    width = max(1, round(1e-3 / data.dt_s))
    sizes, speeds = [], []
    for k in np.flatnonzero(moved > 0.05 * data.swing_V):
        if k < near or k + after >= data.n or not readings.mask[k - near : k + after].all():
            continue
        if float(moved[k - near : k].sum() + moved[k + 1 : k + after].sum()) > 1e-3 * data.swing_V:
            continue
        y = data.y_um[k - 1 : k + after]
        speed = np.abs(y[width:] - y[:-width]) / (width * data.dt_s)
        sizes.append(float(moved[k]))
        speeds.append(float(np.max(speed)))
    return np.array(sizes), np.array(speeds)


def _motions(readings: Readings) -> tuple[FloatArray, FloatArray]:
    """Speeds that the felt voltage asks for (V/s), in classes, and the typical greatest speeds (µm/s) reached there."""
    data = readings.data
    jumps = np.abs(np.diff(data.u_V, prepend=data.u_V[0])) > 0.02 * data.swing_V
    width = max(2, round(2e-3 / data.dt_s))
    # Around a jump the speed is that of the lag, whatever its size.
    away = np.convolve(jumps.astype(np.float64), np.ones(2 * round(0.05 / data.dt_s) + 1), "same") < 0.5
    asked = np.abs(readings.felt_V[width:] - readings.felt_V[:-width]) / (width * data.dt_s)
    got = np.abs(data.y_um[width:] - data.y_um[:-width]) / (width * data.dt_s)
    use = away[width:] & readings.mask[width:]
    asked, got = asked[use], got[use]
    if asked.size < 100:
        return np.empty(0), np.empty(0)
    top = float(np.quantile(asked, 0.999))
    slow = asked < 0.3 * top
    if int(slow.sum()) < 100 or float(np.corrcoef(asked[slow], got[slow])[0, 1]) < 0.97:
        # Where slow motions do not follow either, a mode moves the stage.
        return np.empty(0), np.empty(0)
    if top < 10.0 * data.swing_V:
        # Slower than a tenth of a second for the whole swing: no amplifier limits that.
        return np.empty(0), np.empty(0)
    edges = np.geomspace(0.15 * top, top, 7)
    x, v = [], []
    for a, b in itertools.pairwise(edges):
        inside = (asked >= a) & (asked < b)
        if int(inside.sum()) >= 20:
            x.append(float(np.sqrt(a * b)))
            v.append(float(np.median(got[inside])))
    return np.array(x), np.array(v)


def saturation(readings: Readings) -> list[Sight]:
    """Flat tops: the slope of the readings over a voltage that moves, near the ends of its range."""
    data = readings.data
    u, y = readings.felt_V, data.y_um
    du, dy = np.diff(u), np.diff(y)
    slow = (np.abs(du) < 0.02 * data.swing_V) & (np.abs(du) > 1e-7 * data.swing_V) & readings.mask[1:]
    count = 40
    where = np.clip(((u[1:] - data.u_low_V) / max(data.swing_V, 1e-12) * count).astype(int), 0, count - 1)
    power = np.bincount(where[slow], du[slow] ** 2, count)
    travel = np.bincount(where[slow], np.abs(du[slow]), count)
    slope = np.bincount(where[slow], (du * dy)[slow], count) / np.maximum(power, 1e-300)
    visited = travel > 1.0 * data.swing_V / count
    if int(visited.sum()) < 10:
        return [Sight("saturation", None, "the voltage moves too little")]
    usual = float(np.median(slope[visited]))
    ends = []
    shown = 0
    for order, end in ((np.arange(count)[::-1], "top"), (np.arange(count), "bottom")):
        edge = [int(i) for i in order if visited[i]]
        outermost = data.u_high_V if end == "top" else data.u_low_V
        at = data.u_low_V + (edge[0] + 0.5) / count * data.swing_V
        if abs(at - outermost) > 0.1 * data.swing_V:
            continue
        shown += 1
        flat = 0
        while flat < len(edge) and slope[edge[flat]] < 0.3 * usual:
            flat += 1
        # Where the voltage reaches the limit at any speed, the slope falls over several bins.
        if flat and np.max(slope[edge[flat + 1 : flat + 7]], initial=0.0) > 0.5 * usual:
            limit = data.u_low_V + (edge[flat] + (1.0 if end == "top" else 0.0)) / count * data.swing_V
            ends.append(
                f"at the {end}, beyond {limit:.3g} V, the readings move {slope[edge[0]] / usual:.2g} times as usual"
            )
    if ends:
        return [Sight("saturation", True, "; ".join(ends))]
    if not shown:
        return [Sight("saturation", None, "the voltage does not move near the ends of its range")]
    return [Sight("saturation", False, "up to the ends of the range the readings follow the voltage")]
