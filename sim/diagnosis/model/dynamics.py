"""The linear part of the stage, stepped exactly: lags, one mode or two, a hold, and a delay of any fraction."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.loops_linear import modes, modes_with_plays
from sim.diagnosis.model.restoring_force import Loop, Restoring, respond_with_loop


@dataclass(frozen=True, slots=True)
class Dynamics:
    """A unit-gain linear system: lags 1/(1 + s tau), modes w²/(s² + 2 z w s + w²), and a dead time.

    ``hold`` is how the static part's output runs between two samples: ``"zero"`` (a D/A that holds) or
    ``"first"`` (a continuous drive that the recorder sampled).
    """

    lags_s: tuple[float, ...] = ()
    modes_hz: tuple[tuple[float, float], ...] = ()  # (frequency, damping ratio)
    delay_s: float = 0.0
    hold: str = "zero"


def _poles(system: Dynamics) -> list[complex]:
    poles: list[complex] = [complex(-1.0 / max(tau, 1e-9)) for tau in system.lags_s]
    for f_hz, damping in system.modes_hz:
        w = 2.0 * math.pi * f_hz
        root = cmath.sqrt(complex(damping * damping - 1.0))
        poles += [w * (-damping + root), w * (-damping - root)]
    # Partial fractions want distinct poles: equal ones are moved apart by a part in 1e5, far below any data.
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


def respond(w: FloatArray, system: Dynamics, dt_s: float, restoring: Restoring | None = None) -> FloatArray:
    """Response at the sampling instants to the static part's output ``w`` (n,), which begins in equilibrium."""
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
        # Of a conjugate pair the real part of one, doubled, says all.
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
    if isinstance(restoring, Loop):
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
    """Response of a sum of complex pole pairs, given by the pole of positive imaginary part and its residue.

    From equilibrium with the first value of ``w`` (n,), whose own share is left out: the answer begins at zero.
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
    """Response (n,) of a system whose mode becomes another at a moment: position and velocity go on from there.

    ``before`` (n,) is the response of ``system`` throughout; ``change`` the moment (s) and the system from then on. The
    mode comes last, so that what stands before it is the same for both, and the difference rings out freely.
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
    )  # the one that the payload moved
    omega = 2.0 * math.pi * f_hz
    damped = omega * math.sqrt(max(1.0 - damping * damping, 1e-12))
    x0, v0 = own[0] - other[0], own[1] - other[1]
    t = np.arange(w.size - k) * dt_s + gone_s
    ring = np.exp(-damping * omega * t) * (
        x0 * np.cos(damped * t) + (v0 + damping * omega * x0) / damped * np.sin(damped * t)
    )
    return np.concatenate([before[:k], after[k:] + ring])


def _state(w: FloatArray, system: Dynamics, at_s: float, k: int, dt_s: float) -> tuple[float, float]:
    """Position and velocity of the output at ``at_s``, from the stretch before it: delays of any size are exact."""
    first = max(0, k - round(1.0 / dt_s))
    stretch = np.ascontiguousarray(w[first : k + 1])
    late = k * dt_s - at_s
    h = 1e-3 / max(max((f for f, _ in system.modes_hz), default=1.0), 1.0)
    one, two = (
        float(respond(stretch, replace(system, delay_s=system.delay_s + late + shift), dt_s)[k - first])
        for shift in (h, -h)
    )
    return 0.5 * (one + two), (two - one) / (2.0 * h)
