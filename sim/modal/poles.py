"""Common poles of a response matrix by vector fitting: the start of the joint fit.

Source: Gustavsen and Semlyen, Rational approximation of frequency domain responses by vector fitting, IEEE Trans. Power
Delivery 14 (1999) 1052, here in ``z``; the sums are compressed entry by entry as in Deschrijver et al., IEEE Microwave
and Wireless Components Letters 18 (2008) 383.
"""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray
from sim.modal.periods import ComplexArray

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
