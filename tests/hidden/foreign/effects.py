"""One implementation of every cause of the catalogue, with formulas of its own. Time constants in s, lengths in µm.

Signals are arrays (n,) on a fine grid of ``fs`` Hz, several times the sample rate of the recording.
"""

from __future__ import annotations

import numpy as np
from scipy import signal
from scipy.special import erfc

from tests.hidden.foreign.bases import Array, loop

# Between the command and the actuator --------------------------------------------------------------------------------


def saturation(u_V: Array, top_V: float, knee_V: float) -> Array:
    """A supply rail with a soft knee: the voltage bends into ``top_V`` within a few ``knee_V``."""
    return np.asarray(top_V - knee_V * np.logaddexp(0.0, (top_V - u_V) / knee_V))


@loop
def _current_limited(u: Array, rate: float, dt: float) -> Array:  # pragma: no cover - compiled
    out = np.empty_like(u)
    v = u[0]
    # The limited amplifier follows with a loop of two steps: far from its goal at full rate, near it as a lag.
    reach = rate * 2.0 * dt
    for k in range(u.shape[0]):
        out[k] = v
        v += dt * rate * np.tanh((u[k] - v) / reach)
    return out


def slew_limit(u_V: Array, rate_V_per_s: float, fs: float) -> Array:
    """An amplifier whose current is limited: |du/dt| <= ``rate_V_per_s``."""
    return np.asarray(_current_limited(np.ascontiguousarray(u_V), rate_V_per_s, 1.0 / fs))


def first_order(x: Array, tau_s: float, fs: float, held: bool = False) -> Array:
    """A lag that starts settled, exact for an input that is linear between the points of the grid, or ``held``."""
    b, a, _ = signal.cont2discrete(([1.0], [tau_s, 1.0]), 1.0 / fs, method="zoh" if held else "foh")
    b = np.ravel(b)
    return np.asarray(signal.lfilter(b, a, x, zi=signal.lfilter_zi(b, a) * x[0])[0])


# Hysteresis ----------------------------------------------------------------------------------------------------------


def rate_dependence(x: Array, w: Array, per_decade: float, corner_per_s: float, fs: float) -> Array:
    """A loop that widens with a power of the rate: (1 + |dx/dt| / corner)^p, filtered over 5 ms.

    ``per_decade`` is the growth from ten to a hundred times the corner rate, relative to the loop at rest.
    """
    rate = first_order(np.abs(np.gradient(x)) * fs, 0.005, fs)
    # (100)^p - (10)^p = per_decade, by Newton's method from p of a logarithm.
    p = per_decade / np.log(10.0)
    for _ in range(20):
        high, low = 101.0**p, 11.0**p
        p -= (high - low - per_decade) / (high * np.log(101.0) - low * np.log(11.0))
    return np.asarray(x - (x - w) * (1.0 + rate / corner_per_s) ** p)


@loop
def _direction(x: Array, width: float) -> Array:  # pragma: no cover - compiled
    out = np.empty_like(x)
    d = 1.0
    for k in range(x.shape[0]):
        if k > 0:
            d += 2.0 * (x[k] - x[k - 1]) / width
            d = min(1.0, max(-1.0, d))
        out[k] = d
    return out


def branch_curvature(x: Array, share: float, width: float = 0.15) -> Array:
    """What makes a loop egg-shaped: a bow, and a loop that is wider above the middle than below it.

    Both change their sign when the loop is turned about its centre, so no symmetric loop holds them. The largest
    value is about ``share``. After a reversal the branch changes over ``width`` of the range.
    """
    d = _direction(np.ascontiguousarray(x), width)
    return np.asarray(share * 4.0 * x * (1.0 - x) * (0.75 + 1.2 * (x - 0.5) * d))


def dead_zone(w: Array, knee: float, slope: float) -> Array:
    """A gain that changes on one side: beyond ``knee`` the displacement ``w`` grows by ``slope`` more."""
    return np.asarray(slope * np.maximum(w - knee, 0.0))


# Mechanics -----------------------------------------------------------------------------------------------------------


@loop
def _oscillator(x: Array, w2: Array, damping: Array, dt: float, held: bool) -> Array:  # pragma: no cover - compiled
    """q'' + 2 z w q' + w² q = w² x by the trapezoidal rule; ``w2`` (n,): square of the pre-warped frequency."""
    out = np.empty_like(x)
    q, v = x[0], 0.0
    half = 0.5 * dt
    for k in range(x.shape[0]):
        s, c = w2[k], 2.0 * damping[k] * np.sqrt(w2[k])
        before = x[max(k - 1, 0)]
        drive = s * (2.0 * before if held else x[k] + before)
        # v+ = v + half (drive - s (q + q+) - c (v + v+)), q+ = q + half (v + v+)
        new = (v * (1.0 - half * c - half * half * s) + half * drive - 2.0 * half * s * q) / (
            1.0 + half * c + half * half * s
        )
        q += half * (v + new)
        v = new
        out[k] = q
    return out


def _warped(f_hz: Array | float, fs: float) -> Array:
    return np.asarray((2.0 * fs * np.tan(np.pi * np.asarray(f_hz) / fs)) ** 2)


def modes(x: Array, f_hz: list[float], damping: list[float], shares: list[float], fs: float) -> Array:
    """Modes side by side, with shares of the static displacement that sum to 1."""
    out = np.zeros_like(x)
    for f, z, share in zip(f_hz, damping, shares, strict=True):
        w2 = np.full(x.size, float(_warped(f, fs)))
        out += share * _oscillator(np.ascontiguousarray(x), w2, np.full(x.size, z), 1.0 / fs, False)
    return out


def loaded_mode(
    x: Array, f_hz: float, damping: float, ratio: float, from_sample: int, fs: float, held: bool = False
) -> Array:
    """A mode whose moving mass grows by ``ratio`` at a sample. The dashpot stays: the damping ratio falls as f does."""
    slower = 1.0 / np.sqrt(1.0 + ratio)
    late = np.arange(x.size) >= from_sample
    w2 = _warped(np.where(late, f_hz * slower, f_hz), fs)
    z = np.where(late, damping * slower, damping)
    return np.asarray(_oscillator(np.ascontiguousarray(x), w2, z, 1.0 / fs, held))


def delayed(x: Array, tau_s: float, fs: float) -> Array:
    """The signal ``tau_s`` later, a whole number of steps of the fine grid."""
    steps = round(tau_s * fs)
    return np.concatenate([np.full(steps, x[0]), x[: x.size - steps]])


# Motion --------------------------------------------------------------------------------------------------------------


def creep_law(t_s: Array, share: float, power: float, knee_s: float = 0.05) -> Array:
    """Response to a unit step beyond the step itself: share ((1 + t / knee)^power - 1)."""
    return np.asarray(share * ((1.0 + t_s / knee_s) ** power - 1.0))


def creep(y_um: Array, share: float, power: float, fs: float) -> Array:
    """What a power law adds to ``y_um``: every increment goes on creeping (convolution with `creep_law`)."""
    law = creep_law(np.arange(y_um.size) / fs, share, power)
    increments = np.diff(y_um, prepend=y_um[:1])
    return np.asarray(signal.fftconvolve(increments, law)[: y_um.size])


def thermal_drift(t_s: Array, total_um: float, tau_s: float) -> Array:
    """Heat that reaches the stage through a thick wall: erfc(sqrt(tau / t)), ``total_um`` at the end."""
    rise = erfc(np.sqrt(tau_s / np.maximum(t_s, 1e-9)))
    return np.asarray(total_um * rise / rise[-1])


def gain_drift(t_s: Array, total: float) -> Array:
    """Relative change of the gain over the record, slow at first (power 1.3), ``total`` at the end."""
    return np.asarray(total * (t_s / t_s[-1]) ** 1.3)


@loop
def _dahl(y: Array, reach: float) -> Array:  # pragma: no cover - compiled
    out = np.empty_like(y)
    z = 0.0
    for k in range(y.shape[0]):
        if k > 0:
            move = y[k] - y[k - 1]
            if move != 0.0:
                sign = 1.0 if move > 0.0 else -1.0
                # dz = (1 - sign z / reach) dy / 2, exact over the move: right after a reversal dz = dy, all sticks.
                z = sign * reach + (z - sign * reach) * np.exp(-0.5 * abs(move) / reach)
        out[k] = y[k] - z
    return out


def stick_slip(y_um: Array, reach_um: float) -> Array:
    """Dahl's friction: after a reversal the stage sticks, and slides ``reach_um`` behind soon after."""
    return np.asarray(_dahl(np.ascontiguousarray(y_um), reach_um))


# Reading -------------------------------------------------------------------------------------------------------------


def sensor_nonlinearity(y_um: Array, share: float, range_um: float) -> Array:
    """Error of a capacitive sensor's linearisation: a bow, and a fainter wave, over its range."""
    s = y_um / range_um
    return np.asarray(share * range_um * (np.sin(np.pi * s) + 0.3 * np.sin(2.0 * np.pi * s)))


def mains_hum(t_s: Array, f_hz: float, amplitude_um: float) -> Array:
    """The line and its second and third harmonic."""
    turn = 2.0 * np.pi * f_hz * t_s
    return np.asarray(amplitude_um * (np.sin(turn + 0.7) + 0.1 * np.sin(2 * turn) + 0.25 * np.cos(3 * turn + 0.3)))


def quantisation(y_um: Array, step_um: float) -> Array:
    """A converter that truncates, with half a step added."""
    return np.asarray(step_um * (np.floor(y_um / step_um) + 0.5))


def slips(y_um: Array, at: Array, lost: Array) -> Array:
    """A column that loses (``lost`` = 1) or doubles (-1) the sample at ``at`` and goes on; its length is kept."""
    keep = np.ones(y_um.size, dtype=np.int64)
    keep[at.astype(np.int64)] = np.where(lost > 0, 0, 2)
    out = np.repeat(y_um, keep)[: y_um.size]
    return np.pad(out, (0, y_um.size - out.size), mode="edge")
