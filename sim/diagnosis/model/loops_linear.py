"""The compiled loops of what is linear, and of what reads: modes, lags, clamps, friction, clocks."""

from __future__ import annotations

import math

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray


@compiled
def _around(w: FloatArray, i: int) -> tuple[float, float, float]:
    """w[i-1], w[i], w[i+1] less the first value; the record goes on as it begins and ends."""
    top = w.shape[0] - 1
    w0 = w[0]
    a, b, c = w[min(max(i - 1, 0), top)], w[min(max(i, 0), top)], w[min(max(i + 1, 0), top)]
    return a - w0, b - w0, c - w0


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
        # Within the record nothing has to be asked, and what the input adds is summed apart from the recursion.
        first = min(max(shift + 1, 0), n - 1)
        last = max(min(n - 1 + shift, n - 1), first)
        for k in range(first):
            i = k - shift
            a, b, c = _around(w, i)
            nr = ar * xr - ai * xi + (g0r * a + g1r * b + g2r * c)
            xi = ar * xi + ai * xr + (g0i * a + g1i * b + g2i * c)
            xr = nr
            out[k + 1] += xr
        if ai == 0.0 and xi == 0.0 and g0i == 0.0 and g1i == 0.0 and g2i == 0.0:
            for k in range(first, last):
                i = k - shift
                xr = ar * xr + (g0r * (w[i - 1] - w0) + g1r * (w[i] - w0) + g2r * (w[i + 1] - w0))
                out[k + 1] += xr
        else:
            for k in range(first, last):
                i = k - shift
                a, b, c = w[i - 1] - w0, w[i] - w0, w[i + 1] - w0
                nr = ar * xr - ai * xi + (g0r * a + g1r * b + g2r * c)
                xi = ar * xi + ai * xr + (g0i * a + g1i * b + g2i * c)
                xr = nr
                out[k + 1] += xr
        for k in range(last, n - 1):
            i = k - shift
            a, b, c = _around(w, i)
            nr = ar * xr - ai * xi + (g0r * a + g1r * b + g2r * c)
            xi = ar * xi + ai * xr + (g0i * a + g1i * b + g2i * c)
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
        a, b, c = _around(w, i)
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
def lag_ends(u: FloatArray, ratio: float, straight: bool) -> FloatArray:
    """First-order lag at the beginning of each sample. ratio = time constant / sample.

    The input is held over a sample or, ``straight``, runs in a line to the next one.
    """
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    decay = math.exp(-1.0 / ratio)
    slope = 1.0 - ratio * (1.0 - decay)
    for k in range(n):
        out[k] = s
        gap = (s - u[k]) * decay
        s = u[k] + gap
        if straight and k + 1 < n:
            s += (u[k + 1] - u[k]) * slope
    return out


@compiled
def slew_ends(u: FloatArray, step: float, straight: bool) -> FloatArray:
    """Rate clamp of ``step`` volts a sample, at the beginning of each sample; the input as in `lag_ends`."""
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    for k in range(n):
        out[k] = s
        gap = u[min(k + 1, n - 1) if straight else k] - s
        s += min(max(gap, -step), step)
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
def resample_by(x: FloatArray, shifts: FloatArray) -> FloatArray:
    """x at instants k + shifts[k] by cubic (Catmull-Rom) interpolation, held at the ends."""
    n = x.shape[0]
    out = np.empty(n)
    for k in range(n):
        whole = math.floor(shifts[k])
        f = shifts[k] - whole
        i = k + int(whole)
        a = x[min(max(i - 1, 0), n - 1)]
        b = x[min(max(i, 0), n - 1)]
        c = x[min(max(i + 1, 0), n - 1)]
        d = x[min(max(i + 2, 0), n - 1)]
        out[k] = b + 0.5 * f * (c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a)))
    return out


@compiled
def resample(x: FloatArray, stretch: float, shift: float) -> FloatArray:
    """x at instants k (1 + stretch) + shift; see `resample_by`. The sum keeps the fraction's digits at large k."""
    shifts = stretch * np.arange(x.shape[0], dtype=np.float64) + shift
    return resample_by(x, shifts.astype(np.float64))
