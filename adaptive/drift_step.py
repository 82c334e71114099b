"""The drift filter's algebra, compiled: one scalar measurement of a random walk, in O(p²).

The same filter as ``filterpy.kalman.KalmanFilter.update`` with one measurement, in Joseph's form and to rounding; the
tests hold it to that. Its products with (I - K h') are of rank one: worked out entry by entry they cost p² operations
instead of p³, without a copy or a call between them, at a twentieth of the time.
"""

from __future__ import annotations

from adaptive.compiled import compiled
from adaptive.types import FloatArray


@compiled
def open_gain(x: FloatArray, P: FloatArray, variance: float) -> None:  # pragma: no cover - compiled
    """P <- P + variance x x': the direction of a change of the gain. ``x`` (p,), ``P`` (p, p)."""
    for i in range(x.shape[0]):
        scaled = variance * x[i]
        for j in range(x.shape[0]):
            P[i, j] += scaled * x[j]


@compiled
def walk(x: FloatArray, P: FloatArray, walks: FloatArray, gain_variance: float) -> None:  # pragma: no cover - compiled
    """Prediction of a random walk: ``walks`` (p,) on the diagonal of P, and a walk of the gain along x."""
    for i in range(x.shape[0]):
        P[i, i] += walks[i]
    open_gain(x, P, gain_variance)


@compiled
def innovation_of(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, towards: FloatArray
) -> tuple[float, float]:  # pragma: no cover - compiled
    """(z - h'x, h'Ph) of a measurement ``z`` along ``h`` (p,); ``towards`` (p,) becomes P h."""
    p = x.shape[0]
    predicted = variance = 0.0
    for i in range(p):
        s = 0.0
        for j in range(p):
            s += P[i, j] * h[j]
        towards[i] = s
        predicted += h[i] * x[i]
        variance += h[i] * s
    return z - predicted, variance


@compiled
def joseph(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, noise: float, k: FloatArray, row: FloatArray
) -> None:  # pragma: no cover - compiled
    """x <- x + K (z - h'x), P <- (I - K h') P (I - K h')' + noise K K', made exactly symmetric.

    ``k`` and ``row`` are (p,) of scratch.
    """
    p = x.shape[0]
    innovation, variance = innovation_of(x, P, h, z, row)
    for i in range(p):
        k[i] = row[i] / (variance + noise)
    for i in range(p):
        x[i] += k[i] * innovation
    # P is symmetric, so that h'P is the row that P h is the column of.
    for i in range(p):
        s = 0.0
        for j in range(p):
            value = P[i, j] - k[i] * row[j]
            P[i, j] = value
            s += value * h[j]
        for j in range(p):
            P[i, j] += (noise * k[i] - s) * k[j]
    for i in range(p):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean


@compiled
def update_constant(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, noise: float, row: FloatArray
) -> None:  # pragma: no cover - compiled
    """Joseph's form with a gain that is zero but for the first entry (Schmidt's filter: the rest is considered)."""
    p = x.shape[0]
    innovation, variance = innovation_of(x, P, h, z, row)
    variance += noise
    gain = row[0] / variance
    x[0] += gain * innovation
    for j in range(p):
        P[0, j] -= gain * row[j]
    for j in range(p):
        P[j, 0] -= gain * row[j]
    P[0, 0] += gain * gain * variance
    for j in range(p):
        mean = 0.5 * (P[0, j] + P[j, 0])
        P[0, j] = mean
        P[j, 0] = mean
