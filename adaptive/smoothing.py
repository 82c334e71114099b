"""Displacement, velocity and acceleration from noisy samples: fixed-lag online, zero-phase offline.

The chapter smooths with a zero-phase 50 Hz low-pass, which needs future samples. Online, a Kalman filter of a chain of
``order`` integrators driven by white noise, read ``lag`` samples late, replaces it. With process noise
q = r dt w_c^(2 order) the two-sided smoother of that model is 1 / (1 + (w / w_c)^(2 order)): the squared
Butterworth response that ``filtfilt`` has, so the cut-off frequency is its only tuning.

The filter starts with its steady-state prior covariance, so its gains are constant from the first sample and the
smoother is a fixed linear recursion, equal to Rauch-Tung-Striebel on the same samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from math import factorial, pi

import numpy as np
from scipy.linalg import solve_discrete_are

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray

#: Outputs of the smoother: displacement, velocity, acceleration.
OUTPUTS = 3


@dataclass(frozen=True, slots=True)
class SmootherConfig:
    """dt_s: sample time, s. cutoff_hz: half-amplitude frequency, Hz. lag: samples of delay. order: integrators."""

    dt_s: float
    cutoff_hz: float = 80.0
    lag: int = 16
    order: int = 4

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise InputError(f"dt_s: got {self.dt_s}, expected a positive sample time in s")
        nyquist_hz = 0.5 / self.dt_s
        if not 1e-3 * nyquist_hz <= self.cutoff_hz <= 0.9 * nyquist_hz:
            raise InputError(
                f"cutoff_hz: got {self.cutoff_hz}, expected {1e-3 * nyquist_hz:g} to {0.9 * nyquist_hz:g} Hz at"
                f" dt_s = {self.dt_s}; choose a cut-off above the motion's band and below half the sample rate"
            )
        if not 0 <= self.lag <= 10_000:
            raise InputError(f"lag: got {self.lag}, expected 0 to 10000 samples")
        if not OUTPUTS <= self.order <= 6:
            raise InputError(f"order: got {self.order}, expected 3 to 6 integrators")

    @classmethod
    def for_rate(cls, dt_s: float, cutoff_hz: float = 80.0) -> SmootherConfig:
        """A cut-off that suits the sample rate, and a lag of 1.3 periods of it; a longer lag gains nothing."""
        cutoff = min(cutoff_hz, 0.2 / dt_s)
        return cls(dt_s=dt_s, cutoff_hz=cutoff, lag=max(4, round(1.3 / (cutoff * dt_s))))


@compiled
def smooth_one(
    y: float, count: int, x: FloatArray, ring: FloatArray, f: FloatArray, k: FloatArray, g: FloatArray, out: FloatArray
) -> None:
    """One sample: out (3,) is the smoothed state ``lag`` samples ago (sample units); x, ring change in place."""
    depth = ring.shape[0]
    n = x.shape[0]
    slot = count % depth
    innovation = y - x[0]
    ring[slot, 0] = innovation
    for i in range(3):
        ring[slot, 1 + i] = x[i]
    for i in range(n):
        x[i] += k[i] * innovation
    for i in range(n):  # F is upper triangular with a unit diagonal: ascending order works in place
        s = 0.0
        for j in range(i, n):
            s += f[i, j] * x[j]
        x[i] = s
    old = (count + 1) % depth
    for i in range(3):
        s = ring[old, 1 + i]
        for j in range(depth):
            s += g[j, i] * ring[(old + j) % depth, 0]
        out[i] = s


@compiled
def _run(y: FloatArray, x: FloatArray, ring: FloatArray, f: FloatArray, k: FloatArray, g: FloatArray) -> FloatArray:
    n = y.shape[0]
    out = np.empty((n, 3))
    for i in range(n):
        smooth_one(y[i], i, x, ring, f, k, g, out[i])
    return out


@dataclass(frozen=True)
class FixedLagSmoother:
    """Exact steady-state fixed-lag smoother (Anderson and Moore, Optimal Filtering, 1979, ch. 7).

    x(k-L | k) = x(k-L | k-L-1) + sum_j G_j e(k-L+j), G_j = P (A')^j h / S, A = F (I - K h'), j = 0 .. L,
    with P the *prior* covariance and e the innovations.
    """

    config: SmootherConfig
    transition: FloatArray = field(init=False, repr=False, compare=False)
    gain: FloatArray = field(init=False, repr=False, compare=False)
    lag_gains: FloatArray = field(init=False, repr=False, compare=False)
    prior: FloatArray = field(init=False, repr=False, compare=False)
    process_noise: FloatArray = field(init=False, repr=False, compare=False)
    scale: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        c = self.config
        n = c.order
        # Time in samples keeps the matrices of order one at any sample rate.
        q = (2.0 * pi * c.cutoff_hz * c.dt_s) ** (2 * n)
        f = np.array([[1.0 / factorial(j - i) if j >= i else 0.0 for j in range(n)] for i in range(n)])
        noise = np.array(
            [
                [q / ((2 * n - 1 - i - j) * factorial(n - 1 - i) * factorial(n - 1 - j)) for j in range(n)]
                for i in range(n)
            ]
        )
        h = np.eye(n)[0]
        p = np.asarray(solve_discrete_are(f.T, h[:, None], noise, np.eye(1)), dtype=np.float64)
        s = p[0, 0] + 1.0
        k = p[:, 0] / s
        a = f @ (np.eye(n) - np.outer(k, h))
        gains = np.empty((c.lag + 1, OUTPUTS))
        column = h / s
        for j in range(c.lag + 1):
            gains[j] = (p @ column)[:OUTPUTS]
            column = a.T @ column
        values = {"transition": f, "gain": k, "lag_gains": gains, "prior": p, "process_noise": noise}
        values["scale"] = c.dt_s ** -np.arange(OUTPUTS, dtype=np.float64)
        for name, value in values.items():
            value = np.ascontiguousarray(value)
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @property
    def sizes(self) -> dict[str, int]:
        """Names of the dimensions of its state, and of rings of ``lag`` + 2 ``slots``."""
        return {"order": self.config.order, "taps": self.config.lag + 1, "slots": self.config.lag + 2}

    def run(self, y_um: FloatArray) -> FloatArray:
        """(n,) samples to (n, 3) of y, v, a; row i is the estimate ``lag`` samples before i, from samples 0..i.

        The first ``lag`` rows, for which there is no such sample, are NaN.
        """
        y = _checked(y_um)
        x, ring = np.zeros(self.config.order), np.zeros((self.config.lag + 1, 1 + OUTPUTS))
        x[0] = y[0]
        out = _run(y, x, ring, self.transition, self.gain, self.lag_gains) * self.scale
        out[: self.config.lag] = np.nan
        return out


@cache
def smoother_of(config: SmootherConfig) -> FixedLagSmoother:
    """The smoother of a configuration; made once, because its gains take a millisecond, and many axes share them."""
    return FixedLagSmoother(config)


def _checked(y_um: FloatArray) -> FloatArray:
    y = np.ascontiguousarray(y_um, dtype=np.float64)
    if y.ndim != 1 or y.size < 2 or not np.all(np.isfinite(y)):
        raise InputError(f"y_um: got shape {y.shape}, expected (n,) finite values, n >= 2; drop gaps before smoothing")
    return y


def smooth_recording(y_um: FloatArray, config: SmootherConfig) -> FloatArray:
    """(n,) samples to (n, 3) of y, v, a at every sample, past the ends by odd reflection.

    The response is that of the online smoother, so that a model identified from it fits online samples.
    """
    y = _checked(y_um)
    pad = min(4 * (config.lag + 1), y.size - 1)
    padded = np.concatenate([2.0 * y[0] - y[pad:0:-1], y, 2.0 * y[-1] - y[-2 : -pad - 2 : -1]])
    lag = min(config.lag, pad)
    smoother = FixedLagSmoother(SmootherConfig(config.dt_s, config.cutoff_hz, lag, config.order))
    return np.ascontiguousarray(smoother.run(padded)[pad + lag : pad + lag + y.size])


def zero_phase_lowpass(y_um: FloatArray, dt_s: float, cutoff_hz: float = 50.0, order: int = 2) -> FloatArray:
    """The chapter's zero-phase low-pass before (2.41): Butterworth of ``order``, forwards and backwards. (n,) to (n,).

    A sample rate too low for the cut-off needs no smoothing and returns a copy.
    """
    y = _checked(y_um)
    if cutoff_hz >= 0.45 / dt_s:
        return y.copy()
    # Imported here: it is slow to import, and the serving process does not need it.
    from scipy.signal import butter, sosfiltfilt

    sos = butter(order, cutoff_hz, fs=1.0 / dt_s, output="sos")
    return np.asarray(sosfiltfilt(sos, y, padlen=min(y.size - 1, round(3.0 / (cutoff_hz * dt_s)))), dtype=np.float64)


def backward_difference(y_um: FloatArray, dt_s: float) -> FloatArray:
    """(2.41): (n,) velocity in µm/s; the first value repeats the second."""
    y = _checked(y_um)
    v = np.empty_like(y)
    v[1:] = np.diff(y) / dt_s
    v[0] = v[1]
    return v
