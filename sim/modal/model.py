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

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.modal.periods import ComplexArray, LineSpectra
from sim.modal.poles import basis


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
    coefficients : (degree + 1, 2N + Q + direct, p, m), of the columns of `sim.modal.poles.basis`.
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
