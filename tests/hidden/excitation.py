"""About 65 s of voltage at 2 kHz that makes most effects visible: two amplitudes, three decades of rate, rests."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

FS_HZ = 2000.0
Array = NDArray[np.float64]


def _smooth_to(start: float, stop: float, seconds: float) -> Array:
    """A raised-cosine move, so that segments join without a jump that is not meant."""
    s = np.arange(int(seconds * FS_HZ)) / (seconds * FS_HZ)
    return start + (stop - start) * 0.5 * (1.0 - np.cos(np.pi * s))


def _hold(level: float, seconds: float) -> Array:
    return np.full(int(seconds * FS_HZ), level)


def _sine(middle: float, amplitude: float, f_hz: float, seconds: float) -> Array:
    t = np.arange(int(seconds * FS_HZ)) / FS_HZ
    return middle - amplitude * np.cos(2.0 * np.pi * f_hz * t) + 0.0


def _triangles(peaks: list[float], rate_v_per_s: float) -> Array:
    corners = [0.0]
    for peak in peaks:
        corners += [peak, 0.15 * peak]
    corners.append(0.0)
    parts = [
        np.linspace(a, b, max(2, int(abs(b - a) / rate_v_per_s * FS_HZ)), endpoint=False)
        for a, b in itertools.pairwise(corners)
    ]
    return np.concatenate(parts)


def _chirp(middle: float, amplitude: float, f0_hz: float, f1_hz: float, seconds: float) -> Array:
    t = np.arange(int(seconds * FS_HZ)) / FS_HZ
    rate = np.log(f1_hz / f0_hz) / seconds
    phase = 2.0 * np.pi * f0_hz * (np.exp(rate * t) - 1.0) / rate
    window = np.minimum(1.0, np.minimum(t, seconds - t) / 0.05)
    return middle + amplitude * window * np.sin(phase)


def _chapter(seconds: float) -> Array:
    t = np.arange(int(seconds * FS_HZ)) / FS_HZ
    return 5.0 * np.exp(-0.11 * t) * (np.sin(6.0 * np.pi * t * np.exp(-0.345 * t) - 1.55) + 1.0)


def excitation(rng: np.random.Generator) -> tuple[Array, Array]:
    """Voltages of the two axes, V; order of segments and levels vary a little with the seed."""
    levels = rng.permutation([2.0, 6.5, 4.0, 7.8]) + rng.uniform(-0.2, 0.2, 4)
    parts: list[Array] = [_hold(0.0, 3.0)]
    for level in levels:
        parts.append(_hold(float(level), 3.5))
    parts += [_hold(0.0, 4.0), _triangles([8.0, 6.0, 4.0, 2.0], 12.0), _hold(0.0, 1.0)]
    at = 0.0
    for f_hz, amplitude, seconds in (
        (1.0, 3.6, 3.0),
        (5.0, 3.6, 1.6),
        (20.0, 3.0, 1.0),
        (2.0, 1.2, 2.0),
        (10.0, 1.2, 1.0),
    ):
        middle = 4.0
        parts += [_smooth_to(at, middle - amplitude, 0.4), _sine(middle, amplitude, f_hz, seconds)]
        at = middle - amplitude
    parts += [_smooth_to(at, 4.0, 0.5), _chirp(4.0, 0.25, 5.0, 900.0, 5.0), _smooth_to(4.0, 0.0, 0.5), _hold(0.0, 2.0)]
    parts += [_chapter(10.0)]
    parts += [_smooth_to(float(parts[-1][-1]), 0.0, 0.4), _hold(0.0, 3.0)]
    u_V = np.concatenate(parts)
    other = np.concatenate([_hold(0.0, 0.5), _sine(3.0, 3.0, 2.0, 3.0), _hold(0.0, 2.5)])
    u2_V = np.concatenate([np.zeros_like(u_V), other])
    u_V = np.concatenate([u_V, np.zeros_like(other)])
    tail = int(65.0 * FS_HZ) - u_V.size
    if tail > 0:
        u_V, u2_V = np.pad(u_V, (0, tail)), np.pad(u2_V, (0, tail))
    return u_V, u2_V
