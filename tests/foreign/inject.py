"""Put one known effect into a measured record, to ask a diagnosis for it. Shares nothing with ``sim``.

Times are in s, voltages in V, displacements in µm; every column is (n,) at a uniform sample time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

FloatArray = NDArray[np.float64]

LAGS = ("amplifier_lag", "delay", "sensor_lag")
#: Effect to the names by which a diagnosis may call it.
ACCEPTED: dict[str, tuple[str, ...]] = {
    "gain_drift": ("gain_drift",),
    "thermal_line": ("thermal_drift",),
    "thermal_exponential": ("thermal_drift",),
    "thermal_walk": ("thermal_drift",),
    "creep": ("creep",),
    "mains_hum": ("mains_hum",),
    "slips": ("timing",),
    "clock": ("timing",),
    "quantisation": ("quantisation",),
    "clipped_reading": ("saturation",),
    "bow": ("sensor_nonlinearity", "asymmetry"),
    "sensor_lag": LAGS,
    "delay": LAGS,
    "amplifier_lag": LAGS,
    "resonance": ("resonance", "payload_change"),
}
#: Effects that act before the readings: what they add cannot be measured against a noise floor.
ON_TIME_OR_VOLTAGE = ("slips", "clock", "amplifier_lag")


def lagged(x: FloatArray, tau_s: float, dt_s: float) -> FloatArray:
    """First-order low-pass, settled at the start."""
    a = np.exp(-dt_s / tau_s)
    return np.asarray(lfilter([1 - a], [1, -a], x - x[0]) + x[0])


def with_creep(y_um: FloatArray, per_decade: float, dt_s: float) -> FloatArray:
    """The readings plus ``per_decade`` times the sum of their increments times log10(1 + age / 0.1 s)."""
    n = y_um.size
    kernel, steps = np.log10(1 + np.arange(n) * dt_s / 0.1), np.diff(y_um, prepend=y_um[:1])
    size = 1 << int(np.ceil(np.log2(2 * n)))
    return np.asarray(y_um + per_decade * np.fft.irfft(np.fft.rfft(steps, size) * np.fft.rfft(kernel, size), size)[:n])


def with_mode(y_um: FloatArray, f0_hz: float, damping: float, dt_s: float) -> FloatArray:
    """The readings through one mode in series, interpolated tenfold."""
    fine, w = 10, 2 * np.pi * f0_hz
    b, a, _ = cont2discrete(([w * w], [1, 2 * damping * w, w * w]), dt_s / fine, "zoh")
    x = np.interp(np.arange(y_um.size * fine) / fine, np.arange(y_um.size), y_um) - y_um[0]
    return np.asarray(lfilter(np.ravel(b), a, x)[::fine] + y_um[0])


def inject(
    dt_s: float, u_V: FloatArray, y_um: FloatArray, cause: str, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, dict[str, float]]:
    """Voltage and readings with the effect at a random size (both shorter where samples are lost), and its numbers.

    Raises KeyError for a cause that `ACCEPTED` lacks.
    """
    n = y_um.size
    t = np.arange(n) * dt_s
    span_s, swing_um, s = t[-1], float(np.ptp(y_um)), t / t[-1]
    middle_um = 0.5 * float(y_um.max() + y_um.min())

    def draw(low: float, high: float, signed: bool = False) -> float:
        size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        return size * float(rng.choice([-1, 1])) if signed else size

    match cause:
        case "gain_drift":
            share = draw(0.01, 0.06, True)
            return u_V, middle_um + (y_um - middle_um) * (1 + share * s), {"gain": share}
        case "thermal_line":
            um = draw(0.01, 0.05, True) * swing_um
            return u_V, y_um + um * s, {"rate_um_per_s": um / span_s}
        case "thermal_exponential":
            um, tau_s = draw(0.01, 0.05, True) * swing_um, draw(0.2, 0.8) * span_s
            added = um * (1 - np.exp(-t / tau_s))
            return u_V, y_um + added, {"rate_um_per_s": float(added[-1]) / span_s}
        case "thermal_walk":
            walk = lagged(np.cumsum(rng.standard_normal(n)), 0.05 * span_s, dt_s)
            added = draw(0.01, 0.04) * swing_um * (walk - walk[0]) / np.ptp(walk)
            return u_V, y_um + added, {"rate_um_per_s": float(added[-1]) / span_s}
        case "creep":
            share = draw(0.01, 0.03)
            return u_V, with_creep(y_um, share, dt_s), {"gain_per_decade": share}
        case "mains_hum":
            um, hz = draw(0.002, 0.02) * swing_um, float(rng.choice([50.0, 60.0]))
            hum = um * np.sin(2 * np.pi * hz * t + rng.uniform(0, 2 * np.pi))
            return u_V, y_um + hum, {"frequency_hz": hz, "amplitude_um": um}
        case "slips":
            count, keep, places = int(rng.integers(1, 4)), np.ones(n, bool), np.sort(rng.uniform(0.15, 0.85, 2))
            speed = np.abs(np.gradient(u_V))
            moving = np.flatnonzero(speed > 0.2 * speed.max())
            for place in places:
                at = int(moving[np.argmin(np.abs(moving - place * n))])
                keep[at : at + count] = False
            y_um = y_um[keep]
            return u_V[: y_um.size], y_um, {"lost_samples": 2.0 * count}
        case "clock":
            share = draw(2e-4, 2e-3, True)
            ok = t * (1 + share) <= t[-1]
            return u_V[ok], np.interp(t[ok] * (1 + share), t, y_um), {"clock_ppm": 1e6 * share}
        case "quantisation":
            um = draw(0.005, 0.02) * swing_um
            return u_V, np.round(y_um / um) * um, {"step_um": um}
        case "clipped_reading":
            um = float(y_um.max()) - draw(0.03, 0.15) * swing_um
            return u_V, np.minimum(y_um, um), {"y_max_um": um}
        case "bow":
            um = draw(0.01, 0.04, True) * swing_um
            return u_V, y_um + um * ((y_um - middle_um) / (0.5 * swing_um)) ** 2, {"bow_um": um}
        case "sensor_lag":
            tau_s = draw(1.0, 8.0) * dt_s
            return u_V, lagged(y_um, tau_s, dt_s), {"tau_s": tau_s}
        case "delay":
            late_s = int(rng.integers(2, 8)) * dt_s
            return u_V, np.interp(t - late_s, t, y_um), {"tau_s": late_s}
        case "amplifier_lag":  # the voltage column leads the one that the stage saw
            tau_s = draw(1.0, 8.0) * dt_s
            return u_V + tau_s * np.gradient(u_V, t), y_um, {"tau_s": tau_s}
        case "resonance":
            hz, damping = draw(0.02, 0.15) / dt_s, draw(0.01, 0.06)
            return u_V, with_mode(y_um, hz, damping, dt_s), {"f0_hz": hz, "damping": damping}
    raise KeyError(cause)


def beyond(before_um: FloatArray, after_um: FloatArray) -> float:
    """Rms (µm) of what was added beyond a gain and an offset; both (n,)."""
    basis = np.stack([np.ones_like(before_um), before_um], axis=1)
    added = after_um - before_um
    return float(np.std(added - basis @ np.linalg.lstsq(basis, added, rcond=None)[0]))
