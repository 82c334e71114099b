"""The stage that carries the hidden effects: Bouc-Wen (2.1), (2.2) by Runge-Kutta, or 40 plays, at 16 kHz."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import signal
from scipy.interpolate import CubicSpline

from tests.hidden.excitation import FS_HZ, Array

OVER = 8
FINE_HZ = FS_HZ * OVER


@dataclass
class Truth:
    """What is really there. ``effects`` maps a cause's name to its magnitude(s)."""

    seed: int
    hysteresis: str = "bouc_wen"
    noise_um: float = 0.005
    effects: dict[str, dict[str, float]] = field(default_factory=dict)


def _bouc_wen(u: Array, d: float, alpha: float, beta: float, gamma: float) -> Array:
    """h over u: dh = (alpha d - beta sgn(du) h - gamma |h|) du, classical Runge-Kutta along u, two steps a move."""
    h, out, previous = 0.0, np.empty_like(u), float(u[0])
    for k, now in enumerate(u.tolist()):
        du = now - previous
        if du != 0.0:
            sign = 1.0 if du > 0.0 else -1.0
            count = max(2, int(abs(du) / 0.02) + 1)
            step = du / count
            for _ in range(count):
                k1 = alpha * d - beta * sign * h - gamma * abs(h)
                x = h + 0.5 * step * k1
                k2 = alpha * d - beta * sign * x - gamma * abs(x)
                x = h + 0.5 * step * k2
                k3 = alpha * d - beta * sign * x - gamma * abs(x)
                x = h + step * k3
                k4 = alpha * d - beta * sign * x - gamma * abs(x)
                h += step * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
            previous = now
        out[k] = h
    return out


def _plays(u: Array, d: float, rng: np.random.Generator) -> Array:
    """What 40 plays with decaying weights hold back, so that the loop is 12 % wide at full stroke."""
    radii = np.linspace(0.05, 6.0, 40)
    weights = np.exp(-radii / rng.uniform(1.2, 2.0))
    weights *= 0.32 * d / weights.sum()
    state = np.zeros(40)
    out = np.empty_like(u)
    previous, held = None, 0.0
    for k, now in enumerate(u.tolist()):
        if now != previous:
            state = np.minimum(np.maximum(state, now - radii), now + radii)
            held, previous = float(weights @ (now - state)), now
        out[k] = held
    return out


def _first_order(x: Array, f_hz: float) -> Array:
    b, a = signal.bilinear([1.0], [1.0 / (2.0 * np.pi * f_hz), 1.0], FINE_HZ)
    zi = signal.lfilter_zi(b, a) * x[0]
    return np.asarray(signal.lfilter(b, a, x, zi=zi)[0])


def _mode(x: Array, f_hz: float, damping: float) -> Array:
    """A unit-gain mode by the bilinear transform, pre-warped at its own frequency."""
    w = 2.0 * FINE_HZ * np.tan(np.pi * f_hz / FINE_HZ)
    b, a = signal.bilinear([w * w], [1.0, 2.0 * damping * w, w * w], FINE_HZ)
    zi = signal.lfilter_zi(b, a) * x[0]
    return np.asarray(signal.lfilter(b, a, x, zi=zi)[0])


def _creep(y: Array, gain: float, t0_s: float = 0.1) -> Array:
    """y0 (1 + g log10(1 + t/t0)) for every increment: the law itself, as a convolution, at the sample rate."""
    law = gain * np.log10(1.0 + np.arange(y.size) / FS_HZ / t0_s)
    increments = np.diff(y, prepend=y[:1])
    return y + signal.fftconvolve(increments, law)[: y.size]


def _friction(y: Array, width_um: float) -> Array:
    half, at = width_um / 2.0, float(y[0])
    out = np.empty_like(y)
    for k, value in enumerate(y.tolist()):
        at = min(max(at, value - half), value + half)
        out[k] = at
    return out


def _slew(u: Array, rate: float) -> Array:
    step, at, out = rate / FINE_HZ, float(u[0]), np.empty_like(u)
    for k, value in enumerate(u.tolist()):
        at += min(max(value - at, -step), step)
        out[k] = at
    return out


def record(truth: Truth, u_V: Array, u2_V: Array) -> dict[str, Array]:
    """The columns of a recording of this stage: t_s, u_V, y_um, u2_V, y2_um."""
    rng = np.random.default_rng([truth.seed, 7])
    effects = truth.effects
    n = u_V.size
    d = 11.351 * rng.uniform(0.92, 1.05)
    u = np.repeat(u_V, OVER)
    if "saturation" in effects:
        u = np.minimum(u, effects["saturation"]["top_V"])
    if "slew_limit" in effects:
        u = _slew(u, effects["slew_limit"]["rate_V_per_s"])
    if "amplifier_lag" in effects:
        u = _first_order(u, effects["amplifier_lag"]["f_Hz"])
    if truth.hysteresis == "bouc_wen":
        beta, gamma = rng.uniform(0.8, 0.95), rng.uniform(0.9, 1.02)
        h = _bouc_wen(u, d, rng.uniform(0.42, 0.50), beta, gamma)
    else:
        h = _plays(u, d, rng)
    if "rate_dependence" in effects:
        rate = np.abs(np.gradient(u)) * FINE_HZ
        rate = _first_order(rate, 15.0)
        h = h * (1.0 + effects["rate_dependence"]["per_decade"] * np.log10(1.0 + np.maximum(rate, 0.0) / 3.0))
    if "asymmetry" in effects:
        top = np.max(np.abs(h))
        h = h + effects["asymmetry"]["share"] * d * np.max(u) * (h / top) ** 2
    y = _first_order(d * u - h, 1.0 / (2.0 * np.pi * 2.527e-3 * rng.uniform(0.9, 1.1)))
    if "resonance" in effects:
        y = _mode(y, effects["resonance"]["f_Hz"], effects["resonance"]["damping"])
    late_s = effects["delay"]["tau_s"] if "delay" in effects else 0.0
    if late_s > 0.0:
        fine = np.arange(y.size) / FINE_HZ
        y = np.interp(fine - late_s, fine, y)
    # read just before the next voltage is applied, or up to one sample later: recorders differ
    y = y[::OVER] if truth.seed % 3 else np.concatenate([y[: OVER // 2], y])[:-OVER:OVER]
    if "creep" in effects:
        y = _creep(y, effects["creep"]["per_decade"])
    t = np.arange(n) / FS_HZ
    y2 = 10.8 * u2_V - 1.1 * np.sign(np.gradient(u2_V)) * (u2_V > 0.0)
    y2 = np.asarray(signal.lfilter(*signal.butter(1, 60.0, fs=FS_HZ), y2))
    if "cross_talk" in effects:
        y = y + effects["cross_talk"]["share"] * np.interp(t - late_s, t, y2)
    if "stick_slip" in effects:
        y = _friction(y, effects["stick_slip"]["width_um"])
    if "gain_drift" in effects:
        y = y * (1.0 + effects["gain_drift"]["total"] * t / t[-1])
    if "thermal_drift" in effects:
        tau = effects["thermal_drift"]["tau_s"]
        y = y + effects["thermal_drift"]["total_um"] * (1.0 - np.exp(-t / tau))
    if "sensor_nonlinearity" in effects:
        s = y / 90.0
        y = y + effects["sensor_nonlinearity"]["share"] * 90.0 * 4.0 * s * (1.0 - s) * (1.0 - 0.4 * s)
    noise = truth.noise_um * rng.standard_normal(n)
    if "sensor_lag" in effects:
        fine = np.repeat(y + noise * 1.0, OVER)
        y, noise = _first_order(fine, effects["sensor_lag"]["f_Hz"])[OVER - 1 :: OVER], np.zeros(n)
    y = y + noise
    if "mains_hum" in effects:
        f = effects["mains_hum"]["f_Hz"]
        a = effects["mains_hum"]["amplitude_um"]
        y = y + a * np.sin(2 * np.pi * f * t + 0.4) + 0.35 * a * np.sin(2 * np.pi * 3 * f * t + 1.1)
    if "quantisation" in effects:
        q = effects["quantisation"]["step_um"]
        y = q * np.round(y / q)
    y2 = y2 + truth.noise_um * rng.standard_normal(n)
    columns = {"t_s": t, "u_V": u_V.copy(), "y_um": y, "u2_V": u2_V.copy(), "y2_um": y2}
    if "timing" in effects:
        columns = _timing(columns, effects["timing"], rng)
    return columns


def _timing(columns: dict[str, Array], what: dict[str, float], rng: np.random.Generator) -> dict[str, Array]:
    """A clock that runs wrong by some ppm, or samples lost and doubled on the way of the sensor's column."""
    y, t = columns["y_um"], columns["t_s"]
    if "ppm" in what:
        # A sensor's clock samples the motion itself: a spline, because straight lines between samples would show.
        columns["y_um"] = CubicSpline(t, y)(np.minimum(t * (1.0 + 1e-6 * what["ppm"]), t[-1]))
        return columns
    for at in np.sort(rng.integers(2000, y.size - 2000, int(what["dropped"])))[::-1]:
        y = np.concatenate([y[:at], y[at + 1 :], y[-1:]])
    columns["y_um"] = y
    return columns
