"""Causes that are no smooth change of the reading: the grid of a converter, and readings that repeat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.fit import Fit
from sim.diagnosis.model.measured import Setting
from sim.diagnosis.report.result import Cause
from sim.diagnosis.search.noise_floor import Floor


@dataclass(frozen=True)
class Grid:
    """Step of the readings' grid (µm, 0 where there is none that shows) and how many levels were used."""

    step_um: float
    levels: int


def grid_of(y_um: FloatArray) -> Grid:
    """The grid that all readings lie on, or none.

    The smallest distance between levels is refined to the step that every reading is a multiple of; a record whose
    levels are nearly as many as its readings has no grid that could matter.
    """
    levels = np.unique(y_um)
    if levels.size < 3 or levels.size > 0.9 * y_um.size:
        return Grid(0.0, int(levels.size))
    gaps = np.diff(levels)
    # Differences of doubles carry rounding; a step is far larger than that.
    gaps = gaps[gaps > 1e-9 * max(float(np.max(np.abs(levels))), 1e-12)]
    if gaps.size < 2:
        return Grid(0.0, int(levels.size))
    step = float(np.min(gaps))
    for _ in range(3):
        counts = np.rint(gaps / step)
        step = float(gaps.sum() / counts.sum())
    counts = np.rint(gaps / step)
    off = np.abs(gaps - counts * step) / step
    return Grid(step if float(np.quantile(off, 0.99)) < 0.05 else 0.0, int(levels.size))


@dataclass(frozen=True)
class Repeats:
    """Readings that repeat the one before although the motion had moved on: how many, of how many that could show."""

    count: int
    of: int
    where: FloatArray

    @property
    def probability(self) -> float:
        return self.count / self.of if self.of else 0.0


def repeats(y_um: FloatArray, sigma_um: float, step_um: float) -> Repeats:
    """Count exact repeats between two samples that both moved by far more than the noise and the grid.

    Asked of the readings alone: where a clamp or friction holds the stage, they do not move before and after.
    """
    moved = np.diff(y_um)
    least = 8.0 * max(sigma_um, 1e-12) + 1.5 * step_um
    # Both the same way: at the top of a fast sine a step of zero is no repeat.
    candidate = (np.minimum(moved[:-2], moved[2:]) > least) | (np.maximum(moved[:-2], moved[2:]) < -least)
    where = np.flatnonzero(candidate & (moved[1:-1] == 0.0)) + 2
    return Repeats(int(where.size), int(candidate.sum()), where.astype(np.float64))


def converter_causes(
    setting: Setting, grid: Grid, doubles: Repeats | None, floor: Floor, extended: Fit, n: int, dropped: int
) -> tuple[Cause, ...]:
    """Quantisation and timing, which are seen in the readings themselves rather than fitted."""
    out: list[Cause] = []
    flat = extended.residual_um
    if grid.step_um > 0.0:
        own = grid.step_um**2 / 12.0
        share = own / max(extended.sse_um2 / n, own)
        if grid.step_um > 1.2 * floor.sigma_um and share > 0.2:
            step = grid.step_um
            rounding = 1e-3 * step
            out.append(
                Cause(
                    "quantisation",
                    (),
                    {"step_um": step},
                    {"step_um": (step - rounding, step + rounding)},
                    share,
                    0.001,
                    flat,
                    flat,
                )
            )
    if doubles is not None:
        p = doubles.probability
        half = 1.96 * float(np.sqrt(p * (1.0 - p) / max(1, doubles.of)))
        out.append(
            Cause(
                "timing",
                (),
                {"repeat_probability": p},
                {"repeat_probability": (max(0.0, p - half), p + half)},
                0.0,
                0.001,
                flat,
                flat,
            )
        )
    elif dropped > 0:
        share = dropped / setting.n
        out.append(
            Cause(
                "timing",
                (),
                {"lost_samples": float(dropped)},
                {"lost_samples": (float(dropped), float(dropped))},
                share,
                0.001,
                flat,
                flat,
            )
        )
    names = {f.name for f in extended.model.forms}
    return tuple(c for c in out if c.name not in names)
