"""What both drifts have in common: a slow change, as a spline in time or with the recorded temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import CauseModel


@dataclass(frozen=True)
class Drift(CauseModel):
    """A slow change: a spline in time or, as ``variant`` "temperature", with the recorded temperature."""

    unseen_is_absent: bool = True
    imitates_others: bool = True
    of_one_recording: bool = True

    def missing(self, data: FitData) -> str:
        if self.variant == "temperature" and data.warmth_K is None:
            return "a temperature that was recorded and moved"
        return "" if data.duration_s > 1.0 else "a record longer than a second"

    def spans(self, data: FitData) -> int:
        return int(np.clip(data.duration_s // 5.0, 2, 6))


def spline(p: FloatArray, data: FitData) -> FloatArray:
    """(n,) cubic spline in time through 0 at the start and the values ``p`` at equal spans."""

    def basis() -> FloatArray:
        from scipy.interpolate import CubicSpline  # a simulated stage does not wait for it

        knots = np.arange(p.size + 1) * (data.duration_s / p.size)
        return np.ascontiguousarray(CubicSpline(knots, np.eye(p.size + 1)[:, 1:])(data.t_s).T)

    return np.asarray(p @ data.derived(("splines", p.size), basis))
