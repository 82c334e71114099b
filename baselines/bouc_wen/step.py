"""Exact steps of the Bouc-Wen stage, compiled; `baselines.bouc_wen.model` says which equations and units these are of.

**Hysteresis.** Where u is monotone, with s = |du| and q = sgn(du) g, (2.2) reads dq/ds = alpha - (beta +
gamma sgn q) q: a constant-coefficient equation on each side of q = 0, solved by an exponential in s.

**Dynamics.** Two modes p1, p2 (real or a conjugate pair). With u linear within a step, w is a line plus an
exponential of time, whose response is closed too. Nothing is stepped, so stiffness (Table 2.1: p = -400 and
-3.2e6 per s) does not matter. Within 1e-5 of critical damping the modes are split by that much, which moves the
response by some 1e-10.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray

#: Below this |rate| (1/V) the exponential of (2.2) is taken as a line: better conditioned, and equal to 1e-8 V.
_FLAT = 1e-7


@compiled
def _grow(q: float, s: float, alpha: float, rate: float) -> float:
    """Solution of dq/ds = alpha - rate q after s."""
    if abs(rate) < _FLAT:
        return q + alpha * s
    return q - (q - alpha / rate) * -math.expm1(-rate * s)


@compiled
def crossing(q: float, alpha: float, rate: float) -> float:
    """Way s (V) until q < 0 has grown to zero; infinite where it never does."""
    if abs(rate) < _FLAT:
        return -q / alpha if alpha > 0.0 else math.inf
    if alpha <= 0.0 or -q * rate / alpha <= -1.0:
        return math.inf
    return math.log1p(-q * rate / alpha) / rate


@compiled
def hysteresis_step(u0_V: float, u1_V: float, g_V: float, alpha: float, beta: float, gamma: float) -> float:
    """g after u went monotonously from ``u0_V`` to ``u1_V``; exact."""
    s = abs(u1_V - u0_V)
    if s == 0.0:
        return g_V
    sign = 1.0 if u1_V > u0_V else -1.0
    q = sign * g_V
    if q < 0.0:
        s0 = crossing(q, alpha, beta - gamma)
        if s < s0:
            return sign * _grow(q, s, alpha, beta - gamma)
        q, s = 0.0, s - s0
    return sign * _grow(q, s, alpha, beta + gamma)


@compiled
def _mode(z: complex, p: complex, T: float, w0: float, slope: float, c: float, rate: float) -> complex:
    """z' = p (z - w) over T with w = w0 + slope t + c (exp(-rate t) - 1)."""
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
    """One piece of a linear-hold step on which q keeps its sign; ``ds``: the way of u over it, V."""
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
    """The modes over T under a resting voltage."""
    w = state[0] - state[1]
    z1 = _mode(complex(state[2], state[3]), p1, T, w, 0.0, 0.0, 0.0)
    z2 = _mode(complex(state[4], state[5]), p2, T, w, 0.0, 0.0, 0.0)
    state[2], state[3], state[4], state[5] = z1.real, z1.imag, z2.real, z2.imag


@compiled
def stage_step(state: FloatArray, u_V: float, p1: complex, p2: complex, T: float, shape: FloatArray) -> None:
    """Advance (u, g, z1 re, im, z2 re, im) by a step at whose end the voltage is ``u_V``, linear within it.

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
    """(y - y0)/d in volts."""
    z1, z2 = complex(state[2], state[3]), complex(state[4], state[5])
    return ((p1 * z2 - p2 * z1) / (p1 - p2)).real


@compiled
def stage_rate(state: FloatArray, p1: complex, p2: complex) -> float:
    """y'/d in V/s."""
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
    """Rows (y - y0)/d, y'/d, drive w of each sample into ``out`` (n, 3); ``state`` is advanced in place.

    The state before the first sample is that of the first sample's instant: its voltage is not stepped to.
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
            state[1] = hysteresis_step(state[0], u_V[k], state[1], shape[0], shape[1], shape[2])
            state[0] = u_V[k]
        out[k, 2] = state[0] - state[1]


@compiled
def poles(lag_s: float, inertia_s2: float) -> tuple[complex, complex]:
    """Modes of ``inertia y'' + lag y' + y`` (b/k in s, m/k in s²), slow one first, 1/s; never exactly equal."""
    discriminant = lag_s * lag_s - 4.0 * inertia_s2
    if abs(discriminant) < (1e-5 * lag_s) ** 2 + 1e-10 * inertia_s2:
        discriminant = max(4e-10 * inertia_s2, (1e-5 * lag_s) ** 2)
    slow = -2.0 / (lag_s + cmath.sqrt(complex(discriminant, 0.0)))
    return slow, 1.0 / (inertia_s2 * slow)


def settled(u_V: float, g_V: float) -> FloatArray:
    """State (6,) with voltage and hysteresis as given and no motion."""
    w = u_V - g_V
    return np.array([u_V, g_V, w, 0.0, w, 0.0])
