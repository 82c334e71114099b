"""A plane with axes, as lines, points and texts.

Rerun's 2-D views have no axes, one scale for both directions, and y pointing down. So data are mapped to a box of
``WIDTH`` by ``HEIGHT`` with y reversed, and frame, ticks and labels are drawn as lines and points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import FloatArray

WIDTH, HEIGHT = 180.0, 100.0
#: Range of a view, x and y: the box with room for the labels.
BOUNDS = ((-20.0, WIDTH + 8.0), (-HEIGHT - 8.0, 22.0))


def ticks(low: float, high: float, at_most: int = 6) -> FloatArray:
    """Round numbers between low and high, ascending, at most ``at_most`` of them."""
    span = high - low
    step = 10.0 ** np.floor(np.log10(span / at_most))
    for factor in (1.0, 2.0, 5.0, 10.0, 20.0):
        first, last = np.ceil(low / (step * factor) - 1e-9), np.floor(high / (step * factor) + 1e-9)
        if last - first < at_most:
            return np.asarray(np.arange(first, last + 1) * step * factor, dtype=np.float64)
    raise AssertionError("a step of 20 spans always fits")  # pragma: no cover


@dataclass(frozen=True, slots=True)
class Plane:
    """One pair of axes with fixed limits, each ``(low, high)`` with low < high."""

    x_name: str
    y_name: str
    x_limits: tuple[float, float]
    y_limits: tuple[float, float]

    def points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Data (n,), (n,) to positions in the box (n, 2); points that are not finite are left out."""
        x = (np.asarray(x, dtype=np.float64) - self.x_limits[0]) / (self.x_limits[1] - self.x_limits[0]) * WIDTH
        y = (np.asarray(y, dtype=np.float64) - self.y_limits[0]) / (self.y_limits[1] - self.y_limits[0]) * -HEIGHT
        both = np.column_stack([x, y])
        return np.asarray(both[np.isfinite(both).all(axis=1)])

    def frame(self) -> list[FloatArray]:
        """The box and a grid line at every tick, as line strips (k, 2)."""
        lines = [np.array([[0, 0], [WIDTH, 0], [WIDTH, -HEIGHT], [0, -HEIGHT], [0, 0]], dtype=np.float64)]
        for x, _ in self._at(self.x_limits, WIDTH):
            lines.append(np.array([[x, 0.0], [x, -HEIGHT]]))
        for y, _ in self._at(self.y_limits, HEIGHT):
            lines.append(np.array([[0.0, -y], [WIDTH, -y]]))
        return lines

    def labels(self) -> tuple[FloatArray, list[str]]:
        """Positions (m, 2) and texts of tick labels and axis names."""
        where: list[tuple[float, float]] = []
        what: list[str] = []
        for x, text in self._at(self.x_limits, WIDTH):
            where.append((x, 3.0))
            what.append(text)
        for y, text in self._at(self.y_limits, HEIGHT):
            where.append((-9.0, -y - 4.0))
            what.append(text)
        where += [(WIDTH / 2, 12.0), (22.0, -HEIGHT - 1.0)]
        what += [self.x_name, self.y_name]
        return np.array(where), what

    @staticmethod
    def _at(limits: tuple[float, float], length: float) -> list[tuple[float, str]]:
        values = ticks(*limits)
        return [((float(v) - limits[0]) / (limits[1] - limits[0]) * length, f"{float(v) + 0.0:.6g}") for v in values]


def grown(limits: tuple[float, float] | None, values: FloatArray) -> tuple[float, float] | None:
    """Limits that contain all finite values: unchanged if they do already, else extended to round numbers."""
    # Values that no sensor can produce must not set the axes.
    values = values[np.isfinite(values) & (np.abs(values) < 1e12)]
    if not values.size:
        return limits
    low, high = float(values.min()), float(values.max())
    if limits is not None:
        if limits[0] <= low and high <= limits[1]:
            return limits
        low, high = min(low, limits[0]), max(high, limits[1])
    room = max(0.02 * (high - low), 1e-6 * max(abs(low), abs(high)), 1e-9)
    low, high = low - room, high + room
    step = 10.0 ** np.floor(np.log10(high - low)) / 5.0
    return float(np.floor(low / step) * step), float(np.ceil(high / step) * step)
