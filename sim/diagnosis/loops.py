"""The compiled loops under the diagnosis: one pass over the samples each, nothing allocated inside."""

from __future__ import annotations

import math

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray


@compiled
def bouc_wen_loop(u_V: FloatArray, slope: float, beta: float, gamma: float, h0: float) -> FloatArray:
    """h of (2.2) with n = 1, exactly, for a voltage that is monotone between two samples.

    ``slope`` = alpha d in µm/V; beta, gamma in 1/V; h in µm. On every stretch of one sign of du and of h the
    equation is linear in u, so the solution is one exponential; a sign change of h splits the step once.
    """
    n = u_V.shape[0]
    out = np.empty(n)
    h = h0
    out[0] = h
    for k in range(1, n):
        du = u_V[k] - u_V[k - 1]
        if du != 0.0:
            sign = 1.0 if du > 0.0 else -1.0
            length = abs(du)
            g = sign * h  # by the symmetry of (2.2) a falling step of h is a rising one of -h
            if g < 0.0:
                rate = beta - gamma
                # Length of u after which g crosses zero: g = s/r + (g0 - s/r) exp(-r length).
                if abs(rate) * length < 1e-9:
                    to_zero = -g / slope if slope > 0.0 else length + 1.0
                else:
                    ratio = 1.0 - rate * g / slope if slope > 0.0 else 0.0
                    to_zero = math.log(ratio) / rate if ratio > 0.0 else length + 1.0
                first = min(length, to_zero)
                x = rate * first
                decay = math.exp(-x)
                step = -math.expm1(-x) / rate if abs(x) > 1e-9 else first
                g = g * decay + slope * step
                length -= first
                if length > 0.0:
                    g = 0.0
            if length > 0.0:
                rate = beta + gamma
                x = rate * length
                step = -math.expm1(-x) / rate if abs(x) > 1e-9 else length
                g = g * math.exp(-x) + slope * step
            h = sign * g
        out[k] = h
    return out


@compiled
def bouc_wen_paced(
    u_V: FloatArray, slope: float, beta: float, gamma: float, h0: float, pace: FloatArray, gain: float
) -> FloatArray:
    """(2.2) whose driving term grows with the rate: slope (1 + gain pace_k) on the step that ends at sample k.

    With gain 0 it is `bouc_wen_loop` to the last bit but for the step in which h changes its sign.
    """
    n = u_V.shape[0]
    out = np.empty(n)
    h = h0
    out[0] = h
    for k in range(1, n):
        du = u_V[k] - u_V[k - 1]
        if du != 0.0:
            sign = 1.0 if du > 0.0 else -1.0
            length = abs(du)
            g = sign * h
            push = max(slope * (1.0 + gain * pace[k]), 1e-12)
            if g < 0.0:
                rate = beta - gamma
                if abs(rate) * length < 1e-9:
                    to_zero = -g / push
                else:
                    ratio = 1.0 - rate * g / push
                    to_zero = math.log(ratio) / rate if ratio > 0.0 else length + 1.0
                first = min(length, to_zero)
                x = rate * first
                step = -math.expm1(-x) / rate if abs(x) > 1e-9 else first
                g = g * math.exp(-x) + push * step
                length -= first
                if length > 0.0:
                    g = 0.0
            if length > 0.0:
                rate = beta + gamma
                x = rate * length
                step = -math.expm1(-x) / rate if abs(x) > 1e-9 else length
                g = g * math.exp(-x) + push * step
            h = sign * g
        out[k] = h
    return out


@compiled
def felt_rate(u_V: FloatArray, keep: float, dt_s: float) -> FloatArray:
    """Size of du/dt through a first-order lag whose pole is ``keep``."""
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
    """Weighted plays whose thresholds grow by a factor ``grown`` and by ``added_V`` (n,), less the same at rest."""
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
def plays_sum(u_V: FloatArray, radii_V: FloatArray, weights: FloatArray) -> FloatArray:
    """Sum of weighted plays (2.4), (2.7) that start relaxed at zero volts."""
    n = u_V.shape[0]
    m = radii_V.shape[0]
    state = np.zeros(m)
    out = np.empty(n)
    for k in range(n):
        total = 0.0
        for j in range(m):
            s = state[j]
            low = u_V[k] - radii_V[j]
            high = u_V[k] + radii_V[j]
            if s < low:
                s = low
            elif s > high:
                s = high
            state[j] = s
            total += weights[j] * s
        out[k] = total
    return out


@compiled
def plays_matrix(u_V: FloatArray, radii_V: FloatArray) -> FloatArray:
    """Every play on its own, (m, n)."""
    m = radii_V.shape[0]
    n = u_V.shape[0]
    out = np.empty((m, n))
    for j in range(m):
        s = 0.0
        r = radii_V[j]
        for k in range(n):
            low = u_V[k] - r
            high = u_V[k] + r
            if s < low:
                s = low
            elif s > high:
                s = high
            out[j, k] = s
    return out


@compiled
def modes(
    w: FloatArray,
    shift: int,
    poles_re: FloatArray,
    poles_im: FloatArray,
    gains_re: FloatArray,
    gains_im: FloatArray,
) -> FloatArray:
    """Sum of first-order modes x' = lambda x + r w, stepped exactly; gains (m, 3) weigh w[k-shift-1 .. k-shift+1].

    The record is taken to begin in equilibrium with its first value.
    """
    n = w.shape[0]
    m = poles_re.shape[0]
    out = np.zeros(n)
    w0 = w[0]
    for j in range(m):
        ar, ai = poles_re[j], poles_im[j]
        g0r, g1r, g2r = gains_re[j, 0], gains_re[j, 1], gains_re[j, 2]
        g0i, g1i, g2i = gains_im[j, 0], gains_im[j, 1], gains_im[j, 2]
        # Deviations from the first value: the equilibrium needs no arithmetic of its own.
        xr = 0.0
        xi = 0.0
        for k in range(n - 1):
            i = k - shift
            a = w[i - 1] - w0 if 0 <= i - 1 < n else (0.0 if i < 1 else w[n - 1] - w0)
            b = w[i] - w0 if 0 <= i < n else (0.0 if i < 0 else w[n - 1] - w0)
            c = w[i + 1] - w0 if 0 <= i + 1 < n else (0.0 if i < -1 else w[n - 1] - w0)
            nr = ar * xr - ai * xi + g0r * a + g1r * b + g2r * c
            xi = ar * xi + ai * xr + g0i * a + g1i * b + g2i * c
            xr = nr
            out[k + 1] += xr
    for k in range(n):
        out[k] += w0
    return out


@compiled
def modes_with_plays(
    w: FloatArray,
    shift: int,
    poles_re: FloatArray,
    poles_im: FloatArray,
    gains_re: FloatArray,
    gains_im: FloatArray,
    back_re: FloatArray,
    back_im: FloatArray,
    radii_um: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """`modes` with hysteresis in the restoring force: weighted plays of the output itself are taken off its input.

    ``back`` (m,) weighs the force at sample k in the step to k + 1. A motion that leaves all bounds is cut short.
    """
    n = w.shape[0]
    m = poles_re.shape[0]
    r = radii_um.shape[0]
    out = np.zeros(n)
    xr, xi = np.zeros(m), np.zeros(m)
    play = np.zeros(r)
    w0 = w[0]
    y = 0.0
    for k in range(n):
        out[k] = y + w0
        force = 0.0
        for j in range(r):
            play[j] = min(max(play[j], y - radii_um[j]), y + radii_um[j])
            force += weights[j] * (y - play[j])
        i = k - shift
        a = w[i - 1] - w0 if 0 <= i - 1 < n else (0.0 if i < 1 else w[n - 1] - w0)
        b = w[i] - w0 if 0 <= i < n else (0.0 if i < 0 else w[n - 1] - w0)
        c = w[i + 1] - w0 if 0 <= i + 1 < n else (0.0 if i < -1 else w[n - 1] - w0)
        y = 0.0
        for j in range(m):
            nr = poles_re[j] * xr[j] - poles_im[j] * xi[j]
            ni = poles_re[j] * xi[j] + poles_im[j] * xr[j]
            xr[j] = nr + gains_re[j, 0] * a + gains_re[j, 1] * b + gains_re[j, 2] * c - back_re[j] * force
            xi[j] = ni + gains_im[j, 0] * a + gains_im[j, 1] * b + gains_im[j, 2] * c - back_im[j] * force
            y += xr[j]
        if not abs(y) < 1e12:
            break
    return out


@compiled
def lag_mean(u: FloatArray, ratio: float) -> FloatArray:
    """First-order lag of a held signal; each value is the mean over its own sample. ratio = time constant / sample."""
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    decay = math.exp(-1.0 / ratio)
    mean = ratio * (1.0 - decay)
    for k in range(n):
        gap = s - u[k]
        out[k] = u[k] + gap * mean
        s = u[k] + gap * decay
    return out


@compiled
def slew_mean(u: FloatArray, step: float) -> FloatArray:
    """Rate clamp of a held signal, ``step`` volts a sample; each value is the mean over its own sample."""
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    for k in range(n):
        gap = u[k] - s
        size = abs(gap)
        if size <= step:
            out[k] = u[k] - gap * 0.5 * size / step
            s = u[k]
        else:
            move = step if gap > 0.0 else -step
            out[k] = s + 0.5 * move
            s += move
    return out


@compiled
def slow_poles(x: FloatArray, rates: FloatArray) -> FloatArray:
    """First-order lags of x - x[0] with rates dt/tau, exact for a held x, (m, n)."""
    m = rates.shape[0]
    n = x.shape[0]
    out = np.empty((m, n))
    for j in range(m):
        keep = math.exp(-rates[j])
        take = 1.0 - keep
        s = 0.0
        for k in range(n):
            out[j, k] = s
            s = keep * s + take * (x[k] - x[0])
    return out


@compiled
def friction(x: FloatArray, width: float, share: float) -> FloatArray:
    """Stuck after each reversal until the drive is ``width`` away, then sliding ``share * width`` behind it.

    share = 1 is a play of radius ``width``; below, letting go is a jump.
    """
    n = x.shape[0]
    out = np.empty(n)
    s = x[0]
    slide = share * width
    direction = 0.0
    for k in range(n):
        gap = x[k] - s
        if direction > 0.0 and gap >= slide:
            s = x[k] - slide
        elif direction < 0.0 and -gap >= slide:
            s = x[k] + slide
        else:
            direction = 0.0
            if gap > width:
                s = x[k] - slide
                direction = 1.0
            elif -gap > width:
                s = x[k] + slide
                direction = -1.0
        out[k] = s
    return out


@compiled
def resample(x: FloatArray, stretch: float, shift: float) -> FloatArray:
    """x at instants k (1 + stretch) + shift by cubic (Catmull-Rom) interpolation, held at the ends."""
    n = x.shape[0]
    out = np.empty(n)
    for k in range(n):
        # Written as a sum so that the fraction keeps its digits at large k.
        extra = k * stretch + shift
        whole = math.floor(extra)
        f = extra - whole
        i = k + int(whole)
        a = x[min(max(i - 1, 0), n - 1)]
        b = x[min(max(i, 0), n - 1)]
        c = x[min(max(i + 1, 0), n - 1)]
        d = x[min(max(i + 2, 0), n - 1)]
        out[k] = b + 0.5 * f * (c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a)))
    return out
