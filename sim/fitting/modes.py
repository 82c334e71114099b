"""Modes that are added to a motion, found in the spectrum of a residual: what structures and other axes do."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.dynamics import Dynamics, respond_partial
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess, ModelFit

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

    def found_again(self, fit: ModelFit, mask: BoolArray) -> Modes:
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
