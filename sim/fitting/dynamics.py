"""The mechanics: lags, modes, a hold and a dead time of any fraction of a sample, stepped exactly.

Hysteresis may act in the restoring force of a mode, as play operators of the displacement or by the Bouc-Wen equation:

    y'' + 2 z w y' + w² (y + share Z) = w² x,      Z' = y' - (beta |y'| Z + gamma y' |Z|)

which is m y'' + c y' + k y + force = u with force = k share Z, in µm (Noël, Schoukens, "Hysteretic benchmark with a
dynamic nonlinearity", 2016). Over a sub-step in which y moves one way, Z is the exact solution of (2.2) with y in
place of the voltage. The linear part is exact for a force that changes linearly, predicted and corrected once.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.step import hysteresis_step


@compiled
def _around(w: FloatArray, i: int) -> tuple[float, float, float]:
    """w[i-1], w[i], w[i+1] less the first value. Beyond its ends the record is constant."""
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
    """(n,) sum of first-order modes x' = lambda x + r w, stepped exactly. Gains (m, 3) weigh w[k-shift-1 .. k-shift+1].

    The modes begin in equilibrium with the first value.
    """
    n = w.shape[0]
    m = poles_re.shape[0]
    out = np.zeros(n)
    w0 = w[0]
    for j in range(m):
        ar, ai = poles_re[j], poles_im[j]
        g0r, g1r, g2r = gains_re[j, 0], gains_re[j, 1], gains_re[j, 2]
        g0i, g1i, g2i = gains_im[j, 0], gains_im[j, 1], gains_im[j, 2]
        # The states are deviations from the equilibrium with the first value.
        xr = 0.0
        xi = 0.0
        # Inside the record no index must be clipped, and the input terms are independent of the recursion.
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
    """`modes` with hysteresis in the restoring force: weighted stops of the output are subtracted from the input.

    ``back`` (m,) weighs the force at sample k in the step to k + 1. The simulation stops when it diverges.
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


@dataclass(frozen=True, slots=True)
class ForceStops:
    """Weighted stop operators of the displacement y (y less a play of y) with these radii, µm."""

    radii_um: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class ForceLoop:
    """Bouc-Wen force Z: its stiffness as a share of the spring's, beta + gamma and beta - gamma (1/µm)."""

    share: float
    rise_per_um: float
    fall_per_um: float
    substeps: int = 4


RestoringForce = ForceStops | ForceLoop


def between_samples(w: FloatArray, substeps: int, delay_samples: float, hold: str) -> FloatArray:
    """((n - 1) substeps + 1,) values of ``w`` (n,) at the sub-steps, ``delay_samples`` late.

    ``hold`` "zero": held. "first": the drive is continuous, so a cubic spline interpolates its samples.
    """
    at = np.arange((w.size - 1) * substeps + 1) / substeps - delay_samples
    if hold == "zero":
        return np.ascontiguousarray(w[np.clip(np.floor(at + 1e-9).astype(np.int64), 0, w.size - 1)])
    from scipy.interpolate import CubicSpline  # a simulated stage does not wait for it

    spline = CubicSpline(np.arange(w.size, dtype=np.float64), w)
    return np.ascontiguousarray(spline(np.clip(at, 0.0, w.size - 1.0)))


@compiled
def modes_with_loop(
    w: FloatArray,
    every: int,
    held: bool,
    poles_re: FloatArray,
    poles_im: FloatArray,
    starts_re: FloatArray,
    starts_im: FloatArray,
    ends_re: FloatArray,
    ends_im: FloatArray,
    share: float,
    rise: float,
    fall: float,
) -> FloatArray:
    """Output at every ``every``-th sub-step of modes whose input is ``w`` less ``share`` Z of their own output.

    ``starts`` and ``ends`` (m,) weigh the input at both ends of a sub-step; ``held``: w is constant over it. The
    simulation stops when it diverges.
    """
    steps = w.shape[0] - 1
    m = poles_re.shape[0]
    out = np.zeros(steps // every + 1)
    xr, xi = np.zeros(m), np.zeros(m)
    beta, gamma = 0.5 * (rise + fall), 0.5 * (rise - fall)
    end = 0.0
    for j in range(m):
        end += ends_re[j]
    w0 = w[0]
    y = z = before = 0.0
    out[0] = w0
    for k in range(steps):
        a = w[k] - w0 - share * z
        guess = 2.0 * z - before
        b = (w[k] if held else w[k + 1]) - w0 - share * guess
        there = 0.0
        for j in range(m):
            nr = poles_re[j] * xr[j] - poles_im[j] * xi[j] + starts_re[j] * a + ends_re[j] * b
            xi[j] = poles_re[j] * xi[j] + poles_im[j] * xr[j] + starts_im[j] * a + ends_im[j] * b
            xr[j] = nr
            there += nr
        way = there - y
        after = hysteresis_step(z, way, 1.0, beta, gamma)
        late = share * (guess - after)
        for j in range(m):
            xr[j] += ends_re[j] * late
            xi[j] += ends_im[j] * late
        there += end * late
        way = there - y
        before = z
        z = hysteresis_step(z, way, 1.0, beta, gamma)
        y = there
        if not abs(y) < 1e12:
            break
        if (k + 1) % every == 0:
            out[(k + 1) // every] = y + w0
    return out


def linear_weights(poles: list[complex], residues: list[complex], step_s: float) -> list[FloatArray]:
    """For each pole its step factor and the weights of the input at both ends; real and imaginary parts."""
    rows = []
    for pole, residue in zip(poles, residues, strict=True):
        x = pole * step_s
        grown = np.exp(x)
        whole = (grown - 1.0) / pole if abs(x) > 1e-6 else complex(step_s)
        # Integral of exp(pole (h - s)) s/h over s in [0, h].
        end = (grown - 1.0 - x) / (pole * x) if abs(x) > 1e-4 else step_s * (0.5 + x / 6.0)
        rows.append((grown, residue * (whole - end), residue * end))
    table = np.array(rows)
    return [np.ascontiguousarray(c) for column in table.T for c in (column.real, column.imag)]


def respond_with_loop(
    w: FloatArray,
    poles: list[complex],
    residues: list[complex],
    delay_s: float,
    hold: str,
    dt_s: float,
    loop: ForceLoop,
) -> FloatArray:
    """(n,) response of poles and residues (of a conjugate pair the upper pole, doubled) with ``loop`` in the force."""
    fine = between_samples(w, loop.substeps, delay_s / dt_s, hold)
    steps_re, steps_im, starts_re, starts_im, ends_re, ends_im = linear_weights(poles, residues, dt_s / loop.substeps)
    return np.asarray(
        modes_with_loop(
            fine, loop.substeps, hold == "zero", steps_re, steps_im, starts_re, starts_im, ends_re, ends_im,
            loop.share, loop.rise_per_um, loop.fall_per_um,
        )
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Dynamics:
    """A unit-gain linear system: lags 1/(1 + s tau), modes w²/(s² + 2 z w s + w²), and a dead time.

    ``hold`` says how the input runs between two samples: "zero" (a D/A converter holds it) or "first" (a continuous
    drive that the recorder sampled).
    """

    lags_s: tuple[float, ...] = ()
    modes_hz: tuple[tuple[float, float], ...] = ()  # (frequency, damping ratio)
    delay_s: float = 0.0
    hold: str = "zero"


#: Damping ratio below which a mode rings.
LIGHT = 0.5


def first_ringing(modes_hz: tuple[tuple[float, float], ...]) -> int | None:
    """Index of the first mode (frequency, damping ratio) that rings; None if none does."""
    return next((i for i, (_, damping) in enumerate(modes_hz) if damping < LIGHT), None)


def _poles(system: Dynamics) -> list[complex]:
    poles: list[complex] = [complex(-1.0 / max(tau, 1e-9)) for tau in system.lags_s]
    for f_hz, damping in system.modes_hz:
        w = 2.0 * math.pi * f_hz
        root = cmath.sqrt(complex(damping * damping - 1.0))
        poles += [w * (-damping + root), w * (-damping - root)]
    # Partial fractions need distinct poles: equal ones are moved apart by 3e-5, which no data resolve.
    for i in range(len(poles)):
        while any(abs(poles[i] - poles[j]) < 1e-5 * abs(poles[i]) for j in range(i)):
            poles[i] *= 1.0 + 3e-5
    return poles


def _integral(pole: complex, dt_s: float, a: float, b: float) -> tuple[complex, complex]:
    """Integrals of exp(pole (dt - s)) and of s exp(pole (dt - s)) over s in [a, b]."""
    ea, eb = cmath.exp(pole * (dt_s - a)), cmath.exp(pole * (dt_s - b))
    one = (ea - eb) / pole
    return one, (a * ea - b * eb) / pole + one / pole


def _gains(pole: complex, residue: complex, dt_s: float, fraction: float, hold: str) -> tuple[complex, ...]:
    """Weights of w[k-d-1], w[k-d], w[k-d+1] in one step, with a delay of (d + fraction) samples."""
    cut = fraction * dt_s
    early, early_s = _integral(pole, dt_s, 0.0, cut)
    late, late_s = _integral(pole, dt_s, cut, dt_s)
    if hold == "zero":
        return residue * early, residue * late, 0.0j
    up_early = (1.0 - fraction) * early + early_s / dt_s
    up_late = -fraction * late + late_s / dt_s
    return residue * (early - up_early), residue * (up_early + late - up_late), residue * up_late


def respond(w: FloatArray, system: Dynamics, dt_s: float, restoring: RestoringForce | None = None) -> FloatArray:
    """(n,) response at the sampling instants to ``w`` (n,), from equilibrium with its first value."""
    poles = _poles(system)
    shift = math.floor(system.delay_s / dt_s)
    fraction = system.delay_s / dt_s - shift
    if not poles:
        poles = [complex(-1e3 / dt_s)]
    whole = 1.0 + 0.0j
    for pole in poles:
        whole *= -pole
    gains = np.empty((len(poles), 4), dtype=np.complex128)
    residues = []
    steps = np.empty(len(poles), dtype=np.complex128)
    keep = []
    for i, pole in enumerate(poles):
        residue = whole
        for j, other in enumerate(poles):
            if j != i:
                residue /= pole - other
        residues.append(residue)
        gains[i, :3] = _gains(pole, residue, dt_s, fraction, system.hold)
        gains[i, 3] = _gains(pole, residue, dt_s, 0.0, "zero")[1]
        steps[i] = cmath.exp(pole * dt_s)
        # A conjugate pair is twice the real part of its upper pole.
        if pole.imag > 0.0:
            gains[i] *= 2.0
        if pole.imag >= 0.0:
            keep.append(i)
    g, s = gains[keep], steps[keep]
    poles_re, poles_im = np.ascontiguousarray(s.real), np.ascontiguousarray(s.imag)
    re, im = np.ascontiguousarray(g.real), np.ascontiguousarray(g.imag)
    w = np.ascontiguousarray(w)
    if restoring is None:
        return np.asarray(modes(w, shift, poles_re, poles_im, re, im))
    if isinstance(restoring, ForceLoop):
        kept = [(poles[i], residues[i] * (2.0 if poles[i].imag > 0.0 else 1.0)) for i in keep]
        upper, weighed = [pole for pole, _ in kept], [residue for _, residue in kept]
        return respond_with_loop(w, upper, weighed, system.delay_s, system.hold, dt_s, restoring)
    back_re, back_im = np.ascontiguousarray(re[:, 3]), np.ascontiguousarray(im[:, 3])
    return np.asarray(
        modes_with_plays(w, shift, poles_re, poles_im, re, im, back_re, back_im, restoring.radii_um, restoring.weights)
    )


def respond_partial(
    w: FloatArray, poles: list[complex], residues: list[complex], delay_s: float, hold: str, dt_s: float
) -> FloatArray:
    """(n,) response of complex pole pairs, each given by its upper pole and residue, to ``w`` (n,).

    The response starts in equilibrium with the first value of ``w``, and that equilibrium is subtracted: it begins
    at zero.
    """
    shift = math.floor(delay_s / dt_s)
    fraction = delay_s / dt_s - shift
    gains = np.array([_gains(p, 2.0 * r, dt_s, fraction, hold) for p, r in zip(poles, residues, strict=True)])
    steps = np.exp(np.array(poles) * dt_s)
    re, im = np.ascontiguousarray(gains.real), np.ascontiguousarray(gains.imag)
    w = np.ascontiguousarray(w)
    out = modes(w, shift, np.ascontiguousarray(steps.real), np.ascontiguousarray(steps.imag), re, im)
    return np.asarray(out - w[0])


def changed_midway(
    w: FloatArray, before: FloatArray, system: Dynamics, change: tuple[float, Dynamics], dt_s: float
) -> FloatArray:
    """(n,) response of a system whose mode changes at one moment; position and velocity are continuous there.

    ``before`` (n,) is the response of ``system`` throughout; ``change`` is the moment (s) and the system after it. The
    mode is the last block, so the blocks before it are the same for both, and the difference decays freely.
    """
    at_s, later = change
    after = respond(w, later, dt_s)
    k = math.ceil(at_s / dt_s)
    if k >= w.size - 1:
        return before
    if k < 4:
        return after
    gone_s = k * dt_s - at_s
    own, other = _state(w, system, at_s, k, dt_s), _state(w, later, at_s, k, dt_s)
    f_hz, damping = next(
        mode for mode, old in zip(later.modes_hz, system.modes_hz, strict=True) if mode != old
    )  # The mode that the payload changes.
    omega = 2.0 * math.pi * f_hz
    damped = omega * math.sqrt(max(1.0 - damping * damping, 1e-12))
    x0, v0 = own[0] - other[0], own[1] - other[1]
    t = np.arange(w.size - k) * dt_s + gone_s
    ring = np.exp(-damping * omega * t) * (
        x0 * np.cos(damped * t) + (v0 + damping * omega * x0) / damped * np.sin(damped * t)
    )
    return np.concatenate([before[:k], after[k:] + ring])


def _state(w: FloatArray, system: Dynamics, at_s: float, k: int, dt_s: float) -> tuple[float, float]:
    """Position (µm) and velocity (µm/s) of the output at ``at_s``, from the second before it."""
    first = max(0, k - round(1.0 / dt_s))
    stretch = np.ascontiguousarray(w[first : k + 1])
    late = k * dt_s - at_s
    h = 1e-3 / max(max((f for f, _ in system.modes_hz), default=1.0), 1.0)
    one, two = (
        float(respond(stretch, replace(system, delay_s=system.delay_s + late + shift), dt_s)[k - first])
        for shift in (h, -h)
    )
    return 0.5 * (one + two), (two - one) / (2.0 * h)
