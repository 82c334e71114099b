"""The compiled loops of a feature map: the memory after a point, and the inputs of a model at that point.

What the operators and the two vectors are is said in ``adaptive.features``, whose map these loops take as arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray

#: basis columns ahead of the plays when the linear part is on: 1, y, v, a, y², y³
MOTION_COLUMNS = 6
VELOCITY, ACCELERATION = 2, 3


class FeatureArrays(NamedTuple):
    """A feature map as the compiled loops take it; not to be changed.

    thresholds (K,), arc lengths (A,), both µm; retain (M,) = exp(-dt/tau) of the slow states; scale
    [y0, 1/y, 1/v, 1/a]; kernel_plays (d - 2,) indices; flags [linear, asymmetric];
    frame [offset, 1/gain, dead band of the arcs].
    """

    thresholds: FloatArray
    arcs: FloatArray
    retain: FloatArray
    scale: FloatArray
    kernel_plays: Any
    flags: Any
    frame: FloatArray


@compiled
def advance(y_um: float, memory: FloatArray, m: FeatureArrays) -> None:  # pragma: no cover - compiled
    """Memory after one point at ``y_um``, in place.

    A play follows y at the distance of its threshold; an arc state relaxes towards y, by exp(-path/rho); a slow
    state by exp(-dt/tau). The path is counted behind a dead band: the noise of a stage at rest is no path, and would
    relax the arcs within seconds, where those of the noise-free reference stay.
    """
    y = (y_um - m.frame[0]) * m.frame[1]
    n = m.thresholds.shape[0]
    arcs = m.arcs.shape[0]
    for i in range(m.retain.shape[0]):
        memory[n + arcs + i] = y + (memory[n + arcs + i] - y) * m.retain[i]
    for i in range(n):
        r = m.thresholds[i]
        memory[i] = max(y - r, min(y + r, memory[i]))
    if arcs > 0:
        last = memory.shape[0] - 1
        before = memory[last]
        memory[last] = max(y - m.frame[2], min(y + m.frame[2], before))
        path = abs(memory[last] - before)
        for i in range(arcs):
            memory[n + i] = y + (memory[n + i] - y) * np.exp(-path / m.arcs[i])


@compiled
def fill(
    y_um: float, v: float, a: float, memory: FloatArray, m: FeatureArrays, basis: FloatArray, kernel: FloatArray
) -> None:  # pragma: no cover - compiled
    """Basis and kernel inputs of one point, from the memory *after* it."""
    y = (y_um - m.frame[0]) * m.frame[1]
    yn = (y - m.scale[0]) * m.scale[1]
    vn = v * m.frame[1] * m.scale[2]
    kernel[0] = yn
    kernel[1] = vn
    for i in range(m.kernel_plays.shape[0]):
        j = m.kernel_plays[i]
        kernel[2 + i] = (y - memory[j]) / m.thresholds[j]
    basis[0] = 1.0
    if not m.flags[0]:
        return
    basis[1] = yn
    basis[2] = vn
    basis[3] = a * m.frame[1] * m.scale[3]
    basis[4] = yn * yn
    basis[5] = yn * yn * yn
    at = 6
    n = m.thresholds.shape[0]
    for i in range(n):
        basis[at + i] = (y - memory[i]) / m.thresholds[i]
    at += n
    if m.flags[1]:
        for i in range(n):
            basis[at + i] = basis[at - n + i] * yn
        at += n
    for i in range(m.arcs.shape[0]):
        basis[at + i] = (y - memory[n + i]) / m.arcs[i]
    at += m.arcs.shape[0]
    n += m.arcs.shape[0]
    for i in range(m.retain.shape[0]):
        basis[at + i] = (y - memory[n + i]) * m.scale[1]


@compiled
def run_features(
    y: FloatArray,
    v: FloatArray,
    a: FloatArray,
    memory: FloatArray,
    m: FeatureArrays,
    basis: FloatArray,
    kernel: FloatArray,
) -> None:  # pragma: no cover - compiled
    """``advance`` and ``fill`` over n points, into basis (n, p) and kernel (n, d)."""
    for i in range(y.shape[0]):
        advance(y[i], memory, m)
        fill(y[i], v[i], a[i], memory, m, basis[i], kernel[i])
