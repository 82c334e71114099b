"""A recording of one axis in the project's own columns and units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray

#: Columns that every recording has, and columns that it may have.
REQUIRED = ("t_s", "u_V", "y_um")
OPTIONAL = ("u2_V", "y2_um", "u3_V", "monitor_V", "temperature_C")
_COLUMNS = (*REQUIRED, *OPTIONAL, "seq", "reason")


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording as it was read; nothing is repaired, sorted or filled.

    Attributes
    ----------
    t_s : (n,) time, s. u_V : (n,) voltage command, V, applied from ``t_s`` on. y_um : (n,) sensor, µm.
    dt_s : nominal sample time, s.
    source : its origin, for people. sha256 : digest of the bytes read.
    u2_V, y2_um : (n,) the other axis. u3_V : (n,) voltage of a third axis or actuator.
    monitor_V : (n,) measured voltage at the actuator. temperature_C : (n,).
    seq : (n,) sequence numbers, where recorded. reason : (n,) outcome of each sample in the learner, where recorded.
    notes : what was done to the data when it was read. y_unit : ``µrad`` where ``y_um`` is an angle.

    Raises InputError where the columns differ in length or the sample time is not positive.
    """

    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    dt_s: float
    source: str = ""
    sha256: str = ""
    u2_V: FloatArray | None = None
    y2_um: FloatArray | None = None
    u3_V: FloatArray | None = None
    monitor_V: FloatArray | None = None
    temperature_C: FloatArray | None = None
    seq: NDArray[np.int64] | None = None
    reason: NDArray[np.str_] | None = None
    notes: tuple[str, ...] = ()
    y_unit: str = "µm"

    def __post_init__(self) -> None:
        n = len(self.t_s)
        for name in _COLUMNS:
            values = getattr(self, name)
            if values is not None and values.shape != (n,):
                raise InputError(
                    f"{name}: got shape {values.shape}, expected ({n},) as t_s: every column has one value per sample"
                )
        if not (np.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise InputError(f"dt_s: got {self.dt_s!r}, expected a positive sample time in s")

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def duration_s(self) -> float:
        """From the first sample to one sample time after the last, by the clock of the recording, s."""
        return float(self.t_s[-1] - self.t_s[0]) + self.dt_s if len(self) else 0.0

    def columns(self) -> dict[str, FloatArray]:
        """The numeric columns of this recording, by canonical name."""
        found = {name: getattr(self, name) for name in (*REQUIRED, *OPTIONAL)}
        return {name: values for name, values in found.items() if values is not None}

    def where(self, chosen: slice | BoolArray) -> Recording:
        """The samples ``chosen``, a slice or a mask (n,), with all columns."""
        cut = {name: values[chosen] for name in _COLUMNS if (values := getattr(self, name)) is not None}
        return replace(self, **cut)

    def part(self, start: int, stop: int) -> Recording:
        """The samples from ``start`` to ``stop`` (exclusive) with all columns."""
        return self.where(slice(start, stop))

    def between(self, start_s: float | None, stop_s: float | None) -> Recording:
        """Samples with ``start_s <= t_s < stop_s``; ``None`` leaves that end open. Raises InputError where empty."""
        low = -np.inf if start_s is None else start_s
        high = np.inf if stop_s is None else stop_s
        inside = np.flatnonzero((self.t_s >= low) & (self.t_s < high))
        if not len(inside):
            span = f"{np.nanmin(self.t_s):g} to {np.nanmax(self.t_s):g} s" if len(self) else "nothing"
            raise InputError(f"range: got {low:g}:{high:g} s, expected a part of the recording, which holds {span}")
        return self.part(int(inside[0]), int(inside[-1]) + 1)
