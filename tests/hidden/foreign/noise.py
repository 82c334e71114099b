"""Sensor noise of known standard deviation: white, correlated over a time, and pink."""

from __future__ import annotations

import numpy as np
from scipy import signal

from tests.hidden.foreign.bases import Array

KINDS = ("white", "correlated", "pink")
#: Time over which the correlation of `correlated` noise falls to 1/e.
MEMORY_S = 0.05
#: Below this frequency pink noise is flat: a longer record would have more of it.
PINK_FROM_HZ = 0.05


def correlated(n: int, dt_s: float, rng: np.random.Generator) -> Array:
    """(n,) unit-variance noise of first order whose correlation is exp(-t / MEMORY_S), from its first sample on."""
    keep = float(np.exp(-dt_s / MEMORY_S))
    drive = rng.standard_normal(n)
    start = [keep * rng.standard_normal()]
    return np.asarray(signal.lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], drive, zi=start)[0])


def pink(n: int, dt_s: float, rng: np.random.Generator) -> Array:
    """(n,) noise whose power falls with 1/f above PINK_FROM_HZ; its mean square over many records is 1."""
    size = 2 * n
    f = np.fft.rfftfreq(size, dt_s)
    amplitude = 1.0 / np.sqrt(np.maximum(f, PINK_FROM_HZ))
    amplitude[0] = 0.0
    # Power of the circular sequence: every bin but the outermost stands for two frequencies.
    power = 2.0 * float(np.sum(amplitude[1:-1] ** 2)) + float(amplitude[-1] ** 2)
    spectrum = amplitude * np.fft.rfft(rng.standard_normal(size))
    # White noise of unit variance has the power `size` in every bin of the transform.
    return np.asarray(np.fft.irfft(spectrum, size)[:n] * np.sqrt(size / power))


def noise(kind: str, n: int, dt_s: float, sigma_um: float, rng: np.random.Generator) -> Array:
    """(n,) noise with standard deviation ``sigma_um``. For pink noise the variance includes what lies below 1/T."""
    match kind:
        case "white":
            unit = rng.standard_normal(n)
        case "correlated":
            unit = correlated(n, dt_s, rng)
        case "pink":
            unit = pink(n, dt_s, rng)
        case _:
            raise ValueError(f"noise: got {kind!r}, expected one of {', '.join(KINDS)}")
    return sigma_um * unit
