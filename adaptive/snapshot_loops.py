"""The compiled loops of a served inverse LSSVM: voltages and deviations of a trajectory, and its memory carried on."""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled, compiled_reassociating
from adaptive.features_loops import FeatureArrays, advance, fill
from adaptive.kernels import rbf_column, weigh
from adaptive.types import BoolArray, FloatArray
from adaptive.window_small import dot
from adaptive.window_state import IntArray


@compiled_reassociating
def spread(covariance: FloatArray, basis: FloatArray) -> float:  # pragma: no cover - compiled
    """basis' covariance basis, V², (p, p) and (p,); 0 for a covariance of no size. Half of a point's time, in order."""
    p, total, j = covariance.shape[0], 0.0, 0
    # Four rows at a time: each sum that ends costs as much as the row.
    while j + 3 < p:
        r0, r1, r2, r3 = covariance[j], covariance[j + 1], covariance[j + 2], covariance[j + 3]
        b0, b1, b2, b3 = basis[j], basis[j + 1], basis[j + 2], basis[j + 3]
        for i in range(p):
            total += (r0[i] * b0 + r1[i] * b1 + r2[i] * b2 + r3[i] * b3) * basis[i]
        j += 4
    while j < p:
        row, bj = covariance[j], basis[j]
        for i in range(p):
            total += row[i] * bj * basis[i]
        j += 1
    return total


@compiled
def evaluate(
    y: FloatArray,
    v: FloatArray,
    a: FloatArray,
    memory: FloatArray,
    m: FeatureArrays,
    beta: FloatArray,
    beta_covariance: FloatArray,
    scaled: FloatArray,
    alpha: FloatArray,
    inverse_widths: FloatArray,
    noise_variance: float,
    kernel_variance: float,
    shrink: float,
    domain: FloatArray,
    anchor: FloatArray,
    allowed: float,
    u: FloatArray,
    std: FloatArray,
    inside: BoolArray,
) -> None:  # pragma: no cover - compiled
    """Voltages, deviations and domain flags of n points; ``memory`` advances in place.

    ``anchor`` (p,) or (0,): linear part that the voltage leaves by ``allowed``, V, at most.
    """
    n = y.shape[0]
    d, count = scaled.shape
    p = beta.shape[0]
    basis = np.empty(p)
    x = np.empty(d)
    k = np.empty(count)
    bits = np.empty(count)
    for i in range(n):
        advance(y[i], memory, m)
        fill(y[i], v[i], a[i], memory, m, basis, x)
        mean = dot(beta, basis, p)
        variance = noise_variance + spread(beta_covariance, basis)
        nearest = 0.0
        if count > 0:
            for j in range(d):
                x[j] *= inverse_widths[j]
            rbf_column(scaled, count, x, k, bits)
            kernel_part, nearest = weigh(k, alpha)
            mean += kernel_part
        if anchor.shape[0] > 0:
            known = dot(anchor, basis, p)
            mean = min(max(mean, known - allowed), known + allowed)
        u[i] = mean
        std[i] = np.sqrt(max(variance + kernel_variance * (1.0 - shrink * nearest * nearest), 0.0))
        inside[i] = domain[0] <= y[i] <= domain[1] and domain[2] <= v[i] <= domain[3] and domain[4] <= a[i] <= domain[5]


@compiled
def unpacked(
    constants: FloatArray, counts: IntArray
) -> tuple[FeatureArrays, FloatArray, FloatArray, FloatArray, FloatArray, int]:  # pragma: no cover - compiled
    """(feature map, beta (p,), 1/widths (d,), alpha (n,), scaled support (d, n), place of what follows); views."""
    K, A, M, p, d, n = counts[0], counts[1], counts[2], counts[3], counts[4], counts[5]
    at = 17
    thresholds = constants[at : at + K]
    at += K
    arcs = constants[at : at + A]
    at += A
    retain = constants[at : at + M]
    at += M
    beta = constants[at : at + p]
    at += p
    inverse_widths = constants[at : at + d]
    at += d
    alpha = constants[at : at + n]
    at += n
    scaled = constants[at : at + d * n].reshape(d, n)
    at += d * n
    m = FeatureArrays(thresholds, arcs, retain, constants[13:17], counts[10:], counts[7:9], constants[0:3])
    return m, beta, inverse_widths, alpha, scaled, at


@compiled
def evaluate_packed(
    y: FloatArray,
    v: FloatArray,
    a: FloatArray,
    memory: FloatArray,
    constants: FloatArray,
    counts: IntArray,
    u: FloatArray,
    std: FloatArray,
    inside: BoolArray,
) -> None:  # pragma: no cover - compiled
    """`evaluate` with all that a model is made of in two arrays, as `LssvmInverse` packs it.

    Twenty arrays cost more to hand over than one point costs to work out, and are twenty places in memory to fetch.
    """
    m, beta, inverse_widths, alpha, scaled, at = unpacked(constants, counts)
    c, p = counts[6], beta.shape[0]
    covariance = constants[at : at + c * c].reshape(c, c)
    at += c * c
    anchor = constants[at : at + counts[9] * p]
    scalars, domain = constants[3:7], constants[7:13]
    evaluate(
        y, v, a, memory, m, beta, covariance, scaled, alpha, inverse_widths, scalars[0], scalars[1], scalars[2], domain,
        anchor, scalars[3], u, std, inside,
    )  # fmt: skip


@compiled
def voltage_of(
    y: float,
    v: float,
    a: float,
    memory: FloatArray,
    scratch: FloatArray,
    m: FeatureArrays,
    beta: FloatArray,
    scaled: FloatArray,
    alpha: FloatArray,
    inverse_widths: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Voltage at a trial point after ``memory`` (m,), which stays; ``scratch`` (m,) is written to."""
    scratch[:] = memory
    advance(y, scratch, m)
    basis, kernel = np.empty(beta.shape[0]), np.empty(inverse_widths.shape[0])
    fill(y, v, a, scratch, m, basis, kernel)
    return mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)


@compiled
def evaluate_point(
    y: float, v: float, a: float, memory: FloatArray, constants: FloatArray, counts: IntArray
) -> tuple[float, float, bool]:  # pragma: no cover - compiled
    """`evaluate_packed` of one point, numbers to numbers: to hand over an array costs as much as five of them."""
    five, inside = np.empty(5), np.empty(1, dtype=np.bool_)
    five[0], five[1], five[2] = y, v, a
    evaluate_packed(five[0:1], five[1:2], five[2:3], memory, constants, counts, five[3:4], five[4:5], inside)
    return five[3], five[4], inside[0]


@compiled
def track_memory(y: FloatArray, memory: FloatArray, m: FeatureArrays) -> None:  # pragma: no cover - compiled
    """Advance ``memory`` (m,) in place by (n,) measured displacements."""
    for i in range(y.shape[0]):
        advance(y[i], memory, m)


@compiled
def mean_of(
    basis: FloatArray,
    kernel: FloatArray,
    beta: FloatArray,
    scaled: FloatArray,
    alpha: FloatArray,
    inverse_widths: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Mean at one point whose inputs are known."""
    count = alpha.shape[0]
    mean = dot(beta, basis, beta.shape[0])
    if count > 0:
        k = np.empty(count)
        rbf_column(scaled, count, kernel * inverse_widths, k, np.empty(count))
        for j in range(count):
            mean += alpha[j] * k[j]
    return mean
