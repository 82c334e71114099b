"""Entity paths, colours and names of the curves, shared by scene, blueprint and tests."""

from __future__ import annotations

from dataclasses import dataclass

from dehyst.service.viewer.colours import model_colour, rgb
from dehyst.service.viewer.records import SceneConfig

Colour = tuple[int, int, int]

WHITE: Colour = (235, 235, 235)
AMBER: Colour = (255, 190, 70)
FRAME: Colour = (70, 70, 74)
LABEL: Colour = (190, 190, 190)

#: Names of the models in legends.
NAMES: dict[str, str] = {
    "linear": "linear",
    "bouc_wen": "Bouc-Wen",
    "mpi": "MPI",
    "lssvm_frozen": "LSSVM, frozen",
    "lssvm_adaptive": "LSSVM, adaptive",
}

REFERENCE = "displacement/reference_um"
BAND_HIGH, BAND_LOW = "voltage/plus_2_sigma_V", "voltage/minus_2_sigma_V"
SIGMA = "voltage_sigma_mV"
LOOP_PLANE, DEVIATION_PLANE, WINDOW_PLANE = "loops", "deviation", "window"
LOOP_BEFORE, LOOP_NOW = "loops/before_change", "loops/now"
WINDOW_POINTS = "window/points"
EVENTS, STATUS = "events", "status"


def displacement(model: str) -> str:
    return f"displacement/{model}_um"


def error(model: str) -> str:
    return f"error_um/{model}"


def mean_error(model: str) -> str:
    return f"mean_error_pct/{model}"


def mean_error_log(model: str) -> str:
    return f"mean_error_log10_pct/{model}"


def voltage(model: str) -> str:
    return f"voltage/{model}_V"


def deviation(model: str) -> str:
    return f"{DEVIATION_PLANE}/{model}"


def colour(model: str) -> Colour:
    """The colour of a model, as in every picture."""
    return rgb(model_colour(model))


def name(model: str) -> str:
    return NAMES.get(model, model)


@dataclass(frozen=True, slots=True)
class Line:
    """How one curve is drawn: ``width`` in points of the screen. The titles of the plots give the units."""

    name: str
    colour: Colour
    width: float = 1.0


def lines(config: SceneConfig) -> dict[str, Line]:
    """Every curve that is known before the first record, by path."""
    main = config.models[0]
    found = {REFERENCE: Line("wanted", WHITE, 1.0)}
    for model in config.models:
        hue, called, width = colour(model), name(model), 2.0 if model == main else 1.0
        found[displacement(model)] = Line(f"reached: {called}", hue, 2.5)
        found[voltage(model)] = Line(called, hue, width)
        for path in (error(model), mean_error(model), mean_error_log(model)):
            found[path] = Line(called, hue, width)
    found[BAND_HIGH] = Line("+2σ", AMBER, 1.0)
    found[BAND_LOW] = Line("−2σ", AMBER, 1.0)
    found[SIGMA] = Line("σ", AMBER, 1.5)
    found["latency/p50_us"] = Line("median", WHITE, 1.5)
    found["latency/p99_us"] = Line("99th percentile", AMBER, 1.5)
    found["drift/gain"] = Line("gain", WHITE, 1.5)
    found["drift/offset_V"] = Line("offset", AMBER, 1.5)
    found["rate/learnt"] = Line("learnt", colour("lssvm_adaptive"), 2.0)
    return found
