"""Modes of a structure side by side: each answers one drive with a share of its own (modal superposition)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics, respond_partial
from sim.diagnosis.model.measured import At, Setting, Slot

#: Least share of the residual's power that a mode explains.
LEAST = 0.004

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Mode:
    """One mode: frequency (Hz), damping ratio, and the shares of its displacement and (over omega) its velocity."""

    f_hz: float
    damping: float
    share: float
    rate: float


def modal_response(x: FloatArray, p: FloatArray, setting: Setting, system: Dynamics) -> FloatArray:
    """Sum of modes driven by ``x`` (n,); ``p`` holds log f, log damping, share and rate of each."""
    poles: list[complex] = []
    residues: list[complex] = []
    for log_f, log_z, share, rate in p.reshape(-1, 4):
        w, z = 2.0 * math.pi * math.exp(float(log_f)), min(math.exp(float(log_z)), 0.95)
        damped = w * math.sqrt(1.0 - z * z)
        pole = complex(-z * w, damped)
        # (share w² + rate w s) / ((s - pole)(s - conj(pole)))
        poles.append(pole)
        residues.append((share * w * w + rate * w * pole) / (2.0j * damped))
    return respond_partial(x, poles, residues, system.delay_s, system.hold, setting.dt_s)


def modal_slots(setting: Setting, count: int, size: float, at: At) -> tuple[Slot, ...]:
    """Four numbers a mode. ``size`` is the natural scale of a share."""
    top = 0.49 / setting.dt_s
    out: list[Slot] = []
    for i in range(1, count + 1):
        out += [
            Slot(f"log_f{i}", "1", math.log(0.2 * top), math.log(2e-3 * top), math.log(top), 2e-3, at),
            Slot(f"log_damping{i}", "1", math.log(0.02), math.log(1e-3), math.log(0.5), 0.1, at),
            Slot(f"share{i}", "1", 0.0, -50.0 * size, 50.0 * size, 0.05 * size, at),
            Slot(f"rate{i}", "1", 0.0, -50.0 * size, 50.0 * size, 0.05 * size, at),
        ]
    return tuple(out)


def peaks(x: FloatArray, residual_um: FloatArray, dt_s: float, most: int) -> list[Mode]:
    """Modes by which ``x`` would explain the residual, strongest first, in the frequency domain.

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
        width = max(3, round(8.0 / spacing))
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
