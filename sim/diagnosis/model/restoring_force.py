"""Hysteresis in the restoring force of a mode: stops of the displacement, or the Bouc-Wen equation driven by it.

    y'' + 2 z w y' + w² (y + share Z) = w² x,      Z' = y' - (beta |y'| Z + gamma y' |Z|)

is m y'' + c y' + k y + force = u with force = k share Z, µm for µm (Noël, Schoukens, "Hysteretic benchmark with a
dynamic nonlinearity", 2016). Over a sub-step in which y runs one way, Z is exactly that of (2.2) with y for the
voltage; the linear part is stepped exactly for a force that runs in a straight line, predicted and corrected once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from adaptive.compiled import compiled
from adaptive.types import FloatArray
from sim.diagnosis.model.loops import _branch


@dataclass(frozen=True, slots=True)
class Stops:
    """Weighted stops (y less a play of y) of these radii, µm."""

    radii_um: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class Loop:
    """Z of the module's equation: its stiffness as a share of the spring's, beta + gamma and beta - gamma (1/µm)."""

    share: float
    rise_per_um: float
    fall_per_um: float
    substeps: int = 4


Restoring = Stops | Loop


def between_samples(w: FloatArray, substeps: int, delay_samples: float, hold: str) -> FloatArray:
    """``w`` (n,) at the sub-steps, ``delay_samples`` late, ((n - 1) substeps + 1,).

    ``hold`` "zero": held; "first": a continuous drive, so a cubic spline goes through its samples, not straight lines.
    """
    at = np.arange((w.size - 1) * substeps + 1) / substeps - delay_samples
    if hold == "zero":
        return np.ascontiguousarray(w[np.clip(np.floor(at + 1e-9).astype(np.int64), 0, w.size - 1)])
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
    """Output at every ``every``-th sub-step; the input of the modes is ``w`` less ``share`` Z of their own output.

    ``starts`` and ``ends`` (m,) weigh the input at both ends of a sub-step; ``held``: w keeps its value over it.
    A motion that leaves all bounds is cut short.
    """
    steps = w.shape[0] - 1
    m = poles_re.shape[0]
    out = np.zeros(steps // every + 1)
    xr, xi = np.zeros(m), np.zeros(m)
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
        after = _branch(z, way, 1.0, rise, fall) if way >= 0.0 else -_branch(-z, -way, 1.0, rise, fall)
        late = share * (guess - after)
        for j in range(m):
            xr[j] += ends_re[j] * late
            xi[j] += ends_im[j] * late
        there += end * late
        way = there - y
        before = z
        z = _branch(z, way, 1.0, rise, fall) if way >= 0.0 else -_branch(-z, -way, 1.0, rise, fall)
        y = there
        if not abs(y) < 1e12:
            break
        if (k + 1) % every == 0:
            out[(k + 1) // every] = y + w0
    return out


def linear_weights(poles: list[complex], residues: list[complex], step_s: float) -> list[FloatArray]:
    """Of each pole: its step, and the weights of the input at the start and at the end of it; real and imaginary."""
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
    w: FloatArray, poles: list[complex], residues: list[complex], delay_s: float, hold: str, dt_s: float, loop: Loop
) -> FloatArray:
    """Response (n,) of poles and residues (of a conjugate pair the upper one, doubled) with ``loop`` in the force."""
    fine = between_samples(w, loop.substeps, delay_s / dt_s, hold)
    steps_re, steps_im, starts_re, starts_im, ends_re, ends_im = linear_weights(poles, residues, dt_s / loop.substeps)
    return np.asarray(
        modes_with_loop(
            fine, loop.substeps, hold == "zero", steps_re, steps_im, starts_re, starts_im, ends_re, ends_im,
            loop.share, loop.rise_per_um, loop.fall_per_um,
        )
    )  # fmt: skip
