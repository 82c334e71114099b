"""What is drawn: entity paths, colours and names of the curves, shared by scene, views and tests."""

from __future__ import annotations

from typing import Final, NamedTuple

from dehyst.service.viewer.colours import model_colour, rgb
from dehyst.service.viewer.records import SceneConfig

Colour = tuple[int, int, int]

WHITE: Final[Colour] = (235, 235, 235)
AMBER: Final[Colour] = (255, 190, 70)
FRAME: Final[Colour] = (70, 70, 74)
LABEL: Final[Colour] = (190, 190, 190)

#: Names of the models in legends.
NAMES: Final = {
    "linear": "linear",
    "bouc_wen": "Bouc-Wen",
    "mpi": "MPI",
    "lssvm_frozen": "LSSVM, frozen",
    "lssvm_adaptive": "LSSVM, adaptive",
}

#: Paths of each model's curves; the braces take the model.
DISPLACEMENT, VOLTAGE, ERROR = "displacement/{}_um", "voltage/{}_V", "error_um/{}"
MEAN_ERROR, MEAN_ERROR_LOG = "mean_error_pct/{}", "mean_error_log10_pct/{}"
REFERENCE: Final = "displacement/reference_um"
BAND_HIGH, BAND_LOW = "voltage/plus_2_sigma_V", "voltage/minus_2_sigma_V"
SIGMA: Final = "voltage_sigma_mV"
#: Planes, with the names of their axes, and what is drawn in them.
LOOP_PLANE, DEVIATION_PLANE, WINDOW_PLANE = "loops", "deviation", "window"
AXES: Final = {
    LOOP_PLANE: ("voltage, V", "displacement, µm"),
    DEVIATION_PLANE: ("wanted, µm", "error, µm"),
    WINDOW_PLANE: ("displacement, µm", "velocity, µm/s"),
}
LOOP_BEFORE, LOOP_NOW = "loops/before_change", "loops/now"
DEVIATION, WINDOW_POINTS = "deviation/{}", "window/points"
EVENTS, STATUS = "events", "status"
#: Where a figure of the diagnostics is drawn, if not under ``learner/``; groups are objects of figures.
FIGURES: Final = {"gain": "drift/gain", "offset_V": "drift/offset_V"}
GROUPS: Final = {"query_us": "latency/{}_us", "counters": "counter/{}"}


def colour(model: str) -> Colour:
    """The colour of a model, as in every picture."""
    return rgb(model_colour(model))


def name(model: str) -> str:
    """The name of a model in a legend."""
    return NAMES.get(model, model)


class Line(NamedTuple):
    """How one curve is drawn: ``width`` in points of the screen. The titles of the plots give the units."""

    name: str
    colour: Colour
    width: float = 1.5


#: The curves that are not those of a model.
_LINES: Final = {
    REFERENCE: Line("wanted", WHITE, 1.0),
    BAND_HIGH: Line("+2σ", AMBER, 1.0),
    BAND_LOW: Line("−2σ", AMBER, 1.0),
    SIGMA: Line("σ", AMBER),
    "latency/p50_us": Line("median", WHITE),
    "latency/p99_us": Line("99th percentile", AMBER),
    "drift/gain": Line("gain", WHITE),
    "drift/offset_V": Line("offset", AMBER),
    "rate/learnt": Line("learnt", colour("lssvm_adaptive"), 2.0),
}


def lines(config: SceneConfig) -> dict[str, Line]:
    """Every curve that is known before the first record, by path."""
    found = dict(_LINES)
    for model in config.models:
        line = Line(name(model), colour(model), 2.0 if model == config.models[0] else 1.0)
        found |= {path.format(model): line for path in (VOLTAGE, ERROR, MEAN_ERROR, MEAN_ERROR_LOG)}
        found[DISPLACEMENT.format(model)] = Line(f"reached: {line.name}", line.colour, 2.5)
    return found
