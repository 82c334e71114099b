"""A/D converter: readings on a grid. A diagnosis finds it in the readings; no form is fitted."""

from __future__ import annotations

from typing import Any

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Effect, FoundInReadings, InReadings, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.readings.noise import converter_grid


@block
def run_quantisation(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: step µm (0: none)."""
    if p[0] > 0.0:
        for k in range(n):
            x[k] = p[0] * round(x[k] / p[0])


def find(data: FitData, residual_um: FloatArray, mask: BoolArray, sigma_um: float) -> FoundInReadings | None:
    """A grid that is coarser than the noise and makes a fifth of what is left."""
    grid = converter_grid(data.y_um[mask])
    if grid.step_um <= 1.2 * sigma_um:
        return None
    own = grid.step_um**2 / 12.0
    share = own / max(float(np.mean(np.square(residual_um[mask]))), own)
    if share <= 0.2 and grid.step_um <= 2.0 * sigma_um:
        return None
    step, rounding = grid.step_um, 1e-3 * grid.step_um
    words = f"all readings lie on a grid of {1e3 * step:.4g} nm ({grid.levels} levels)"
    return FoundInReadings({"step_um": step}, {"step_um": (step - rounding, step + rounding)}, share, words)


def in_library(parameters: dict[str, float]) -> tuple[tuple[Effect, ...], float]:
    step_um = parameters["step_um"]
    return (QUANTISATION.clipped(step_um=step_um),), step_um**2 / 12.0


QUANTISATION = Kind(
    name="quantisation",
    place=Place.ADC,
    parameters=(Parameter("step_um", "µm", 0.0, 10.0, 100.0 / 65536, "step of the grid; 0: none"),),
    derive=lambda values, context: (values["step_um"],),
    block=run_quantisation,
    signature="few distinct levels, dead patches at low rate",
    mistaken_for=("stick_slip",),
    tells_apart="the levels lie on one grid everywhere",
    source="16 bit over 100 µm: 1.5 nm",
    cause=Cause(
        sign="all readings lie on a grid",
        picture=pictures.at_rest,
        in_readings=InReadings(find, in_library),
    ),
)
