"""Which curve stands where: the layout as data, so that it can be read, tested and kept apart from Rerun."""

from __future__ import annotations

from dataclasses import dataclass

from service.view import style
from service.view.feed import SceneConfig
from service.view.plane import BOUNDS


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves over time. ``range`` fixes the value axis; None lets it follow the data."""

    name: str
    paths: tuple[str, ...]
    range: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class PlaneView:
    """A plane with its axes, see `service.view.plane`."""

    name: str
    origin: str
    bounds: tuple[tuple[float, float], tuple[float, float]] = BOUNDS


@dataclass(frozen=True, slots=True)
class TextView:
    """Events, one a line; or with ``document`` the newest text at a path."""

    name: str
    path: str
    document: bool = False


@dataclass(frozen=True, slots=True)
class Box:
    """Views beside each other (``row``), above each other (``column``) or behind each other (``tabs``)."""

    kind: str
    parts: tuple[Part, ...]
    shares: tuple[float, ...] | None = None


Part = Plot | PlaneView | TextView | Box


def layout(config: SceneConfig) -> Box:
    """The engineer's desk: tracking on the left, the shape of the hysteresis in the middle, health on the right."""
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
