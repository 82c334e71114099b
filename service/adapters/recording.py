"""Records a real stage for its identification: an excitation, and the file that ``dehyst identify`` reads."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.types import FloatArray
from dehyst.service.adapters.adapter import StageAdapter, Ticks, asked, check_range
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import check_finite
from dehyst.service.storage.output import atomic_write
from dehyst.sim.signals.voltages import training_input

#: Time of the ramp from the present voltage to the first of a recording, s.
RAMP_S = 1.0
_PROGRESS_S = 1.0


class StageRecording(NamedTuple):
    """A recording: (n,) times, s, applied voltages, V, and readings, µm.

    ``late`` sample times are missing, because the loop was late; ``worst_late_ms`` is the largest lateness.
    """

    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    late: int
    worst_late_ms: float


def excitation(low_V: float, high_V: float, rate_Hz: float, duration_s: float = 10.0) -> FloatArray:
    """(n,) voltages, V, for an identification: sines of falling amplitude and frequency from ``low_V`` upwards.

    The chapter's training input (2.37), stretched to the range and the duration. It visits many strokes and speeds; its
    fastest part is 3 Hz at 10 s. Raises FieldError where the range is not rising.
    """
    if not (math.isfinite(low_V) and math.isfinite(high_V) and low_V < high_V):
        raise FieldError("low_V, high_V", f"{low_V}, {high_V}", "two finite voltages, the lower one first")
    wave = training_input(10.0 / duration_s / rate_Hz, 10.0)[1]
    share: FloatArray = (wave - wave.min()) / (wave.max() - wave.min())
    return low_V + (high_V - low_V) * share


def record(adapter: StageAdapter, u_V: ArrayLike, progress: Callable[[str], None] = lambda _: None) -> StageRecording:
    """Apply (n,) voltages, V, one each sample time, and read the stage at the instants at which they begin.

    The first voltage is reached by a ramp of `RAMP_S` from the one that is applied now; at the end the last one stays.
    Raises FieldError on a voltage outside the adapter's limits, AdapterError where the stage does not answer.
    """
    wanted = np.atleast_1d(np.asarray(u_V, dtype=np.float64))
    check_finite("u_V", wanted)
    low_V, high_V = check_range(adapter)
    if wanted.min() < low_V or wanted.max() > high_V:
        raise FieldError(
            "u_V", f"{wanted.min():g} to {wanted.max():g} V", f"{low_V:g} to {high_V:g} V, the limits of the adapter"
        )
    steps = max(1, round(RAMP_S * adapter.rate_Hz))
    ramp = np.linspace(asked(adapter.applied_V), wanted[0], steps + 1)[1:]
    for k, *_ in Ticks(adapter.rate_Hz, steps):
        asked(adapter.write_V, float(ramp[k]))
    ticks = Ticks(adapter.rate_Hz, wanted.size)
    kept, readings = np.zeros(wanted.size, dtype=np.bool_), np.zeros(wanted.size)
    told_s = 0.0
    for k, t_s, late in ticks:
        readings[k] = asked(adapter.read_um)
        asked(adapter.write_V, float(wanted[k]))
        kept[k] = not late
        if t_s - told_s >= _PROGRESS_S:
            told_s = t_s
            progress(f"{t_s:.0f} of {wanted.size / adapter.rate_Hz:.0f} s: {readings[k]:.3f} µm at {wanted[k]:.2f} V")
    t = np.arange(wanted.size) / adapter.rate_Hz
    # A voltage that was not applied is not in the recording: the one before was held there.
    return StageRecording(t[kept], wanted[kept], readings[kept], ticks.late, 1e3 * ticks.worst_late_s)


def write_recording(path: Path, recording: StageRecording) -> None:
    """Write a recording as CSV with the columns t_s, u_V and y_um, or nothing at all."""
    rows = zip(recording.t_s.tolist(), recording.u_V.tolist(), recording.y_um.tolist(), strict=True)
    lines = [f"{t_s:.9g},{u_V:.9g},{y_um:.9g}" for t_s, u_V, y_um in rows]
    with atomic_write(path) as file:
        file.write("\n".join(["t_s,u_V,y_um", *lines, ""]).encode())
