"""What the forms of both drifts share: a slow change, in time or with the recorded temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import CauseModel
from dehyst.sim.readings.slow_motion import Change

#: Knots (shares of the duration) for a change that is fast at first: a temperature settles as the root of time.
_EARLY = np.array([0.0, 0.02, 0.045, 0.08, 0.13, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])


@dataclass(frozen=True)
class SlowChange(CauseModel):
    """A spline in time of equal spans, as ``variant`` "early" of short ones at first; or, as ``variant`` "temperature",
    what goes with the recorded temperature."""

    unseen_is_absent: bool = True
    imitates_others: bool = True
    of_one_recording: bool = True

    def missing(self, data: FitData) -> str:
        if self.variant == "temperature" and data.warmth_K is None:
            return "a temperature that was recorded and moved"
        return "" if data.duration_s > 1.0 else "a record longer than a second"

    def spans(self, data: FitData) -> int:
        return _EARLY.size - 1 if self.variant == "early" else int(np.clip(data.duration_s // 5.0, 2, 6))

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        if left_floors <= 1.1 or self.variant:
            return None
        equal = np.linspace(0.0, 1.0, p.size + 1)
        return replace(self, variant="early"), [np.interp(_EARLY[1:], equal, np.append(0.0, p))]

    def agrees(self, change: Change | None, p: FloatArray, data: FitData) -> float | None:
        """What the fit ``p`` changes in the part of the record in which the rests show ``change``; None where they do
        not agree."""
        if self.variant == "temperature" or change is None:
            return None
        course = self.course(p, data)
        begin, end = (min(round(t / data.dt_s), data.n - 1) for t in (change.begin_s, change.end_s))
        fitted = float(course[end] - course[begin])
        return fitted if change.agrees(fitted) else None

    def course(self, p: FloatArray, data: FitData) -> FloatArray:
        """(n,) cubic spline in time through 0 at the start and the values ``p`` at the later knots."""
        knots = _EARLY if self.variant == "early" else np.linspace(0.0, 1.0, p.size + 1)

        def basis() -> FloatArray:
            from scipy.interpolate import CubicSpline  # a simulated stage does not wait for it

            each = CubicSpline(knots * data.duration_s, np.eye(knots.size)[:, 1:])
            return np.ascontiguousarray(each(data.t_s).T)

        return np.asarray(p @ data.derived(("splines", knots.size), basis))
