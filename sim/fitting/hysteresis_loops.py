"""Compiled hysteresis operators of the diagnosis, one pass over the samples each, without allocation inside."""

from __future__ import annotations

import math

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.step import hysteresis_step


@compiled
def bouc_wen_loop(u_V: FloatArray, slope: float, beta: float, gamma: float, h0: float) -> FloatArray:
    """(n,) h of (2.2) with n = 1, exact for a voltage that is monotone between two samples.

    ``slope`` = alpha d in µm/V; beta, gamma in 1/V; h in µm.
    """
    n = u_V.shape[0]
    out = np.empty(n)
    h = h0
    out[0] = h
    for k in range(1, n):
        du = u_V[k] - u_V[k - 1]
        h = hysteresis_step(h, du, slope, beta, gamma)
        out[k] = h
    return out


@compiled
def bouc_wen_paced(
    u_V: FloatArray, slope: float, beta: float, gamma: float, h0: float, pace: FloatArray, gain: float
) -> FloatArray:
    """(n,) h of (2.2) with a rate-dependent driving term: slope (1 + gain pace_k) on the step that ends at sample k."""
    n = u_V.shape[0]
    out = np.empty(n)
    h = h0
    out[0] = h
    for k in range(1, n):
        du = u_V[k] - u_V[k - 1]
        push = max(slope * (1.0 + gain * pace[k]), 1e-12)
        h = hysteresis_step(h, du, push, beta, gamma)
        out[k] = h
    return out


@compiled
def path_lag(z: FloatArray, rate: float, start: float, weights: FloatArray) -> FloatArray:
    """(n,) w of dw = rate |dz| (f(z) - w) with odd f(z) = z sum_j weights_j z^(2 j): a lag over the travelled path.

    A Duhem model whose memory is local (Coleman and Hodgdon 1986). ``start``: w less f at the first sample. Steps of
    ``z`` above 0.04 are divided.
    """
    n, m = z.shape[0], weights.shape[0]
    out = np.empty(n)
    w = start
    goal = 0.0
    for j in range(m - 1, -1, -1):
        goal = goal * z[0] * z[0] + weights[j]
    w += goal * z[0]
    out[0] = w
    for k in range(1, n):
        gap = z[k] - z[k - 1]
        if gap != 0.0:
            count = int(abs(gap) / 0.04) + 1
            step = gap / count
            keep = math.exp(-rate * abs(step))
            at = z[k - 1] + 0.5 * step
            for _ in range(count):
                goal = 0.0
                for j in range(m - 1, -1, -1):
                    goal = goal * at * at + weights[j]
                goal *= at
                w = goal + (w - goal) * keep
                at += step
        out[k] = w
    return out


@compiled
def filtered_rate(u_V: FloatArray, keep: float, dt_s: float) -> FloatArray:
    """(n,) |du/dt| through a first-order lag with the pole ``keep``."""
    n = u_V.shape[0]
    out = np.empty(n)
    s = 0.0
    out[0] = 0.0
    for k in range(1, n):
        s = keep * s + (1.0 - keep) * abs(u_V[k] - u_V[k - 1]) / dt_s
        out[k] = s
    return out


@compiled
def grown_plays(
    u_V: FloatArray, radii_V: FloatArray, weights: FloatArray, grown: FloatArray, added_V: FloatArray
) -> FloatArray:
    """(n,) weighted plays with thresholds r grown + added_V, less the same plays with thresholds r."""
    n = u_V.shape[0]
    m = radii_V.shape[0]
    still = np.zeros(m)
    moving = np.zeros(m)
    out = np.empty(n)
    for k in range(n):
        total = 0.0
        u = u_V[k]
        for j in range(m):
            r = radii_V[j]
            still[j] = min(max(still[j], u - r), u + r)
            r = max(r * grown[k] + added_V[k], 0.0)
            moving[j] = min(max(moving[j], u - r), u + r)
            total += weights[j] * (moving[j] - still[j])
        out[k] = total
    return out


@compiled
def asymmetric(
    u_V: FloatArray,
    h_um: FloatArray,
    w_um: FloatArray,
    p: FloatArray,
    near: FloatArray,
    wide: FloatArray,
    x_scale: FloatArray,
    z_scale: FloatArray,
    loop_um: float,
) -> FloatArray:
    """(n,) µm: dead zones (2.8) on the static displacement and on a wide play, and products of loop and displacement.

    ``p``: weights at the knees ``near`` of x, at the knees ``wide`` of z, of h x and of h². x = (w - low)/half - 1 with
    ``x_scale`` (low, half) in µm; z the same of a play of the voltage with ``z_scale`` (radius, low, half) in V.
    """
    n = u_V.shape[0]
    out = np.empty(n)
    low_um, half_um = x_scale[0], x_scale[1]
    radius_V, low_V, half_V = z_scale[0], z_scale[1], z_scale[2]
    a, b = near.shape[0], wide.shape[0]
    branch, width = p[a + b], p[a + b + 1] / loop_um
    held = 0.0
    for k in range(n):
        x = (w_um[k] - low_um) / half_um - 1.0
        held = min(max(held, u_V[k] - radius_V), u_V[k] + radius_V)
        z = (held - low_V) / half_V - 1.0
        total = 0.0
        for j in range(a):
            if x > near[j]:
                total += p[j] * (x - near[j])
        for j in range(b):
            if z > wide[j]:
                total += p[a + j] * (z - wide[j])
        h = h_um[k]
        out[k] = half_um * total + branch * h * x + width * h * h
    return out


@compiled
def plays_nested(u_V: FloatArray, radii_V: FloatArray, weights: FloatArray) -> FloatArray:
    """(n,) sum of weighted plays (2.4), (2.7), relaxed at 0 V at the start, with radii in rising order.

    The cost per sample does not depend on the number of plays: relaxed plays stay nested, so the input always drags
    the narrowest ones. The held part of the sum is computed again at each reversal, so that no error accumulates.
    """
    n = u_V.shape[0]
    m = radii_V.shape[0]
    state = np.zeros(m)
    # Sums over the narrowest j plays: of weights, and of weights times radii.
    slope = np.zeros(m + 1)
    lead = np.zeros(m + 1)
    for j in range(m):
        slope[j + 1] = slope[j] + weights[j]
        lead[j + 1] = lead[j] + weights[j] * radii_V[j]
    out = np.empty(n)
    held = 0.0
    dragged = 0
    way = 0.0
    before = 0.0
    for k in range(n):
        u = u_V[k]
        if u != before:
            if (u - before) * way <= 0.0:
                for j in range(dragged):
                    state[j] = before - way * radii_V[j]
                held = 0.0
                for j in range(m):
                    held += weights[j] * state[j]
                dragged = 0
                way = 1.0 if u > before else -1.0
            while dragged < m and way * (u - state[dragged]) > radii_V[dragged]:
                held -= weights[dragged] * state[dragged]
                dragged += 1
            before = u
        out[k] = held + slope[dragged] * u - way * lead[dragged]
    return out


def loop_numbers(p: FloatArray) -> tuple[float, float, float]:
    """Slope alpha d (µm/V), beta and gamma (1/V) of a Bouc-Wen stage's parameters.

    beta - gamma is kept above -(beta + gamma): below it h diverges for a bounded voltage.
    """
    fall = max(float(p[3]), -0.95 * float(p[2]))
    return float(p[1] * p[0]), 0.5 * (float(p[2]) + fall), 0.5 * (float(p[2]) - fall)
