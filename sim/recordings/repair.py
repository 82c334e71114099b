"""A recording on a whole time grid: doubles out, short holes filled and marked, so that a model may step through."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.types import BoolArray, FloatArray
from sim.recordings.recording import OPTIONAL, Recording

# --- Readings that are none, by place: dropouts to zero, and samples that a recorder has doubled.


def runs(mask: BoolArray) -> NDArray[np.int64]:
    """(k, 2) start and stop (excluded) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def dropout_mask(values: FloatArray) -> BoolArray:
    """(n,) True where a reading is exactly zero between readings far from it: no motion goes there and back."""
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
    """(n,) True where voltage and sensor both repeat the sample before exactly, though both move before and after."""
    du, dy = np.abs(np.diff(recording.u_V)), np.abs(np.diff(recording.y_um))
    mask = np.zeros(len(recording), dtype=np.bool_)
    if len(du) < 4:
        return mask
    still = (du == 0.0) & (dy == 0.0)
    steps = du[du > 0.0]
    # Where a coarse command moves by single steps of its converter, standing still once is no double.
    quantum = float(np.min(steps)) if len(steps) else 0.0
    moves = du > 3.0 * quantum
    mask[2:-1] = still[1:-1] & moves[:-2] & moves[2:]
    return mask


#: A hole longer than this ends the usable stretch: hysteresis has memory, and what went on in it is unknown.
LONGEST_FILL = 50


@dataclass(frozen=True, slots=True)
class Repaired:
    """A recording whose samples are ``dt_s`` apart, all finite.

    Attributes
    ----------
    recording : time from the step count.
    valid : (n,) False where a sample was filled in: to be stepped through, not to be scored or learnt from.
    done : what was repaired, in words; empty where nothing was.
    """

    recording: Recording
    valid: BoolArray
    done: tuple[str, ...]


def repaired(recording: Recording, since: int = 0) -> Repaired:
    """The longest usable stretch of a recording on its own time grid, or that with most of its rows from ``since`` on.

    Samples that repeat a time or a step are dropped, exact zeros between far readings and not-finite values are
    interpolated, gaps of up to ``LONGEST_FILL`` samples too; a longer gap or a step back in time splits the
    recording, and the part is taken that holds most of the rows from ``since`` on, with what comes before them.
    Raises InputError where fewer than two samples are left.
    """
    done: list[str] = []
    n, dt = len(recording), recording.dt_s
    bad_time = ~np.isfinite(recording.t_s)
    if bad_time.any():
        recording = _pick(recording, ~bad_time)
        since -= int(bad_time[:since].sum())
        done.append(f"{int(bad_time.sum())} samples without a time left out")
    recording = _longest_stretch(recording, dt, since, done)
    if len(recording) < 2:
        raise InputError(f"{recording.source or 'recording'}: got {n} samples, none of them in a usable stretch")
    step = np.rint((recording.t_s - recording.t_s[0]) / dt).astype(np.int64)
    fresh = np.concatenate([[True], np.diff(np.maximum.accumulate(step)) > 0])
    if not fresh.all():
        done.append(f"{int((~fresh).sum())} doubled samples left out")
        recording, step = _pick(recording, fresh), step[fresh]
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


def _pick(recording: Recording, keep: BoolArray) -> Recording:
    names = ("t_s", "u_V", "y_um", *OPTIONAL, "seq", "reason")
    chosen: dict[str, Any] = {name: values[keep] for name in names if (values := getattr(recording, name)) is not None}
    return replace(recording, **chosen)


def _longest_stretch(recording: Recording, dt_s: float, since: int, done: list[str]) -> Recording:
    steps = np.diff(recording.t_s)
    # A clock that is set back a little inside a run of doubles is no new recording; half a step is the limit.
    cuts = np.flatnonzero((steps > (LONGEST_FILL + 0.5) * dt_s) | (steps < -0.5 * dt_s)) + 1
    if not len(cuts):
        return recording
    bounds = np.concatenate([[0], cuts, [len(recording)]])
    longest = int(np.argmax(np.diff(np.maximum(bounds, since))))
    start, stop = int(bounds[longest]), int(bounds[longest + 1])
    which = "the one with most of what is asked for" if since else "the longest"
    done.append(f"cut into {len(cuts) + 1} parts by long gaps or steps back in time; {which} ({stop - start}) taken")
    return recording.part(start, stop)
