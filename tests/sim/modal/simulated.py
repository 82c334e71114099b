"""Simulated stages with several modes, stepped in time. No formula is shared with the fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

from dehyst.adaptive.types import FloatArray


def orthogonal_multisines(
    rng: np.random.Generator, samples: int, drives: int, blocks: int, lines: FloatArray, rms_V: float
) -> FloatArray:
    """(samples, drives, blocks * drives): random phases, and within a block the columns of a Fourier matrix."""
    fourier = np.exp(2j * np.pi * np.outer(np.arange(drives), np.arange(drives)) / drives)
    u = np.empty((samples, drives, blocks * drives))
    for block in range(blocks):
        phases = np.exp(2j * np.pi * rng.random((lines.size, drives)))
        for j in range(drives):
            spectrum = np.zeros((samples // 2 + 1, drives), dtype=complex)
            spectrum[lines] = phases * fourier[j]
            u[:, :, block * drives + j] = np.fft.irfft(spectrum, n=samples, axis=0)
    return rms_V * u / np.sqrt(np.mean(u**2))


def chain(
    frequencies_hz: FloatArray, dampings: FloatArray, shapes: FloatArray, forces: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Discrete A, B, C of uncoupled modes with a held drive: shapes (p, n), forces (n, m), gain 1 at standstill."""
    n, m = forces.shape
    omega = 2.0 * np.pi * frequencies_hz
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:, :n] = -np.diag(omega**2)
    a[n:, n:] = -np.diag(2.0 * dampings * omega)
    b = np.vstack([np.zeros((n, m)), forces * omega[:, None] ** 2])
    joint = expm(np.block([[a, b], [np.zeros((m, 2 * n + m))]]) * dt_s)
    return joint[: 2 * n, : 2 * n], joint[: 2 * n, 2 * n :], np.hstack([shapes, np.zeros_like(shapes)])


def run_linear(a: FloatArray, b: FloatArray, c: FloatArray, u: FloatArray, settle: int, periods: int) -> FloatArray:
    """(samples, p, R, periods) of the drive (samples, m, R), after ``settle`` periods from rest."""
    samples, _, count = u.shape
    x = np.zeros((len(a), count))
    y = np.empty((samples, len(c), count, periods))
    for period in range(-settle, periods):
        for k in range(samples):
            if period >= 0:
                y[k, :, :, period] = c @ x
            x = a @ x + b @ u[k]
    return y


def run_oscillator(
    frequency_hz: float,
    damping: float,
    restoring: Callable[[FloatArray], FloatArray],
    u: FloatArray,
    dt_s: float,
    settle: int,
    periods: int,
    substeps: int = 16,
) -> FloatArray:
    """(samples, 1, R, periods) of ``x'' + 2ζω x' + ω² restoring(x) = ω² u`` with a held drive (samples, 1, R).

    Velocity Verlet steps; ``restoring`` is called once a step, in time order, and may keep a memory.
    """
    omega, h = 2.0 * np.pi * frequency_hz, dt_s / substeps
    samples, _, count = u.shape
    x, v = np.zeros(count), np.zeros(count)
    y = np.empty((samples, 1, count, periods))
    force = restoring(x)
    for period in range(-settle, periods):
        for k in range(samples):
            if period >= 0:
                y[k, 0, :, period] = x
            for _ in range(substeps):
                half = v + 0.5 * h * (omega**2 * (u[k, 0] - force) - 2.0 * damping * omega * v)
                x = x + h * half
                force = restoring(x)
                v = (half + 0.5 * h * omega**2 * (u[k, 0] - force)) / (1.0 + damping * omega * h)
    return y
