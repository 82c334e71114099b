"""The records that every model of the reproduction is identified on and scored by.

The stage runs at 1 ms. The chapter's 500 samples are every twentieth of them. The commanded voltage is known between
those samples, and models with memory run on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.signals import voltages
from sim.stage.config import StageConfig
from sim.stage.presets import preset
from sim.stage.stage import Stage

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
