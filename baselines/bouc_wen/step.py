"""Exact steps of the Bouc-Wen stage, compiled; `baselines.bouc_wen.model` gives the equations and units.

**Hysteresis.** Where u is monotone, with s = |du| and q = sgn(du) h, (2.2) with n = 1 reads dq/ds = drive - (beta +
gamma sgn q) q. On each side of q = 0 this is linear with constant coefficients and solved by an exponential in s.
`hysteresis_step` is the only implementation of it: the models here and the effects in ``sim`` use it, in their units.

**Dynamics.** Two modes p1, p2 (real or a conjugate pair). With u linear within a step, the drive is a line plus an
exponential of time, whose response is closed too. Nothing is integrated numerically, so stiffness does not matter
(Table 2.1: p = -400 and -3.2e6 per s). Within 1e-5 of critical damping the modes are split by that much, which moves
the response by about 1e-10.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray

#: Below this |rate| (1/V) a line replaces the exponential of (2.2): better conditioned, and equal to 1e-8 V.
_FLAT = 1e-7


@compiled
def _grow(q: float, s: float, drive: float, rate: float) -> float:
    """Solution of dq/ds = drive - rate q after s."""
    if abs(rate) < _FLAT:
        return q + drive * s
    return q - (q - drive / rate) * -math.expm1(-rate * s)


@compiled
def crossing(q: float, drive: float, rate: float) -> float:
    """Change s of the input until q < 0 has grown to zero; infinite where it never does."""
    if abs(rate) < _FLAT:
        return -q / drive if drive > 0.0 else math.inf
    if drive <= 0.0 or -q * rate / drive <= -1.0:
        return math.inf
    return math.log1p(-q * rate / drive) / rate


@compiled
def hysteresis_step(h: float, rise: float, drive: float, beta: float, gamma: float) -> float:
    """``h`` after a monotone change ``rise`` of the input: (2.2) with n = 1, exact for any length of the step.

    The units are free: ``drive`` is in units of h per unit of input, beta and gamma in 1 per unit of input. In volts
    (h/d for h) ``drive`` is alpha; in µm it is alpha d.
    """
    s = abs(rise)
    if s == 0.0:
        return h
    sign = 1.0 if rise > 0.0 else -1.0
    q = sign * h
    if q < 0.0:
        s0 = crossing(q, drive, beta - gamma)
        if s < s0:
            return sign * _grow(q, s, drive, beta - gamma)
        q, s = 0.0, s - s0
    return sign * _grow(q, s, drive, beta + gamma)


@compiled
def _mode(z: complex, p: complex, T: float, w0: float, slope: float, c: float, rate: float) -> complex:
    """Solution of z' = p (z - w) after T, with w = w0 + slope t + c (exp(-rate t) - 1)."""
    decay = cmath.exp(p * T)
    rest = 1.0 - decay
    z = decay * z + rest * (w0 - c) + slope * (T + rest / p)
    if c != 0.0:
        gap = p + rate
        if abs(gap * T) < 1e-6:
            z -= p * c * T * decay * (1.0 - 0.5 * gap * T)
        else:
            z += p * c * (math.exp(-rate * T) - decay) / gap
    return z


@compiled
def _piece(
    state: FloatArray, p1: complex, p2: complex, T: float, ds: float, sign: float, alpha: float, rate: float
) -> None:
    """Advance ``state`` over T s of a linear-hold step, on which q keeps its sign and u changes by ``ds`` V."""
    u0, g0 = state[0], state[1]
    slope = sign * ds / T
    c = 0.0
    if abs(rate) < _FLAT:
        drive = slope * (1.0 - alpha)
    else:
        drive = slope
        c = -(g0 - sign * alpha / rate)
    rate_t = rate * ds / T
    z1 = _mode(complex(state[2], state[3]), p1, T, u0 - g0, drive, c, rate_t)
    z2 = _mode(complex(state[4], state[5]), p2, T, u0 - g0, drive, c, rate_t)
    state[2], state[3], state[4], state[5] = z1.real, z1.imag, z2.real, z2.imag
    state[0] = u0 + sign * ds
    state[1] = sign * _grow(sign * g0, ds, alpha, rate)


@compiled
def _relax(state: FloatArray, p1: complex, p2: complex, T: float) -> None:
    """Advance the modes by T s at constant voltage."""
    w = state[0] - state[1]
    z1 = _mode(complex(state[2], state[3]), p1, T, w, 0.0, 0.0, 0.0)
    z2 = _mode(complex(state[4], state[5]), p2, T, w, 0.0, 0.0, 0.0)
    state[2], state[3], state[4], state[5] = z1.real, z1.imag, z2.real, z2.imag


@compiled
def stage_step(state: FloatArray, u_V: float, p1: complex, p2: complex, T: float, shape: FloatArray) -> None:
    """Advance ``state`` (u, g, Re z1, Im z1, Re z2, Im z2) by T s, over which the voltage goes linearly to ``u_V``.

    ``shape``: alpha, beta, gamma.
    """
    alpha, beta, gamma = shape[0], shape[1], shape[2]
    s = abs(u_V - state[0])
    if s == 0.0:
        _relax(state, p1, p2, T)
        return
    sign = 1.0 if u_V > state[0] else -1.0
    q = sign * state[1]
    if q < 0.0:
        s0 = crossing(q, alpha, beta - gamma)
        if s < s0:
            _piece(state, p1, p2, T, s, sign, alpha, beta - gamma)
        else:
            share = s0 / s
            _piece(state, p1, p2, T * share, s0, sign, alpha, beta - gamma)
            state[1] = 0.0
            if s > s0:
                _piece(state, p1, p2, T * (1.0 - share), s - s0, sign, alpha, beta + gamma)
    else:
        _piece(state, p1, p2, T, s, sign, alpha, beta + gamma)
    state[0] = u_V


@compiled
def stage_output(state: FloatArray, p1: complex, p2: complex) -> float:
    """(y - y0)/d, V."""
    z1, z2 = complex(state[2], state[3]), complex(state[4], state[5])
    return ((p1 * z2 - p2 * z1) / (p1 - p2)).real


@compiled
def stage_rate(state: FloatArray, p1: complex, p2: complex) -> float:
    """y'/d, V/s."""
    z1, z2 = complex(state[2], state[3]), complex(state[4], state[5])
    return (p1 * p2 * (z2 - z1) / (p1 - p2)).real


@compiled
def run_stage(
    u_V: FloatArray,
    T: float,
    p1: complex,
    p2: complex,
    shape: FloatArray,
    linear: bool,
    state: FloatArray,
    out: FloatArray,
) -> None:
    """Write (y - y0)/d V, y'/d V/s and the drive w V of each sample to ``out`` (n, 3); ``state`` is advanced in place.

    ``u_V`` (n,) V is T s apart. ``linear``: linear hold, else zero-order hold. ``state`` is that at the instant of the
    first sample.
    """
    for k in range(u_V.size):
        if k > 0:
            if linear:
                stage_step(state, u_V[k], p1, p2, T, shape)
            else:
                _relax(state, p1, p2, T)
        out[k, 0] = stage_output(state, p1, p2)
        out[k, 1] = stage_rate(state, p1, p2)
        if not linear:
            state[1] = hysteresis_step(state[1], u_V[k] - state[0], shape[0], shape[1], shape[2])
            state[0] = u_V[k]
        out[k, 2] = state[0] - state[1]


@compiled
def poles(lag_s: float, inertia_s2: float) -> tuple[complex, complex]:
    """Modes of ``inertia y'' + lag y' + y`` (lag = b/k in s, inertia = m/k in s²), slow one first, 1/s; never equal."""
    discriminant = lag_s * lag_s - 4.0 * inertia_s2
    if abs(discriminant) < (1e-5 * lag_s) ** 2 + 1e-10 * inertia_s2:
        discriminant = max(4e-10 * inertia_s2, (1e-5 * lag_s) ** 2)
    slow = -2.0 / (lag_s + cmath.sqrt(complex(discriminant, 0.0)))
    return slow, 1.0 / (inertia_s2 * slow)


def settled(u_V: float, g_V: float) -> FloatArray:
    """State (6,) at rest with the given voltage and hysteresis."""
    w = u_V - g_V
    return np.array([u_V, g_V, w, 0.0, w, 0.0])
