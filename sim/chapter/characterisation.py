"""Figs. 2.2 and 2.3: width of the loop over amplitude and frequency, and cross-talk between the axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.chapter.experiments import DT_S, Record, record
from sim.signals import voltages
from sim.stage.config import StageConfig
from sim.stage.stage import Stage

AMPLITUDES_V = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
FREQUENCIES_HZ = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)
#: Peak of the sines, V, and number of cycles; the last one is evaluated.
_SINE_V = 8.0
_CYCLES = 4


@dataclass(frozen=True, slots=True)
class Width:
    """One loop: amplitude V and frequency Hz of the input, stroke µm, and largest width at one voltage µm."""

    amplitude_V: float
    frequency_Hz: float
    stroke_um: float
    width_um: float

    @property
    def width_pct(self) -> float:
        """Width in percent of the stroke."""
        return 100.0 * self.width_um / self.stroke_um


@dataclass(frozen=True, slots=True)
class Characterisation:
    """Data of Fig. 2.2 (each axis in turn) and Fig. 2.3; ``second_axis`` and cross-talks are None for a single axis."""

    triangles: Record
    second_axis: Record | None
    triangle_widths: tuple[Width, ...]
    sines: tuple[Record, ...]
    sine_widths: tuple[Width, ...]
    cross_talk_pct: float | None
    cross_talk_back_pct: float | None


def loop_width(u_V: FloatArray, y_um: FloatArray) -> float:
    """Largest difference in y, µm, between the falling and the rising half of a loop (n,) that begins at its bottom.

    The halves meet at the largest voltage and are compared at 400 voltages between 2 and 98 % of the range.
    """
    top = int(np.argmax(u_V))
    low, high = float(np.min(u_V)), float(u_V[top])
    at = np.linspace(low + 0.02 * (high - low), high - 0.02 * (high - low), 400)
    up = np.interp(at, u_V[: top + 1], y_um[: top + 1])
    down = np.interp(at, u_V[top:][::-1], y_um[top:][::-1])
    return float(np.max(down - up))


def characterise(config: StageConfig) -> Characterisation:
    """Run the triangles on each axis alone and the sines on the first."""
    stage = Stage(config)
    _, u = voltages.growing_triangles(DT_S, AMPLITUDES_V)
    first = record(stage, "triangles", u)
    second = record(stage, "triangles, second axis", np.zeros(u.size), u) if config.second_axis is not None else None
    ends = np.cumsum([0.0, *(2.0 * a for a in AMPLITUDES_V)]) / 6.0
    triangles = []
    for amplitude, start_s, end_s in zip(AMPLITUDES_V, ends[:-1], ends[1:], strict=True):
        part = slice(round(start_s / DT_S), min(u.size, round(end_s / DT_S) + 1))
        y = first.y_um[part]
        triangles.append(Width(amplitude, 1.0 / (end_s - start_s), float(np.ptp(y)), loop_width(u[part], y)))
    sines, widths = [], []
    for frequency in FREQUENCIES_HZ:
        run = record(stage, f"{frequency:g} Hz", voltages.sine(0.0, _SINE_V, frequency, _CYCLES, DT_S)[1])
        last = slice(run.u_V.size - round(1.0 / (frequency * DT_S)), run.u_V.size)
        sines.append(run)
        stroke = float(np.ptp(run.y_um[last]))
        widths.append(Width(_SINE_V, frequency, stroke, loop_width(run.u_V[last], run.y_um[last])))
    talk = _share(first.y2_um, first.y_um) if second is not None else None
    back = _share(second.y_um, second.y2_um) if second is not None else None
    return Characterisation(first, second, tuple(triangles), tuple(sines), tuple(widths), talk, back)


def _share(of_um: FloatArray, by_um: FloatArray) -> float:
    """Displacement of the axis at rest relative to that of the driven one, by least squares, percent."""
    driven = by_um - by_um[0]
    return 100.0 * float(driven @ (of_um - of_um[0]) / (driven @ driven))
