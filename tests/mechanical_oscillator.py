"""Bouc-Wen oscillator driven by a force, with the hysteresis in its restoring force, integrated numerically.

    m y'' + c y' + k y + z = u
    z' = alpha y' - beta (gamma |y'| |z|^(nu-1) z + delta y' |z|^nu)

J. P. Noël, M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity", 2016. With ``z = alpha s w`` for a
displacement scale s: ``s w' = y' - (g |y'| |w|^(nu-1) w + d y' |w|^nu)``. It shares no code with the stages that a
diagnosis fits.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray


def between_samples(u: FloatArray, factor: int) -> FloatArray:
    """A periodic signal (n,) at ``factor`` times its rate, (n factor,), by its Fourier series."""
    n = u.size
    spectrum = np.fft.rfft(u)
    if n % 2 == 0:
        spectrum[-1] *= 0.5  # the Nyquist line belongs to both of its frequencies
    padded = np.zeros(n * factor // 2 + 1, dtype=np.complex128)
    padded[: spectrum.size] = spectrum
    return np.asarray(np.fft.irfft(padded, n * factor) * factor, dtype=np.float64)


@compiled
def _slope(
    y: float, v: float, w: float, u: float, theta: FloatArray, unit: bool
) -> tuple[float, float]:  # pragma: no cover - compiled
    """(v', w') at a state; theta = m, c, k, alpha, g, d, nu, s; ``unit``: nu is 1."""
    size = abs(w)
    power = size if unit else size ** theta[6]
    sign = 1.0 if w > 0.0 else -1.0
    acceleration = (u - theta[1] * v - theta[2] * y - theta[3] * theta[7] * w) / theta[0]
    return acceleration, (v - (theta[4] * abs(v) * sign + theta[5] * v) * power) / theta[7]


@compiled
def _integrate(
    u: FloatArray, h: float, every: int, theta: FloatArray, state: FloatArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Write the displacement at every ``every``-th step of ``h`` s to ``out``; ``u``: force at steps and half steps.

    ``state`` (y, v, w) is advanced in place. ``out[0]`` is the displacement before the first step.
    """
    y, v, w = state[0], state[1], state[2]
    unit = abs(theta[6] - 1.0) < 1e-12
    for i in range(out.size):
        out[i] = y
        for j in range(every):
            k = 2 * (i * every + j)
            u0, u1, u2 = u[k % u.size], u[(k + 1) % u.size], u[(k + 2) % u.size]
            a1, b1 = _slope(y, v, w, u0, theta, unit)
            v2 = v + 0.5 * h * a1
            a2, b2 = _slope(y + 0.5 * h * v, v2, w + 0.5 * h * b1, u1, theta, unit)
            v3 = v + 0.5 * h * a2
            a3, b3 = _slope(y + 0.5 * h * v2, v3, w + 0.5 * h * b2, u1, theta, unit)
            v4 = v + h * a3
            a4, b4 = _slope(y + h * v3, v4, w + h * b3, u2, theta, unit)
            y += h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
            v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            w += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
    state[0], state[1], state[2] = y, v, w


@dataclass(frozen=True, slots=True)
class MechanicalBoucWen:
    """The parameters of the oscillator; ``scale_m`` is s, and g = beta gamma (alpha s)^nu/alpha, d likewise."""

    m_kg: float
    c_N_s_per_m: float
    k_N_per_m: float
    alpha_N_per_m: float
    g: float
    d: float
    nu: float
    scale_m: float

    @property
    def products(self) -> tuple[float, float]:
        """beta gamma and beta delta of the equation of the module, 1/m for nu = 1."""
        share = self.alpha_N_per_m * (self.alpha_N_per_m * self.scale_m) ** -self.nu
        return self.g * share, self.d * share

    def steady_state(self, u_N: FloatArray, dt_s: float, oversample: int = 20, settle: float = 0.5) -> FloatArray:
        """(n,) displacement, m, over one period of the periodic force ``u_N`` (n,), N, by classical Runge-Kutta.

        ``settle`` : periods that are run from rest first.
        """
        fine = between_samples(u_N, 2 * oversample)
        theta, state, before = np.array(astuple(self)), np.zeros(3), round(settle * u_N.size)
        _integrate(
            np.roll(fine, 2 * oversample * before), dt_s / oversample, oversample, theta, state, np.empty(before)
        )
        out = np.empty(u_N.size)
        _integrate(fine, dt_s / oversample, oversample, theta, state, out)
        return out
