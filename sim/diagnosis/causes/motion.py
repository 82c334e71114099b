"""Causes in the motion: creep, cross_talk, thermal_drift, gain_drift, stick_slip."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from adaptive.compiled import compiled
from adaptive.types import FloatArray
from sim.diagnosis.model.fit_data import ActsOn, FitData, LastResultCache, ModelParameter
from sim.diagnosis.model.stage_model import CauseModel, Guess


@compiled
def slow_poles(x: FloatArray, rates: FloatArray) -> FloatArray:
    """(m, n) first-order lags of x - x[0] with rates dt/tau (m,), exact for an x that is held over each sample."""
    m = rates.shape[0]
    n = x.shape[0]
    out = np.empty((m, n))
    for j in range(m):
        keep = math.exp(-rates[j])
        take = 1.0 - keep
        s = 0.0
        for k in range(n):
            out[j, k] = s
            s = keep * s + take * (x[k] - x[0])
    return out


@compiled
def friction(x: FloatArray, width: float, share: float) -> FloatArray:
    """Friction: the output sticks after each reversal until x is ``width`` away, then follows ``share * width`` behind.

    share = 1 is a play of radius ``width``; below 1, the output jumps when it breaks free.
    """
    n = x.shape[0]
    out = np.empty(n)
    s = x[0]
    slide = share * width
    direction = 0.0
    for k in range(n):
        gap = x[k] - s
        if direction > 0.0 and gap >= slide:
            s = x[k] - slide
        elif direction < 0.0 and -gap >= slide:
            s = x[k] + slide
        else:
            direction = 0.0
            if gap > width:
                s = x[k] - slide
                direction = 1.0
            elif -gap > width:
                s = x[k] + slide
                direction = -1.0
        out[k] = s
    return out


_POLES = LastResultCache()


@dataclass(frozen=True)
class Creep(CauseModel):
    """A sum of slow first-order lags, 0.05 s to beyond the record, 0.6 decades apart. Equal weights give log t."""

    name: str = "creep"
    unseen_is_absent: bool = True
    imitates_others: bool = True
    model_error: float = 0.04
    spacing: float = 0.6  # decades between the poles

    def taus_s(self, data: FitData) -> FloatArray:
        top = data.slowest_s
        count = max(2, int(np.floor(np.log10(top / 0.05) / self.spacing)) + 1)
        return np.asarray(0.05 * 10.0 ** (self.spacing * np.arange(count)), dtype=np.float64)

    def missing(self, data: FitData) -> str:
        return "" if data.duration_s > 1.0 else "a record longer than a second"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 5e-4 <= self.reported(p, data)["gain_per_decade"][0] <= 0.08

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        weights = [
            ModelParameter(f"weight{j + 1}", "1", 0.0, 0.0, 0.1, 0.005, ActsOn.MOTION, True)
            for j in range(self.taus_s(data).size)
        ]
        # Creep goes on from a step before the recording.
        return (*weights, ModelParameter("start_um", "µm", 0.0, -r, r, 0.05 * r, ActsOn.MOTION))

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return [trial[:-1] for trial in super().guesses(data, residual_um)]

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if not np.any(p[:-1]):
            return x_um
        taus = self.taus_s(data)
        rates = data.dt_s / taus
        poles = _POLES.get(x_um, rates.tobytes(), lambda: np.asarray(slow_poles(x_um, rates)))
        out = x_um + p[:-1] @ poles
        if p[-1] != 0.0:
            out += p[-1] * (p[:-1] @ _steps(data, taus))
        return np.asarray(out)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        # Slope of the step response over log10 t, from 0.1 s to half the record.
        taus = self.taus_s(data)
        t = np.logspace(-1.0, np.log10(max(data.slowest_s / 6.0, 0.3)), 60)
        rise = 1.0 - np.exp(-t[None, :] / taus[:, None])
        x = np.log10(t) - np.log10(t).mean()
        row = rise @ x / float(x @ x)
        row = np.append(row, 0.0)
        return {"gain_per_decade": (float(row @ p), row)}


@dataclass(frozen=True)
class CrossTalk(CauseModel):
    """A share of the other axis' displacement and of its velocity."""

    name: str = "cross_talk"
    unseen_is_absent: bool = True

    def missing(self, data: FitData) -> str:
        return "" if data.other_um is not None else "the other axis driven and recorded (u2_V or y2_um)"

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (
            ModelParameter("static", "1", 0.0, -2.0, 2.0, 0.002, ActsOn.MOTION),
            ModelParameter("rate_s", "s", 0.0, -1e-3, 1e-3, 1e-5, ActsOn.MOTION),
        )

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if data.other_um is None or data.other_um_per_s is None:
            return x_um
        return np.asarray(x_um + p[0] * data.other_um + p[1] * data.other_um_per_s)


@dataclass(frozen=True)
class _Drift(CauseModel):
    """A slow change: a spline in time or, as ``variant`` "temperature", with the recorded temperature."""

    unseen_is_absent: bool = True
    imitates_others: bool = True
    of_one_recording: bool = True

    def missing(self, data: FitData) -> str:
        if self.variant == "temperature" and data.warmth_K is None:
            return "a temperature that was recorded and moved"
        return "" if data.duration_s > 1.0 else "a record longer than a second"

    def spans(self, data: FitData) -> int:
        return int(np.clip(data.duration_s // 10.0, 2, 6))


@dataclass(frozen=True)
class ThermalDrift(_Drift):
    """A slow additive drift."""

    name: str = "thermal_drift"

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        if self.variant == "temperature":
            return (ModelParameter("um_per_K", "µm/K", 0.0, -0.2 * r, 0.2 * r, 1e-3 * r, ActsOn.MOTION),)
        return tuple(
            ModelParameter(f"drift{j + 1}_um", "µm", 0.0, -0.1 * r, 0.1 * r, 1e-3 * r, ActsOn.MOTION, True)
            for j in range(self.spans(data))
        )

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if self.variant == "temperature":
            return x_um if data.warmth_K is None else x_um + p[0] * data.warmth_K
        return x_um + _spline(p, data)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        if self.variant == "temperature":
            return super().reported(p, data)
        rate = np.zeros(p.size)
        rate[-1] = 1.0 / data.duration_s
        return {"rate_um_per_s": (float(rate @ p), rate)}


@dataclass(frozen=True)
class GainDrift(_Drift):
    """A slow change of the gain."""

    name: str = "gain_drift"

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        if self.variant == "temperature":
            return (ModelParameter("gain_per_K", "1/K", 0.0, -0.05, 0.05, 1e-3, ActsOn.MOTION),)
        return tuple(
            ModelParameter(f"gain{j + 1}", "1", 0.0, -0.2, 0.2, 2e-3, ActsOn.MOTION, True)
            for j in range(self.spans(data))
        )

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if self.variant == "temperature":
            return x_um if data.warmth_K is None else x_um * (1.0 + p[0] * data.warmth_K)
        return x_um * (1.0 + _spline(p, data))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        if self.variant == "temperature":
            return super().reported(p, data)
        last = np.zeros(p.size)
        last[-1] = 1.0
        return {
            "gain": (float(p[-1]), last),
            "rate_per_s": (float(p[-1]) / data.duration_s, last / data.duration_s),
        }


def _steps(data: FitData, taus_s: FloatArray) -> FloatArray:
    """(m, n) response of each slow lag to a unit step at the first sample."""
    return data.derived(("step responses", taus_s.size), lambda: 1.0 - np.exp(-data.t_s[None, :] / taus_s[:, None]))


def _spline(p: FloatArray, data: FitData) -> FloatArray:
    """(n,) cubic spline in time through 0 at the start and the values ``p`` at equal spans."""

    def basis() -> FloatArray:
        knots = np.arange(p.size + 1) * (data.duration_s / p.size)
        return np.ascontiguousarray(CubicSpline(knots, np.eye(p.size + 1)[:, 1:])(data.t_s).T)

    return np.asarray(p @ data.derived(("splines", p.size), basis))


@dataclass(frozen=True)
class StickSlip(CauseModel):
    """Friction, see `friction`: the stage sticks after each reversal, then slides behind by a share of the width."""

    name: str = "stick_slip"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 1e-5 * data.range_um < float(p[0]) < 0.0099 * data.range_um

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        return (
            ModelParameter("width_um", "µm", 0.0, 0.0, 0.01 * r, 1e-4 * r, ActsOn.MOTION),
            ModelParameter("sliding_share", "1", 1.0, 0.0, 1.0, 0.1, ActsOn.MOTION),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        r = data.range_um
        return [[np.array([w * r, share])] for w in (1e-4, 2.5e-4, 5e-4, 1e-3, 3e-3) for share in (1.0, 0.6, 0.2)]

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return x_um if p[0] <= 0.0 else np.asarray(friction(x_um, float(p[0]), float(p[1])))
