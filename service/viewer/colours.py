"""The colours of models and signals: one table for every picture and for the viewer.

All are colour-blind safe (Okabe and Ito; Tol) and readable on a white and on a dark background. No drawing library is
imported here.
"""

from __future__ import annotations

from typing import Final

#: One colour per model. A model identified another way has the colour of its kind, see `model_colour`.
MODELS: Final[dict[str, str]] = {
    "linear": "#999999",
    "bouc_wen": "#CC79A7",
    "mpi": "#E69F00",
    "mpi_lag": "#8C6D00",
    "lssvm": "#56B4E9",
    "lssvm_frozen": "#56B4E9",
    "lssvm_memory": "#0072B2",
    "lssvm_adaptive": "#009E73",
    "auto": "#7B4FA3",
    "champion": "#7B4FA3",
    "none": "#666666",
}
#: An adapting model and its frozen copy, where a picture shows only these two.
ADAPTIVE: Final = MODELS["lssvm_adaptive"]
FROZEN: Final = MODELS["lssvm_frozen"]
#: Signals and marks.
MEASURED: Final = "#000000"
REFERENCE: Final = "#000000"
TRAINING: Final = "#BBBBBB"
DRIVE: Final = "#666666"
LIMIT: Final = "#666666"
NOISE_BAND: Final = "#BBBBBB"
EVENT: Final = "#D55E00"
TROUBLE: Final = "#AA4499"
DIAGNOSTIC: Final = "#332288"
#: Residual without and with a cause (or an improvement).
BEFORE: Final = "#D55E00"
AFTER: Final = "#0072B2"
#: For what is neither a model nor one of the signals above: controllers, processes, second axes.
SERIES: Final[tuple[str, ...]] = (
    "#332288",
    "#CC6677",
    "#117733",
    "#88CCEE",
    "#AA4499",
    "#DDCC77",
    "#882255",
    "#44AA99",
    "#B07040",
    "#777777",
)


def model_colour(key: str) -> str:
    """The colour of the model ``key``; one that learns online or was identified another way has that of its kind.

    Unknown models get one of `SERIES`, the same in every picture.
    """
    for suffix in ("_online", "_pso", "_given"):
        key = key.removesuffix(suffix)
    return MODELS.get(key, SERIES[sum(key.encode()) % len(SERIES)])


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of "#RRGGBB"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
