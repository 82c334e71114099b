"""Which curve is in which view: the layout as data, independent of Rerun, so that it can be tested."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.viewer import style
from dehyst.service.viewer.records import SceneConfig

# --- A plane with axes
#
# Rerun's 2-D views have no axes, one scale for both directions, and y pointing down. So data are mapped to a box
# of ``WIDTH`` by ``HEIGHT`` with y reversed, and frame, ticks and labels are drawn as lines and points.

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

    def data(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions in the box (n, 2) back to data: the inverse of `points`."""
        x = positions[:, 0] / WIDTH * (self.x_limits[1] - self.x_limits[0]) + self.x_limits[0]
        y = positions[:, 1] / -HEIGHT * (self.y_limits[1] - self.y_limits[0]) + self.y_limits[0]
        return x, y

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


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves over time. ``range`` fixes the value axis; None: it follows the data."""

    name: str
    paths: tuple[str, ...]
    range: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class PlaneView:
    """A plane with its axes."""

    name: str
    origin: str
    bounds: tuple[tuple[float, float], tuple[float, float]] = BOUNDS


@dataclass(frozen=True, slots=True)
class TextView:
    """Events, one per line; with ``document`` the newest text at a path."""

    name: str
    path: str
    document: bool = False


@dataclass(frozen=True, slots=True)
class Box:
    """Views side by side (``row``), one above the other (``column``) or as ``tabs``."""

    kind: str
    parts: tuple[Part, ...]
    shares: tuple[float, ...] | None = None


Part = Plot | PlaneView | TextView | Box


def layout(config: SceneConfig) -> Box:
    """The views: tracking on the left, hysteresis in the middle, health of service and stream on the right."""
    models = config.models
    main = models[0]
    seconds = f"{config.loop_s:g} s"
    tracking = Box(
        "column",
        (
            Plot("Displacement: wanted and reached, µm", (style.REFERENCE, style.displacement(main))),
            Box(
                "tabs",
                (
                    Plot("Tracking error, µm", tuple(style.error(m) for m in reversed(models))),
                    Plot(f"{style.name(main)} alone", (style.error(main),)),
                ),
            ),
            Box(
                "tabs",
                (
                    Plot(
                        f"Mean |error| over {config.mae_s:g} s, log10 of % of range (0 is 1 %, -1 is 0.1 %)",
                        tuple(style.mean_error_log(m) for m in reversed(models)),
                    ),
                    Plot("Linear, % of range", tuple(style.mean_error(m) for m in reversed(models))),
                ),
            ),
            Box(
                "tabs",
                (
                    Plot("Voltage and ±2σ, V", (style.voltage(main), style.BAND_HIGH, style.BAND_LOW)),
                    Plot("σ of the voltage, mV", (style.SIGMA,)),
                    Plot("Voltages of all models, V", tuple(style.voltage(m) for m in reversed(models))),
                ),
            ),
        ),
        (1.0, 1.2, 1.2, 0.9),
    )
    shapes = Box(
        "column",
        (
            PlaneView(f"What is left: error over wanted, last {seconds}", style.DEVIATION_PLANE),
            PlaneView(f"Loop (u, y), last {seconds}; amber: before the last change of the stage", style.LOOP_PLANE),
            PlaneView("What the learner holds: its window", style.WINDOW_PLANE),
        ),
    )
    health = Box(
        "column",
        (
            TextView("Events", style.EVENTS),
            Box(
                "tabs",
                (
                    Plot("Gates: samples per second", ("rate/**",)),
                    Plot("Gates: counts", ("counter/**",)),
                    Plot("This stream: counts", ("stream/**",)),
                ),
            ),
            Box(
                "tabs",
                (
                    Plot("Drift filter: gain", ("drift/gain",)),
                    Plot("Drift filter: offset, V", ("drift/offset_V",)),
                    Plot("Learner", ("learner/**",)),
                ),
            ),
            Plot("Query latency, µs", ("latency/**",)),
            TextView("Status", style.STATUS, document=True),
        ),
        (1.0, 1.0, 0.8, 0.8, 1.0),
    )
    return Box("row", (tracking, shapes, health), (1.5, 1.0, 0.95))
