"""The trail that a unit leaves: its last samples, and what is due to be drawn of them, at a pace of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from adaptive.types import FloatArray
from service.view.feed import Tracking

#: How often the planes and the averages are drawn again, s of the stage's time.
PLANE_EVERY_S = 0.25
MEAN_EVERY_S = 0.05


@dataclass(slots=True)
class Trail:
    """The last samples of one unit: columns t_s, u_V, y_um, reference_um."""

    rows: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    next_mean_s: float = -math.inf
    next_plane_s: float = -math.inf

    def add(self, record: Tracking) -> None:
        """Go on by the samples of ``record``, later than all before."""
        self.rows = np.concatenate(
            [self.rows, np.column_stack([record.t_s, record.u_V, record.y_um, record.reference_um])]
        )

    def forget(self, before_s: float) -> None:
        """Only what is later than ``before_s`` is kept."""
        self.rows = self.rows[self.rows[:, 0] > before_s]

    def loops_due(self, record: Tracking, loop_s: float) -> Iterator[tuple[float, FloatArray]]:
        """Instants of ``record`` at which planes are due, s, and the rows of the last ``loop_s`` before each."""
        # Planes are drawn as they stood every PLANE_EVERY_S, however long the record is (offline: all of a run).
        first, last = float(record.t_s[0]), float(record.t_s[-1])
        due = max(self.next_plane_s, math.ceil(first / PLANE_EVERY_S - 1e-6) * PLANE_EVERY_S)
        while due <= last:
            start, stop = np.searchsorted(self.rows[:, 0], [due - loop_s, due], side="right")
            if stop > start:
                yield due, self.rows[start:stop]
            due = (math.floor(due / PLANE_EVERY_S + 1e-6) + 1) * PLANE_EVERY_S
            if stop < len(self.rows):  # Nothing is drawn for a time in which there are no samples.
                due = max(due, math.ceil(self.rows[stop, 0] / PLANE_EVERY_S - 1e-6) * PLANE_EVERY_S)
        self.next_plane_s = due

    def mean_errors_due(self, record: Tracking, mae_s: float, range_um: float) -> tuple[FloatArray, FloatArray]:
        """Instants of ``record`` when averages are due, s, and the mean |error| of ``mae_s`` before each, % of range.

        Instants before which nothing is known are left out.
        """
        t_s, size = self.rows[:, 0], np.abs(self.rows[:, 3] - self.rows[:, 2])
        known = np.isfinite(size)
        total = np.concatenate([[0.0], np.cumsum(np.where(known, size, 0.0))])
        count = np.concatenate([[0], np.cumsum(known)])
        start = max(self.next_mean_s, float(record.t_s[0]))
        at_s = np.unique(np.ceil(record.t_s / MEAN_EVERY_S - 1e-6))
        last = math.floor(record.t_s[-1] / MEAN_EVERY_S + 1e-6)
        at_s = at_s[(at_s >= math.ceil(start / MEAN_EVERY_S - 1e-6)) & (at_s <= last)]
        self.next_mean_s = (at_s[-1] + 1) * MEAN_EVERY_S if at_s.size else start
        at_s = at_s * MEAN_EVERY_S
        high = np.searchsorted(t_s, at_s + 1e-9, side="right")
        low = np.searchsorted(t_s, at_s - mae_s + 1e-9, side="right")
        n = count[high] - count[low]
        some = n > 0
        return at_s[some], 100.0 / range_um * (total[high] - total[low])[some] / n[some]
