"""Causes in the mechanics: resonance, sensor_lag, delay, payload_change, and cross_talk through modes.

The mechanics are linear. A cause is one mode, lag or dead time more, another frequency of a known mode, or a sum of
modes that is added to the displacement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from sim.diagnosis.model.calibration import ModelFit
from sim.diagnosis.model.dynamics import Dynamics, respond_partial
from sim.diagnosis.model.fit_data import ActsOn, FitData, ModelParameter
from sim.diagnosis.model.stage_model import CauseModel, Guess, single_guesses


@dataclass(frozen=True)
class Resonance(CauseModel):
    """A second-order mode of unit gain after the hysteresis that the nominal stage lacks."""

    name: str = "resonance"
    unseen_is_absent: bool = True
    fast: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return bool(np.exp(p[1]) < 0.4)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        top = 0.47 / data.dt_s
        return (
            ModelParameter(
                "log_f0",
                "1",
                float(np.log(300.0 * top)),
                float(np.log(0.01 * top)),
                float(np.log(top)),
                0.02,
                ActsOn.DYNAMICS,
            ),
            ModelParameter(
                "log_damping", "1", float(np.log(0.02)), float(np.log(1e-3)), float(np.log(0.5)), 0.3, ActsOn.DYNAMICS
            ),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        spectrum = np.abs(np.fft.rfft(np.diff(residual_um)))
        f = np.fft.rfftfreq(data.n - 1, data.dt_s)
        # Bins of about 2 Hz: a mode of 1 % damping at 200 Hz is that wide.
        width = max(1, round(2.0 * data.duration_s))
        power = np.convolve(spectrum**2, np.ones(width) / width, "same")
        parameters = self.parameters(data)
        inside = (f > np.exp(parameters[0].low)) & (f < np.exp(parameters[0].high))
        for line in (50.0, 60.0, 100.0, 120.0, 150.0, 180.0):
            inside &= np.abs(f - line) > 1.5 + 1.5 / data.duration_s
        if not np.any(inside):
            return []
        peak = float(f[inside][np.argmax(power[inside])])
        guesses = {peak * r for r in (0.97, 0.985, 0.995, 1.0, 1.005, 1.015, 1.03)}
        guesses |= {
            v for v in (150.0, 250.0, 350.0, 450.0, 600.0) if np.exp(parameters[0].low) < v < np.exp(parameters[0].high)
        }
        return [[np.array([np.log(g), np.log(z)])] for g in sorted(guesses) for z in (0.01, 0.04)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        mode = (float(np.exp(p[0])), float(np.exp(p[1])))
        return replace(system, modes_hz=(*system.modes_hz, mode))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        f, z = float(np.exp(p[0])), float(np.exp(p[1]))
        return {"f0_hz": (f, np.array([f, 0.0])), "damping": (z, np.array([0.0, z]))}


@dataclass(frozen=True)
class SensorLag(CauseModel):
    """A first-order low-pass in the sensor's electronics."""

    name: str = "sensor_lag"
    test_answers_to_others: bool = True
    unseen_is_absent: bool = True
    fast: bool = True

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (ModelParameter("tau_s", "s", 0.0, 0.0, 0.03, max(1e-4, 0.1 * data.dt_s), ActsOn.DYNAMICS),)

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([f * data.dt_s for f in (0.1, 0.3, 1.0, 3.0, 10.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, lags_s=(*system.lags_s, float(p[0]))) if p[0] > 1e-7 else system


@dataclass(frozen=True)
class Delay(CauseModel):
    """A dead time of more than the one sample of the recorder."""

    name: str = "delay"
    unseen_is_absent: bool = True
    fast: bool = True
    pins: tuple[str, ...] = ("latch_samples",)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        dt = data.dt_s
        return (ModelParameter("tau_s", "s", dt, dt, max(0.01, 6.0 * dt), 0.1 * dt, ActsOn.DYNAMICS),)

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([f * data.dt_s for f in (1.3, 1.8, 2.5, 3.2, 4.0, 5.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, delay_s=float(p[0]))


def loaded(system: Dynamics, ratio: float) -> Dynamics:
    """The system with ``ratio`` of its moving mass added to the first lightly damped mode.

    Spring and dashpot stay: f0 and damping ratio both fall by sqrt(1 + ratio), the DC gain does not change.
    """
    slower = 1.0 / math.sqrt(1.0 + ratio)
    modes = list(system.modes_hz)
    light = next((i for i, (_, damping) in enumerate(modes) if damping < 0.5), None)
    if light is None:
        return system
    f_hz, damping = modes[light]
    modes[light] = (f_hz * slower, damping * slower)
    return replace(system, modes_hz=tuple(modes))


@dataclass(frozen=True)
class PayloadChange(CauseModel):
    """A payload M: the known mode lies at f0 sqrt(m/(m+M)). Negative if a payload was removed.

    ``variant`` "": throughout the recording, against a frequency that a stage file states; "midway": from a moment in
    the recording on, which the nominal stage's own mode cannot imitate.
    """

    name: str = "payload_change"
    fast: bool = True

    def missing(self, data: FitData) -> str:
        if self.variant == "midway":
            return "" if data.has_mode else "a nominal stage with a mode"
        return "" if data.known_modes_hz else "a nominal stage whose mode is known beforehand"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        if self.variant == "midway" and not 0.02 < p[1] / data.duration_s < 0.98:
            return False
        return abs(float(p[0])) > 0.02

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        ratio = ModelParameter("payload_ratio", "1", 0.0, -0.6, 8.0, 0.02, ActsOn.DYNAMICS)
        if self.variant != "midway":
            return (ratio,)
        t = data.duration_s
        return (ratio, ModelParameter("change_s", "s", 0.5 * t, 0.0, t, 0.01 * t, ActsOn.DYNAMICS))

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        ratios = (-0.3, -0.15, -0.06, 0.06, 0.15, 0.3, 0.6, 1.0, 2.0)
        if self.variant != "midway":
            return [[np.array([r])] for r in ratios]
        t = data.duration_s
        return [[np.array([r, share * t])] for r in (-0.3, -0.1, 0.1, 0.3, 1.0) for share in (0.25, 0.5, 0.75)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system if self.variant == "midway" else loaded(system, float(p[0]))

    def changed_dynamics(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        if self.variant != "midway" or p[0] == 0.0:
            return None
        other = loaded(system, float(p[0]))
        # A mode that is damped out has no frequency that could be seen to move.
        return None if other.modes_hz == system.modes_hz else (float(p[1]), other)


#: Least share of the residual's power that a mode explains.
LEAST = 0.004
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Mode:
    """One mode: frequency (Hz), damping ratio, and the weights of its displacement and of its velocity / omega."""

    f_hz: float
    damping: float
    share: float
    rate: float


def modal_response(x: FloatArray, p: FloatArray, data: FitData, system: Dynamics) -> FloatArray:
    """(n,) sum of modes driven by ``x`` (n,); ``p`` holds log f, log damping, share and rate of each."""
    poles: list[complex] = []
    residues: list[complex] = []
    for log_f, log_z, share, rate in p.reshape(-1, 4):
        w, z = 2.0 * math.pi * math.exp(float(log_f)), min(math.exp(float(log_z)), 0.95)
        damped = w * math.sqrt(1.0 - z * z)
        pole = complex(-z * w, damped)
        # (share w² + rate w s) / ((s - pole)(s - conj(pole)))
        poles.append(pole)
        residues.append((share * w * w + rate * w * pole) / (2.0j * damped))
    return respond_partial(x, poles, residues, system.delay_s, system.hold, data.dt_s)


def modal_parameters(data: FitData, count: int, size: float, at: ActsOn) -> tuple[ModelParameter, ...]:
    """Four parameters per mode. ``size`` is the natural scale of a share."""
    top = 0.49 / data.dt_s
    out: list[ModelParameter] = []
    for i in range(1, count + 1):
        out += [
            ModelParameter(f"log_f{i}", "1", math.log(0.2 * top), math.log(2e-3 * top), math.log(top), 2e-3, at),
            ModelParameter(f"log_damping{i}", "1", math.log(0.02), math.log(1e-3), math.log(0.5), 0.1, at),
            ModelParameter(f"share{i}", "1", 0.0, -50.0 * size, 50.0 * size, 0.05 * size, at),
            ModelParameter(f"rate{i}", "1", 0.0, -50.0 * size, 50.0 * size, 0.05 * size, at),
        ]
    return tuple(out)


def peaks(x: FloatArray, residual_um: FloatArray, dt_s: float, most: int) -> list[Mode]:
    """Modes by which ``x`` (n,) explains the residual (n,), strongest first, found in the frequency domain.

    One mode after the other is taken from where it gains most, its frequency and damping on a grid and its shares by
    least squares; after each all shares are solved for again. Stops where a mode explains less than `LEAST`.
    """
    n = min(x.size, 1 << 16)
    taper = np.ones(n) if x.size <= n else np.hanning(n)
    drive = np.fft.rfft(taper * (x[:n] - x[:n].mean()))
    left = np.fft.rfft(taper * (residual_um[:n] - residual_um[:n].mean()))
    f = np.fft.rfftfreq(n, dt_s)
    keep = (f > 2e-3 / dt_s) & (np.abs(drive) > 1e-2 * float(np.max(np.abs(drive))))
    drive, target, f = drive[keep], left[keep], f[keep]
    if f.size < 50:
        return []
    spacing = float(np.median(np.diff(f)))
    total = float(np.sum(np.abs(target) ** 2))
    columns: list[ComplexArray] = []
    found: list[tuple[float, float]] = []
    rest = target.copy()
    shares: FloatArray = np.zeros(0)
    for _ in range(most):
        # The power at a mode stands in a few bins that lie together.
        width = min(max(3, round(8.0 / spacing)), f.size // 4)
        power = np.convolve(np.abs(rest) ** 2, np.ones(width), "same")
        around = [float(f[i]) for i in np.argsort(-power)[: 4 * width : width]]
        best: tuple[float, float, float] = (0.0, 0.0, 0.0)
        for centre in dict.fromkeys(round(c) for c in around):
            for g in centre * (1.0 + np.linspace(-0.03, 0.03, 13)):
                for damping in (0.002, 0.005, 0.01, 0.02, 0.05):
                    gain = _gain(_columns(f, drive, float(g), damping), rest)
                    if gain > best[0]:
                        best = (gain, float(g), damping)
        if best[0] < LEAST * total:
            break
        found.append(best[1:])
        columns += _columns(f, drive, *best[1:])
        stacked = np.array([np.concatenate([c.real, c.imag]) for c in columns])
        goal = np.concatenate([target.real, target.imag])
        shares = np.linalg.lstsq(stacked.T, goal, rcond=1e-10)[0]
        rest = target - sum(s * c for s, c in zip(shares, columns, strict=True))
    return [Mode(g, z, float(shares[2 * i]), float(shares[2 * i + 1])) for i, (g, z) in enumerate(found)]


def _columns(f: NDArray[np.floating[Any]], drive: ComplexArray, f_hz: float, damping: float) -> list[ComplexArray]:
    ratio = f / f_hz
    mode = drive / (1.0 - ratio**2 + 2j * damping * ratio)
    return [mode, 1j * ratio * mode]


def _gain(columns: list[ComplexArray], rest: ComplexArray) -> float:
    gram = np.array([[float(np.vdot(a, b).real) for b in columns] for a in columns])
    slope = np.array([float(np.vdot(a, rest).real) for a in columns])
    return float(slope @ np.linalg.lstsq(gram, slope, rcond=1e-12)[0])


#: Most modes that one cause may have.
MOST = 10


@dataclass(frozen=True)
class Modes(CauseModel):
    """Modes parallel to the nominal stage, found again in the spectrum of each residual.

    Only beside a nominal stage without a loop: what a loop leaves is no structure's answer to the voltage.
    """

    variant: str = "modes"
    found: tuple[Mode, ...] = ()

    def missing(self, data: FitData) -> str:
        return "" if self.found and data.input_is_linear else "modes that stand out of a linear stage's residual"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return bool(np.any(np.exp(p.reshape(-1, 4)[:, 1]) < 0.2))

    def size(self, data: FitData) -> float:
        """Natural scale of a share."""
        return 0.2

    def at(self) -> ActsOn:
        return ActsOn.DYNAMICS

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return modal_parameters(data, len(self.found), self.size(data), self.at())

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        if not self.found:
            return []
        p = np.concatenate([[math.log(m.f_hz), math.log(m.damping), m.share, m.rate] for m in self.found])
        return [[p]]

    def driving(self, fit: ModelFit) -> FloatArray | None:
        """(n,) signal that drives these modes, or None if it was not recorded."""
        return fit.signals.static_um[:: fit.model.substeps]

    def with_modes_of(self, fit: ModelFit) -> Modes:
        """The same cause with the modes in the residual of ``fit``."""
        data = fit.model.data
        x = self.driving(fit)
        if x is None or not data.input_is_linear:
            return replace(self, found=())
        return replace(self, found=tuple(peaks(x, fit.residual_um, data.dt_s, MOST)))

    def added_motion(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, data: FitData, system: Dynamics
    ) -> FloatArray | None:
        return modal_response(static_um, p, data, system)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Frequency and damping of the strongest mode, then of the others by frequency."""
        rows = p.reshape(-1, 4)
        f, z = np.exp(rows[:, 0]), np.exp(rows[:, 1])
        height = np.hypot(rows[:, 2], rows[:, 3]) / z
        order = [int(np.argmax(height))]
        order += [int(i) for i in np.argsort(f) if int(i) != order[0]]
        out: dict[str, tuple[float, FloatArray]] = {}
        for rank, i in enumerate(order):
            one, two = np.zeros(p.size), np.zeros(p.size)
            one[4 * i], two[4 * i + 1] = f[i], z[i]
            tail = "" if rank == 0 else f"_{rank + 1}"
            out[f"f0{tail}_hz"] = (float(f[i]), one)
            out[f"damping{tail}"] = (float(z[i]), two)
        return out


@dataclass(frozen=True)
class StructureModes(Modes):
    """Resonances of a structure, driven by the actuator's displacement."""

    name: str = "resonance"
    unseen_is_absent: bool = True
    fast: bool = True


@dataclass(frozen=True)
class CrossModes(Modes):
    """Cross-talk from the voltages of other axes, through modes of its own."""

    name: str = "cross_talk"
    unseen_is_absent: bool = True
    #: For each mode the index of the voltage that drives it.
    driven_by: tuple[int, ...] = ()

    def at(self) -> ActsOn:
        return ActsOn.MOTION

    def size(self, data: FitData) -> float:
        swings = [float(np.ptp(u)) for u in _others(data)]
        return 0.2 * data.range_um / max(*swings, 1e-9) if swings else 1.0

    def with_modes_of(self, fit: ModelFit) -> Modes:
        data = fit.model.data
        if not data.input_is_linear:
            return replace(self, found=(), driven_by=())
        found: list[Mode] = []
        driven_by: list[int] = []
        for which, u in enumerate(_others(data)):
            more = peaks(u, fit.residual_um, data.dt_s, MOST)
            found += more
            driven_by += [which] * len(more)
        return replace(self, found=tuple(found), driven_by=tuple(driven_by))

    def added_motion(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, data: FitData, system: Dynamics
    ) -> FloatArray | None:
        return None

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        out, rows = x_um, p.reshape(-1, 4)
        for which, u in enumerate(_others(data)):
            mine = np.flatnonzero(np.array(self.driven_by) == which)
            if mine.size:
                out = out + modal_response(u, np.ascontiguousarray(rows[mine]), data, Dynamics())
        return out

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Static cross-talk relative to this axis' gain, then the modes."""
        row = np.zeros(p.size)
        row[2::4] = np.where(np.array(self.driven_by) == 0, 1.0 / data.gain_um_per_V, 0.0)
        return {"static": (float(row @ p), row)} | super().reported(p, data)


def _others(data: FitData) -> list[FloatArray]:
    """Recorded voltages of the other axes."""
    return [u for u in (data.u2_V, data.u3_V) if u is not None]
