"""Puts a recording on a regular time grid, so that a model can step through it: doubles out, short gaps filled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.masks import runs
from dehyst.sim.recordings.recording import OPTIONAL, Recording

#: Longest gap that is filled, samples. A longer one ends the usable stretch, because hysteresis remembers what happened
#: in it.
LONGEST_FILL = 50


def dropout_mask(values: FloatArray) -> BoolArray:
    """(n,) True where a reading is exactly zero between readings far from zero, which no motion explains."""
    mask = np.zeros(len(values), dtype=np.bool_)
    zero = values == 0.0
    if not zero.any() or zero.all():
        return mask
    others = values[~zero & np.isfinite(values)]
    if len(others) < 3:
        return mask
    steps = np.abs(np.diff(values))
    steps = steps[np.isfinite(steps) & (steps > 0.0)]
    jump = max(10.0 * float(np.median(steps)) if len(steps) else 0.0, 0.02 * float(np.ptp(others)))
    for start, stop in runs(zero):
        if start == 0 or stop == len(values):
            continue
        if abs(values[start - 1]) > jump and abs(values[stop]) > jump and values[start - 1] * values[stop] > 0.0:
            mask[start:stop] = True
    return mask


def repeat_mask(recording: Recording) -> BoolArray:
    """(n,) True where voltage and sensor repeat the sample before exactly, although both move before and after."""
    du, dy = np.abs(np.diff(recording.u_V)), np.abs(np.diff(recording.y_um))
    mask = np.zeros(len(recording), dtype=np.bool_)
    if len(du) < 4:
        return mask
    still = (du == 0.0) & (dy == 0.0)
    steps = du[du > 0.0]
    # A coarse command that moves by single converter steps may stand still for a sample; that is no repeat.
    quantum = float(np.min(steps)) if len(steps) else 0.0
    moves = du > 3.0 * quantum
    mask[2:-1] = still[1:-1] & moves[:-2] & moves[2:]
    return mask


@dataclass(frozen=True, slots=True)
class Repaired:
    """A recording whose samples are all finite and ``dt_s`` apart.

    Attributes
    ----------
    recording : its times are computed from the sample count.
    valid : (n,) False where a sample was filled in; such samples are neither scored nor learnt from.
    done : the repairs in words; empty where there were none.
    """

    recording: Recording
    valid: BoolArray
    done: tuple[str, ...]


def repaired(recording: Recording, since: int = 0, longest_fill: int = LONGEST_FILL) -> Repaired:
    """The longest usable stretch of a recording on a regular time grid.

    Samples that repeat a time or a step are dropped. Dropouts, values that are not finite and gaps of up to
    ``longest_fill`` samples are interpolated. A longer gap or a step back in time splits the recording; the part with
    most of the rows from ``since`` on is returned, with the rows before them. Raises InputError where fewer than two
    samples are left, or a column has no finite value.
    """
    done: list[str] = []
    n, dt = len(recording), recording.dt_s
    bad_time = ~np.isfinite(recording.t_s)
    if bad_time.any():
        recording = recording.where(~bad_time)
        since -= int(bad_time[:since].sum())
        done.append(f"{int(bad_time.sum())} samples without a time left out")
    recording = _longest_stretch(recording, dt, since, longest_fill, done)
    if len(recording) < 2:
        raise InputError(f"{recording.source or 'recording'}: got {n} samples, none of them in a usable stretch")
    step = np.rint((recording.t_s - recording.t_s[0]) / dt).astype(np.int64)
    fresh = np.concatenate([[True], np.diff(np.maximum.accumulate(step)) > 0])
    if not fresh.all():
        done.append(f"{int((~fresh).sum())} doubled samples left out")
        recording, step = recording.where(fresh), step[fresh]
    length = int(step[-1]) + 1
    grid = np.arange(length, dtype=np.float64)
    valid = np.zeros(length, dtype=np.bool_)
    valid[step] = True
    if length > len(step):
        done.append(f"{length - len(step)} missing samples filled in by straight lines")
    doubled = repeat_mask(recording)
    columns: dict[str, Any] = {}
    for name in ("u_V", "y_um", *OPTIONAL):
        values = getattr(recording, name)
        if values is None:
            continue
        good = np.isfinite(values)
        if name in ("u_V", "y_um"):
            good &= ~doubled
        if name in ("y_um", "y2_um", "monitor_V"):
            good &= ~dropout_mask(values)
        if not good.any():
            raise InputError(f"{recording.source or 'recording'}: {name}: got no finite value at all")
        if not good.all():
            done.append(f"{name}: {int((~good).sum())} readings filled in by straight lines")
            if name in ("u_V", "y_um"):
                valid[step[~good]] = False
        columns[name] = np.interp(grid, step[good], values[good])
    whole = replace(recording, t_s=recording.t_s[0] + grid * dt, seq=None, reason=None, **columns)
    return Repaired(whole, valid, tuple(done))


def _longest_stretch(recording: Recording, dt_s: float, since: int, longest_fill: int, done: list[str]) -> Recording:
    steps = np.diff(recording.t_s)
    # A clock set back by less than half a step, inside a run of doubles, does not begin a new recording.
    cuts = np.flatnonzero((steps > (longest_fill + 0.5) * dt_s) | (steps < -0.5 * dt_s)) + 1
    if not len(cuts):
        return recording
    bounds = np.concatenate([[0], cuts, [len(recording)]])
    longest = int(np.argmax(np.diff(np.maximum(bounds, since))))
    start, stop = int(bounds[longest]), int(bounds[longest + 1])
    which = "the one with most of the requested rows" if since else "the longest"
    done.append(f"cut into {len(cuts) + 1} parts by long gaps or steps back in time; {which} ({stop - start}) taken")
    return recording.part(start, stop)
