"""The radial kernel with one width per feature, (2.31): for one pair, a column and a Gram matrix.

K(x, x') = exp(-sum_j (x_j - x'_j)² / sigma_j²). Features are dimensionless (normalised), so are the widths.
The compiled column takes *scaled* features x_j / sigma_j, stored as (d, N) so that its loops run over contiguous
samples, and has its own exponential, which vectorises where a call into the C library does not.
"""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.compiled import compiled_contracting, compiled_reassociating, in_numpy
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray

_LOG2_E = 1.4426950408889634
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
#: Adding 1.5 * 2^52 leaves the nearest integer in the low bits of the double.
_ROUND = 6755399441055744.0
#: Below this the result is set to zero: exp(-708) is 3e-308, the smallest normal double is near.
_UNDERFLOW = -708.0
#: Elements of a Gram matrix per block: 256 KiB, and as much scratch.
_GRAM_BLOCK = 32768


def as_widths(widths: object, dimension: int) -> FloatArray:
    """One width for all features or one each, as (d,) float64.

    Raises
    ------
    InputError : wrong length, or a width that is not positive and finite.
    """
    given = np.asarray(widths, dtype=np.float64)
    if given.ndim == 0:
        given = np.full(dimension, float(given))
    if given.shape != (dimension,) or not np.all(np.isfinite(given)) or not np.all(given > 0):
        raise InputError(
            f"widths: got {widths!r}, expected one positive number or {dimension} of them, one per feature; "
            "give the kernel width sigma of each normalised feature"
        )
    return given.copy()


def column(X: FloatArray, x: FloatArray, widths: FloatArray) -> FloatArray:
    """K of every row of ``X`` (N, d) with ``x`` (d,): (N,)."""
    return np.asarray(np.exp(-np.sum(((X - x) / widths) ** 2, axis=1)), dtype=np.float64)


def gram(X: FloatArray, other: FloatArray | None, widths: FloatArray) -> FloatArray:
    """K of every row of ``X`` (N, d) with every row of ``other`` (M, d), or of ``X`` itself: (N, M).

    Distances are summed feature by feature, not expanded into scalar products: near-duplicates would lose
    all their digits to cancellation there.
    """
    right = X if other is None else other
    count, columns = right.shape[0], np.ascontiguousarray(right.T)
    K = np.empty((X.shape[0], count))
    # In blocks of rows with one scratch: they stay in the cache.
    block = max(1, _GRAM_BLOCK // max(count, 1))
    scratch = np.empty((min(block, X.shape[0]), count))
    for start in range(0, X.shape[0], block):
        squared = K[start : start + block]
        part = scratch[: squared.shape[0]]
        squared[...] = 0.0
        for j in range(X.shape[1]):
            np.subtract(X[start : start + block, j, None], columns[j], out=part)
            part /= widths[j]
            part *= part
            squared += part
        np.negative(squared, out=squared)
        np.exp(squared, out=squared)
    return K


@compiled_contracting
def exp_negative(t: FloatArray, bits: FloatArray) -> None:
    """exp(t) in place for t <= 0, to 2 units in the last place; below -708 exactly 0. ``bits`` (N,) is scratch.

    Reduction by multiples of ln 2 and a Taylor polynomial of degree 12 on [-ln2/2, ln2/2]; every line is a
    loop without branches or calls, so that the compiler vectorises it. NaN stays NaN.
    """
    n = t.shape[0]
    integers = bits.view(np.int64)
    for j in range(n):
        bits[j] = max(t[j], _UNDERFLOW) * _LOG2_E + _ROUND
    for j in range(n):
        k = bits[j] - _ROUND
        integers[j] = (integers[j] + 1023) << 52
        r = (max(t[j], _UNDERFLOW) - k * _LN2_HIGH) - k * _LN2_LOW
        s = 2.08767569878681e-09
        s = s * r + 2.505210838544172e-08
        s = s * r + 2.755731922398589e-07
        s = s * r + 2.7557319223985893e-06
        s = s * r + 2.48015873015873e-05
        s = s * r + 1.984126984126984e-04
        s = s * r + 1.3888888888888889e-03
        s = s * r + 8.333333333333333e-03
        s = s * r + 4.1666666666666664e-02
        s = s * r + 1.6666666666666666e-01
        s = s * r + 0.5
        value = (r * r) * s + r + 1.0
        value = value * bits[j]
        if t[j] < _UNDERFLOW:
            value = 0.0
        if t[j] != t[j]:
            value = t[j]
        t[j] = value


def _rbf_column(scaled: FloatArray, count: int, x_scaled: FloatArray, out: FloatArray, bits: FloatArray) -> None:
    apart = scaled[:, :count] - x_scaled[:, None]
    np.exp(-np.einsum("dn,dn->n", apart, apart), out=out[:count])


@in_numpy(_rbf_column)
@compiled_contracting
def rbf_column(scaled: FloatArray, count: int, x_scaled: FloatArray, out: FloatArray, bits: FloatArray) -> None:
    """K of the first ``count`` samples with one point into ``out[:count]``.

    ``scaled`` (d, N) and ``x_scaled`` (d,) are features divided by their widths; ``bits`` (N,) is scratch.
    """
    target = out[:count]
    i = scaled.shape[0] % 2
    if i == 1:
        row, xi = scaled[0], x_scaled[0]
        for j in range(count):
            difference = row[j] - xi
            target[j] = -(difference * difference)
    else:
        for j in range(count):
            target[j] = 0.0
    # Two features at a time: one more pass over the samples costs as much as the arithmetic.
    while i < scaled.shape[0]:
        row, other, xi, yi = scaled[i], scaled[i + 1], x_scaled[i], x_scaled[i + 1]
        for j in range(count):
            difference, second = row[j] - xi, other[j] - yi
            target[j] -= difference * difference + second * second
        i += 2
    exp_negative(target, bits[:count])


def _weigh(k: FloatArray, alpha: FloatArray) -> tuple[float, float]:
    return float(alpha @ k), float(max(k.max(initial=0.0), 0.0))


@in_numpy(_weigh)
@compiled_reassociating
def weigh(k: FloatArray, alpha: FloatArray) -> tuple[float, float]:
    """(sum of alpha k, largest k) of a kernel column (N,); 0 and 0 where it is empty."""
    n = k.shape[0]
    total = 0.0
    for j in range(n):
        total += alpha[j] * k[j]
    # Four maxima side by side: a single one would be a chain of dependent operations.
    m0, m1, m2, m3 = 0.0, 0.0, 0.0, 0.0
    for j in range(n // 4):
        m0 = max(m0, k[4 * j])
        m1 = max(m1, k[4 * j + 1])
        m2 = max(m2, k[4 * j + 2])
        m3 = max(m3, k[4 * j + 3])
    for j in range(n - n % 4, n):
        m0 = max(m0, k[j])
    return total, max(max(m0, m1), max(m2, m3))
