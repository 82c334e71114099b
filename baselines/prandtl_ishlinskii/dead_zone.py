"""The one-sided dead-zone operator (2.8) and its superposition (2.9): a piecewise linear, single-valued curve.

A walk with thresholds 0 and 2 µm::

    >>> import numpy as np
    >>> from baselines.prandtl_ishlinskii.dead_zone import dead_zone, dead_zone_sum
    >>> y_um = np.array([-1.0, 0.0, 1.0, 2.0, 3.0, 1.0])
    >>> dead_zone(y_um, np.array([0.0, 2.0])).tolist()
    [[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 1.0], [1.0, 0.0]]

The zero threshold passes everything, also what is negative; the other opens at 2 µm. Way up and way down
are the same: the operator has no memory. Weighted 1 and -0.5 the slope halves above 2 µm::

    >>> [dead_zone_sum(y, np.array([0.0, 2.0]), np.array([1.0, -0.5])) for y in (-1.0, 2.0, 4.0)]
    [-1.0, 2.0, 3.0]
"""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray


@compiled
def dead_zone_sum(y_um: float, d_um: FloatArray, weight: FloatArray) -> float:
    """Weighted sum of dead zones of one value (2.9). ``d_um``, ``weight``: (m+1,), thresholds ascending."""
    total = 0.0
    for j in range(d_um.size):
        if d_um[j] > 0.0:
            if y_um > d_um[j]:
                total += weight[j] * (y_um - d_um[j])
        else:
            total += weight[j] * y_um
    return total


def dead_zone(y_um: FloatArray, d_um: FloatArray) -> FloatArray:
    """Outputs (n, m+1) of dead zones (2.8) with thresholds ``d_um`` (m+1,) for ``y_um`` (n,); µm."""
    shifted = y_um[:, None] - d_um[None, :]
    return np.where(d_um[None, :] > 0.0, np.maximum(shifted, 0.0), y_um[:, None])


def ramps(y_um: FloatArray, d_um: FloatArray) -> FloatArray:
    """The same curves in another basis: (n, m+1), column j rises by one µm per µm between d_j and d_{j+1} only.

    A superposition of dead zones is invertible when all partial sums of its weights are positive; in this basis
    the weights *are* those partial sums (the slopes), so that invertibility is a sign constraint.
    """
    columns = dead_zone(y_um, d_um)
    columns[:, :-1] -= columns[:, 1:]
    return columns


def slopes_to_weights(slopes: FloatArray) -> FloatArray:
    """Dead-zone weights (m+1,) from the slopes of the segments (m+1,)."""
    return np.diff(slopes, prepend=0.0)
