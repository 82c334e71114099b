"""Modes common to all drives and outputs, whose frequencies and dampings move smoothly with the drive's amplitude.

At the amplitude ``a``, with ``x = a / reference - 1``,

    G(z) = Σ_i [R_i / (z - p_i) + conj] + Σ_q R_q / (z - p_q) + Σ_d D_d z^-d
    p_i = exp(2πf_i (-ζ_i + j√(1-ζ_i²)) dt)

``log f_i``, ``log ζ_i``, the logarithms of the real poles' rates and all residues are polynomials in ``x``. For a
periodic drive in steady state the output's lines are ``G u``, without any approximation in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.modal.periods import ComplexArray, LineSpectra

# --- Common poles of a response matrix by vector fitting: the start of the joint fit.
#
# Source: Gustavsen and Semlyen, Rational approximation of frequency domain responses by vector fitting, IEEE Trans.
# Power Delivery 14 (1999) 1052, here in ``z``; the sums are compressed entry by entry as in Deschrijver et al., IEEE
# Microwave and Wireless Components Letters 18 (2008) 383.

#: Poles this close to the real axis count as real, relative to their distance from the origin.
REAL = 1e-9


def stacked(values: ComplexArray) -> FloatArray:
    """Real parts above imaginary parts, along the first axis."""
    return np.concatenate([values.real, values.imag])


def basis(z: ComplexArray, pairs: ComplexArray, reals: FloatArray, direct: int) -> ComplexArray:
    """(F, 2N + Q + direct) basis with real coefficients: two columns a complex pair, one a real pole, powers of 1/z.

    The coefficients ``a, b`` of a pair are the real and imaginary part of the residue at the pole with positive
    imaginary part. All pairs' first columns come first, then all pairs' second columns.
    """
    upper, lower = 1.0 / (z[:, None] - pairs), 1.0 / (z[:, None] - pairs.conj())
    powers = z[:, None] ** -np.arange(direct)
    return np.concatenate([upper + lower, 1j * (upper - lower), 1.0 / (z[:, None] - reals), powers], axis=1)


def vector_fit(
    z: ComplexArray,
    g: ComplexArray,
    weight: FloatArray,
    *,
    pairs: int,
    direct: int,
    band: tuple[float, float],
    iterations: int = 12,
) -> tuple[ComplexArray, FloatArray]:
    """Stable common poles of the entries of ``g`` (F, E) at ``z`` (F,), with the weights (F,).

    ``pairs`` start evenly spaced over ``band``, in rad a sample, with 1 % damping. Returns the poles with positive
    imaginary part, ascending in angle, and the real poles. Their number can differ from ``pairs`` where pairs turn
    into real poles.
    """
    poles: ComplexArray = np.exp((-0.01 + 1j) * np.linspace(band[0], band[1], pairs + 2)[1:-1])
    reals = np.array([0.9])
    for _ in range(iterations):
        poles, reals = _relocated(z, g, weight, poles, reals, direct)
    return poles[np.argsort(np.angle(poles))], reals


def _relocated(
    z: ComplexArray, g: ComplexArray, weight: FloatArray, pairs: ComplexArray, reals: FloatArray, direct: int
) -> tuple[ComplexArray, FloatArray]:
    """One step: the zeros of the common denominator become the poles, mirrored into the unit circle."""
    columns = basis(z, pairs, reals, direct)
    scale = np.linalg.norm(columns, axis=0)
    count = 2 * pairs.size + reals.size
    denominator = columns[:, :count]
    numerator = weight[:, None] * columns / scale
    rows, values = [], []
    for entry in g.T:
        joint = np.concatenate(
            [numerator, -weight[:, None] * denominator * entry[:, None], (weight * entry)[:, None]], axis=1
        )
        triangle = np.asarray(np.linalg.qr(stacked(joint), mode="r"))[columns.shape[1] : columns.shape[1] + count]
        rows.append(triangle[:, columns.shape[1] : -1])
        values.append(triangle[:, -1])
    coefficients = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    n = pairs.size
    companion = np.zeros((count, count))
    index = np.arange(n)
    companion[index, index] = companion[n + index, n + index] = pairs.real
    companion[index, n + index], companion[n + index, index] = pairs.imag, -pairs.imag
    companion[2 * n + np.arange(reals.size), 2 * n + np.arange(reals.size)] = reals
    drive = np.concatenate([np.full(n, 2.0), np.zeros(n), np.ones(reals.size)])
    zeros = np.linalg.eigvals(companion - np.outer(drive, coefficients))
    outside = np.abs(zeros) > 1.0
    zeros[outside] = 1.0 / zeros[outside].conj()
    complex_ones = zeros.imag > REAL * np.abs(zeros)
    real_ones = np.abs(zeros.imag) <= REAL * np.abs(zeros)
    return zeros[complex_ones], np.sort(zeros[real_ones].real)


# --- The model.


def powers_of(x: float, degree: int) -> FloatArray:
    """``[1, x, x², ...]``, (degree + 1,)."""
    return np.asarray(x ** np.arange(degree + 1), dtype=np.float64)


def poles_at(theta: FloatArray, modes: int, x: float, dt_s: float) -> tuple[ComplexArray, FloatArray]:
    """Poles in ``z`` at ``x``: the upper ones of the pairs (N,) and the real ones (Q,).

    ``theta`` (2N + Q, degree + 1): polynomials of log frequency (Hz), log damping ratio, log rate (1/s).
    """
    values = theta @ powers_of(x, theta.shape[1] - 1)
    omega, damping = 2.0 * np.pi * np.exp(values[:modes]), np.exp(values[modes : 2 * modes])
    s = omega * (-damping + 1j * np.sqrt(1.0 - damping**2))
    return np.exp(s * dt_s), np.exp(-np.exp(values[2 * modes :]) * dt_s)


@dataclass(frozen=True, slots=True)
class ModalModel:
    """A multi-input, multi-output modal model over a range of amplitudes.

    Attributes
    ----------
    dt_s : sample time, s.
    reference_V : amplitude at which the polynomials' variable is 0, rms V.
    low_V, high_V : the amplitudes of the recordings it was fitted to; beyond them the nearest one is used.
    modes : N, number of mode pairs.
    theta : (2N + Q, degree + 1), see `poles_at`. The modes come in ascending order of frequency.
    coefficients : (degree + 1, 2N + Q + direct, p, m), of the columns of `sim.modal.model.basis`.
    direct : number of powers of 1/z.
    """

    dt_s: float
    reference_V: float
    low_V: float
    high_V: float
    modes: int
    theta: FloatArray
    coefficients: FloatArray
    direct: int

    @property
    def degree(self) -> int:
        """Degree of the polynomials in the amplitude."""
        return int(self.theta.shape[1]) - 1

    def position(self, amplitude_V: float) -> float:
        """The polynomials' variable ``x`` at an amplitude, held at the ends of the fitted range."""
        return float(np.clip(amplitude_V, self.low_V, self.high_V)) / self.reference_V - 1.0

    def frequencies_hz(self, amplitude_V: float) -> FloatArray:
        """(N,) natural frequencies, Hz."""
        return np.asarray(
            np.exp(self.theta[: self.modes] @ powers_of(self.position(amplitude_V), self.degree)), dtype=np.float64
        )

    def dampings(self, amplitude_V: float) -> FloatArray:
        """(N,) damping ratios."""
        return np.asarray(
            np.exp(self.theta[self.modes : 2 * self.modes] @ powers_of(self.position(amplitude_V), self.degree)),
            dtype=np.float64,
        )

    def residues(self, amplitude_V: float) -> ComplexArray:
        """(N, p, m) residues at the upper poles, µm/V a sample."""
        c = np.tensordot(powers_of(self.position(amplitude_V), self.degree), self.coefficients, axes=1)
        return np.asarray(c[: self.modes] + 1j * c[self.modes : 2 * self.modes], dtype=np.complex128)

    def response(self, z: ComplexArray, amplitude_V: float) -> ComplexArray:
        """(F, p, m) response matrix at the points ``z`` (F,) of the unit circle, µm/V."""
        x = self.position(amplitude_V)
        pairs, reals = poles_at(self.theta, self.modes, x, self.dt_s)
        c = np.tensordot(powers_of(x, self.degree), self.coefficients, axes=1)
        return np.asarray(np.tensordot(basis(z, pairs, reals, self.direct), c, axes=1), dtype=np.complex128)

    def predict(self, spectra: LineSpectra) -> ComplexArray:
        """(F, p, R) lines of the output, µm. Raises InputError on other channels or another sample time."""
        outputs, drives = self.coefficients.shape[2:]
        if spectra.u.shape[1] != drives or spectra.y.shape[1] != outputs:
            raise InputError(
                f"{spectra.name}: channels: got {spectra.u.shape[1]} drives and {spectra.y.shape[1]} outputs, expected "
                f"{drives} and {outputs} as in the training recordings"
            )
        if abs(spectra.dt_s / self.dt_s - 1.0) > 1e-6:
            raise InputError(
                f"{spectra.name}: sample time: got {spectra.dt_s:g} s, expected {self.dt_s:g} s as in the training "
                "recordings: resample it"
            )
        return np.asarray(self.response(spectra.z, spectra.amplitude_V) @ spectra.u, dtype=np.complex128)

    def participation(self, z: ComplexArray, amplitude_V: float) -> FloatArray:
        """(N, p) rms contribution of each pair to each output for a drive with flat lines at ``z``, µm.

        Each drive has this rms. The contributions of close modes overlap: they do not add up to the output.
        """
        pairs, _ = poles_at(self.theta, self.modes, self.position(amplitude_V), self.dt_s)
        shares = np.empty((self.modes, self.coefficients.shape[2]))
        for i, (pole, residue) in enumerate(zip(pairs, self.residues(amplitude_V), strict=True)):
            own = residue / (z[:, None, None] - pole) + residue.conj() / (z[:, None, None] - pole.conj())
            shares[i] = np.sqrt(np.mean(np.sum(np.abs(own) ** 2, axis=2), axis=0))
        return np.asarray(amplitude_V * shares, dtype=np.float64)


def output_errors(model: ModalModel, spectra: LineSpectra) -> FloatArray:
    """(p, R) rms of measured minus predicted mean period about its mean value, µm."""
    left = spectra.y - model.predict(spectra)
    return np.asarray(np.sqrt(2.0 * np.sum(np.abs(left) ** 2, axis=0) + spectra.unexcited), dtype=np.float64)
