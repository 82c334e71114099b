"""Records of the chapter: those that models are identified on and scored by, and the characterisation of the stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.signals import voltages
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

# --- The records that every model of the reproduction is identified on and scored by.
#
# The stage runs at 1 ms. The chapter's 500 samples are every twentieth of them. The commanded voltage is known between
# those samples, and models with memory run on it.

#: Control period of the chapter, s, and number of periods between two of its 500 samples.
DT_S = 1e-3
EVERY = 20
#: Length of the ramp that precedes a record which begins above 0 V, s.
_LEAD_S = 0.5


@dataclass(frozen=True, slots=True)
class Score:
    """MAE (2.43) and RMSE (2.44) in percent of a motion range, and the largest error, µm."""

    mae_pct: float
    rmse_pct: float
    max_um: float

    @staticmethod
    def of(error_um: FloatArray, range_um: float) -> Score:
        """The score of errors (n,) µm; NaN where a sample is not finite."""
        size = np.abs(error_um)
        scale = 100.0 / range_um
        return Score(scale * float(np.mean(size)), scale * float(np.sqrt(np.mean(size**2))), float(np.max(size)))


@dataclass(frozen=True, slots=True)
class Record:
    """One run of the stage from rest, 1 ms apart: time s, voltage V, readings of both axes µm; (n,) each."""

    name: str
    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    y2_um: FloatArray

    @property
    def coarse_t_s(self) -> FloatArray:
        """Times of the 0.02 s samples."""
        return self.t_s[::EVERY]

    @property
    def coarse_u_V(self) -> FloatArray:
        """Voltages of the 0.02 s samples."""
        return np.ascontiguousarray(self.u_V[::EVERY])

    @property
    def coarse_y_um(self) -> FloatArray:
        """Readings of the 0.02 s samples."""
        return np.ascontiguousarray(self.y_um[::EVERY])


def record(stage: Stage, name: str, u_V: FloatArray, u2_V: FloatArray | None = None) -> Record:
    """Run ``u_V`` (n,) V on the first axis from rest; a ramp precedes it unless it begins near 0 V."""
    u = np.asarray(u_V, dtype=np.float64)
    if abs(u[0]) > 0.05:
        n = round(_LEAD_S / stage.config.dt_s)
        ramp = np.arange(n, dtype=np.float64) * (float(u[0]) / n)
        u = np.concatenate([ramp, u])
        if u2_V is not None:
            u2_V = np.concatenate([np.zeros(ramp.size), u2_V])
    y, y2 = stage.run(stage.initial_state(), u, u2_V)
    return Record(name, np.arange(u.size, dtype=np.float64) * stage.config.dt_s, u, y, y2)


@dataclass(frozen=True, slots=True)
class Experiments:
    """The records of one stage: (2.37), (2.45), and a third family that the chapter lacks."""

    config: StageConfig
    training: Record
    generalisation: Record
    third: tuple[Record, ...]

    @property
    def range_um(self) -> float:
        """Motion range of the training record, µm, which percentages refer to."""
        return float(np.ptp(self.training.y_um))


def experiments(name: str, *, seed: int = 0, quick: bool = False) -> Experiments:
    """Record all experiments on the preset ``name``; ``quick`` records one multi-tone instead of four.

    Raises InputError for an unknown preset.
    """
    config = preset(name, seed=seed, dt_s=DT_S)
    stage = Stage(config)
    third = [("minor loops", voltages.minor_loops(dt_s=DT_S)[1]), ("sine 5 Hz", voltages.sine(0.0, 7.5, 5.0, 20)[1])]
    third += [(f"multi-tone {n + 1}", voltages.multitone(10.0, DT_S, seed=n)[1]) for n in range(1 if quick else 4)]
    return Experiments(
        config,
        record(stage, "training", voltages.training_input(DT_S)[1]),
        record(stage, "generalisation", voltages.generalisation_input(DT_S)[1]),
        tuple(record(stage, title, u) for title, u in third),
    )


# --- Figs. 2.2 and 2.3: width of the loop over amplitude and frequency, and cross-talk between the axes.

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
    """Numbers of Fig. 2.2 (triangles) and Fig. 2.3 (sines); the cross-talks are None for a single axis."""

    triangle_widths: tuple[Width, ...]
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
    widths = []
    for frequency in FREQUENCIES_HZ:
        run = record(stage, f"{frequency:g} Hz", voltages.sine(0.0, _SINE_V, frequency, _CYCLES, DT_S)[1])
        last = slice(run.u_V.size - round(1.0 / (frequency * DT_S)), run.u_V.size)
        stroke = float(np.ptp(run.y_um[last]))
        widths.append(Width(_SINE_V, frequency, stroke, loop_width(run.u_V[last], run.y_um[last])))
    talk = _share(first.y2_um, first.y_um) if second is not None else None
    back = _share(second.y_um, second.y2_um) if second is not None else None
    return Characterisation(tuple(triangles), tuple(widths), talk, back)


def _share(of_um: FloatArray, by_um: FloatArray) -> float:
    """Displacement of the axis at rest relative to that of the driven one, by least squares, percent."""
    driven = by_um - by_um[0]
    return 100.0 * float(driven @ (of_um - of_um[0]) / (driven @ driven))
