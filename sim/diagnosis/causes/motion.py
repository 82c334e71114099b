"""Causes in the motion: creep, cross_talk, thermal_drift, gain_drift, stick_slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from adaptive.types import FloatArray
from sim.diagnosis.model.forms import Form, Trial
from sim.diagnosis.model.loops_linear import friction, slow_poles
from sim.diagnosis.model.measured import At, Kept, Setting, Slot

_POLES = Kept()


@dataclass(frozen=True)
class Creep(Form):
    """Slow poles half a decade apart, 0.03 s to beyond the record: equal weights are log t."""

    name: str = "creep"
    form_error: float = 0.04
    spacing: float = 0.6  # decades between the poles

    def taus_s(self, setting: Setting) -> FloatArray:
        top = setting.slowest_s
        count = max(2, int(np.floor(np.log10(top / 0.05) / self.spacing)) + 1)
        return np.asarray(0.05 * 10.0 ** (self.spacing * np.arange(count)), dtype=np.float64)

    def applies(self, setting: Setting) -> str:
        return "" if setting.duration_s > 1.0 else "a record longer than a second"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return 5e-4 <= self.physical(p, setting)["gain_per_decade"][0] <= 0.08

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        r = setting.range_um
        weights = [
            Slot(f"weight{j + 1}", "1", 0.0, 0.0, 0.1, 0.005, At.MOTION, True) for j in range(self.taus_s(setting).size)
        ]
        # A step before the record began is still creeping.
        return (*weights, Slot("start_um", "µm", 0.0, -r, r, 0.05 * r, At.MOTION))

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        return [trial[:-1] for trial in super().trials(setting, residual_um)]

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        if not np.any(p[:-1]):
            return x_um
        taus = self.taus_s(setting)
        rates = setting.dt_s / taus
        poles = _POLES.of(x_um, rates.tobytes(), lambda: np.asarray(slow_poles(x_um, rates)))
        out = x_um + p[:-1] @ poles
        if p[-1] != 0.0:
            out += p[-1] * (p[:-1] @ _steps(setting, taus))
        return np.asarray(out)

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        # Slope of the step response over log10 t, from the first pole's time to half of the record.
        taus = self.taus_s(setting)
        t = np.logspace(-1.0, np.log10(max(setting.slowest_s / 6.0, 0.3)), 60)
        rise = 1.0 - np.exp(-t[None, :] / taus[:, None])
        x = np.log10(t) - np.log10(t).mean()
        row = rise @ x / float(x @ x)
        row = np.append(row, 0.0)
        return {"gain_per_decade": (float(row @ p), row)}


@dataclass(frozen=True)
class CrossTalk(Form):
    """A share of the other axis' displacement and of its velocity."""

    name: str = "cross_talk"

    def applies(self, setting: Setting) -> str:
        return "" if setting.other_um is not None else "the other axis driven and recorded (u2_V or y2_um)"

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return (
            Slot("static", "1", 0.0, -2.0, 2.0, 0.002, At.MOTION),
            Slot("rate_s", "s", 0.0, -1e-3, 1e-3, 1e-5, At.MOTION),
        )

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        if setting.other_um is None or setting.other_um_per_s is None:
            return x_um
        return np.asarray(x_um + p[0] * setting.other_um + p[1] * setting.other_um_per_s)


@dataclass(frozen=True)
class ThermalDrift(Form):
    """A slow additive drift: piecewise linear in time, or following the temperature that was recorded."""

    name: str = "thermal_drift"
    of_one_recording: bool = True

    def applies(self, setting: Setting) -> str:
        if self.variant == "temperature" and setting.warmth_K is None:
            return "a temperature that was recorded and moved"
        return "" if setting.duration_s > 1.0 else "a record longer than a second"

    def spans(self, setting: Setting) -> int:
        return int(np.clip(setting.duration_s // 10.0, 2, 6))

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        r = setting.range_um
        if self.variant == "temperature":
            return (Slot("um_per_K", "µm/K", 0.0, -0.2 * r, 0.2 * r, 1e-3 * r, At.MOTION),)
        return tuple(
            Slot(f"drift{j + 1}_um", "µm", 0.0, -0.1 * r, 0.1 * r, 1e-3 * r, At.MOTION, True)
            for j in range(self.spans(setting))
        )

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        if self.variant == "temperature":
            return x_um if setting.warmth_K is None else x_um + p[0] * setting.warmth_K
        return x_um + _spline(p, setting)

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        if self.variant == "temperature":
            return super().physical(p, setting)
        rate = np.zeros(p.size)
        rate[-1] = 1.0 / setting.duration_s
        return {"rate_um_per_s": (float(rate @ p), rate)}


@dataclass(frozen=True)
class GainDrift(Form):
    """A gain that changes over time, or with the recorded temperature."""

    name: str = "gain_drift"
    of_one_recording: bool = True

    def applies(self, setting: Setting) -> str:
        if self.variant == "temperature" and setting.warmth_K is None:
            return "a temperature that was recorded and moved"
        return "" if setting.duration_s > 1.0 else "a record longer than a second"

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        if self.variant == "temperature":
            return (Slot("gain_per_K", "1/K", 0.0, -0.05, 0.05, 1e-3, At.MOTION),)
        spans = ThermalDrift().spans(setting)
        return tuple(Slot(f"gain{j + 1}", "1", 0.0, -0.2, 0.2, 2e-3, At.MOTION, True) for j in range(spans))

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        if self.variant == "temperature":
            return x_um if setting.warmth_K is None else x_um * (1.0 + p[0] * setting.warmth_K)
        return x_um * (1.0 + _spline(p, setting))

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        if self.variant == "temperature":
            return super().physical(p, setting)
        last = np.zeros(p.size)
        last[-1] = 1.0
        return {
            "gain": (float(p[-1]), last),
            "rate_per_s": (float(p[-1]) / setting.duration_s, last / setting.duration_s),
        }


def _steps(setting: Setting, taus_s: FloatArray) -> FloatArray:
    """What a unit step at the start becomes in each pole, (m, n)."""
    known: FloatArray | None = setting.__dict__.get("_slow_steps")
    if known is None or known.shape[0] != taus_s.size:
        known = 1.0 - np.exp(-setting.t_s[None, :] / taus_s[:, None])
        setting.__dict__["_slow_steps"] = known
    return known


def _spline(p: FloatArray, setting: Setting) -> FloatArray:
    """A cubic spline in time through 0 at the start and ``p`` at equal spans."""
    known: FloatArray | None = setting.__dict__.get("_time_splines")
    if known is None or known.shape[0] != p.size:
        knots = np.arange(p.size + 1) * (setting.duration_s / p.size)
        known = np.ascontiguousarray(CubicSpline(knots, np.eye(p.size + 1)[:, 1:])(setting.t_s).T)
        setting.__dict__["_time_splines"] = known
    return np.asarray(p @ known)


@dataclass(frozen=True)
class StickSlip(Form):
    """Friction: stuck after each reversal, then sliding behind by a share of the width."""

    name: str = "stick_slip"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return 1e-5 * setting.range_um < float(p[0]) < 0.0099 * setting.range_um

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        r = setting.range_um
        return (
            Slot("width_um", "µm", 0.0, 0.0, 0.01 * r, 1e-4 * r, At.MOTION),
            Slot("sliding_share", "1", 1.0, 0.0, 1.0, 0.1, At.MOTION),
        )

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        r = setting.range_um
        return [[np.array([w * r, share])] for w in (1e-4, 2.5e-4, 5e-4, 1e-3, 3e-3) for share in (1.0, 0.6, 0.2)]

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return x_um if p[0] <= 0.0 else np.asarray(friction(x_um, float(p[0]), float(p[1])))
