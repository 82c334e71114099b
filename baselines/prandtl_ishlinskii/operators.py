"""The two elementary operators of the Prandtl-Ishlinskii models: play (2.4), (2.5) and dead zone (2.8), (2.9).

**Play** (backlash), here with threshold 1 V, driven up and down from rest::

    >>> import numpy as np
    >>> from dehyst.baselines.prandtl_ishlinskii.operators import dead_zone, dead_zone_sum, play_run, play_start
    >>> path_V = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 2.5, 1.0, 0.5, 0.0, 3.0])
    >>> state = play_start(0.0, np.array([1.0]))
    >>> play_run(path_V, np.array([1.0]), state)[:, 0].tolist()
    [0.0, 0.0, 0.0, 1.0, 2.0, 2.0, 2.0, 1.5, 1.0, 2.0]

Up to 1 V the output stays at 0; then it follows 1 V behind. After the reversal it holds until the input has come back
by 2 V, and follows 1 V above. The way back up to 3 V closes the loop at 2 V, where it opened: the inner excursion is
wiped out. A threshold of zero passes the input through::

    >>> play_run(path_V[:4], np.array([0.0]), play_start(0.0, np.array([0.0])))[:, 0].tolist()
    [0.0, 0.5, 1.0, 2.0]

**Dead zone**, one-sided, with thresholds 0 and 2 µm::

    >>> y_um = np.array([-1.0, 0.0, 1.0, 2.0, 3.0, 1.0])
    >>> dead_zone(y_um, np.array([0.0, 2.0])).tolist()
    [[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 1.0], [1.0, 0.0]]

The zero threshold passes every value, negative ones too; the other opens at 2 µm. The operator has no memory. With
the weights 1 and -0.5 the slope halves above 2 µm::

    >>> [dead_zone_sum(y, np.array([0.0, 2.0]), np.array([1.0, -0.5])) for y in (-1.0, 2.0, 4.0)]
    [-1.0, 2.0, 3.0]
"""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray


@compiled
def play_step(u_V: float, r_V: FloatArray, state_V: FloatArray) -> None:
    """Advance n plays by one input, in place (2.4). ``r_V``, ``state_V``: (n,) V."""
    for i in range(r_V.size):
        state_V[i] = max(u_V - r_V[i], min(u_V + r_V[i], state_V[i]))


@compiled
def _run(u_V: FloatArray, r_V: FloatArray, state_V: FloatArray, out_V: FloatArray) -> None:
    for k in range(u_V.size):
        play_step(u_V[k], r_V, state_V)
        for i in range(r_V.size):
            out_V[k, i] = state_V[i]


def play_start(u_V: float, r_V: FloatArray, y0_V: float = 0.0) -> FloatArray:
    """Initial states (n,) V at the first input ``u_V`` (2.5), for thresholds ``r_V`` (n,) V."""
    state = np.full(r_V.size, float(y0_V))
    play_step(float(u_V), r_V, state)
    return state


def play_run(u_V: FloatArray, r_V: FloatArray, state_V: FloatArray) -> FloatArray:
    """Outputs (samples, n) V for inputs ``u_V`` (samples,); ``state_V`` (n,) is advanced in place."""
    out = np.empty((u_V.size, r_V.size))
    _run(np.ascontiguousarray(u_V, dtype=np.float64), r_V, state_V, out)
    return out


@compiled
def dead_zone_sum(y_um: float, d_um: FloatArray, weight: FloatArray) -> float:
    """Weighted sum of the dead zones of one value (2.9). ``d_um``, ``weight``: (m+1,), thresholds ascending from 0."""
    total = 0.0
    for j in range(d_um.size):
        if d_um[j] > 0.0:
            if y_um > d_um[j]:
                total += weight[j] * (y_um - d_um[j])
        else:
            total += weight[j] * y_um
    return total


def dead_zone(y_um: FloatArray, d_um: FloatArray) -> FloatArray:
    """Outputs (n, m+1) µm of dead zones (2.8) with thresholds ``d_um`` (m+1,) for ``y_um`` (n,)."""
    shifted = y_um[:, None] - d_um[None, :]
    return np.where(d_um[None, :] > 0.0, np.maximum(shifted, 0.0), y_um[:, None])


def ramps(y_um: FloatArray, d_um: FloatArray) -> FloatArray:
    """The curves of the dead zones in another basis, (n, m+1): column j rises only between d_j and d_{j+1}, by 1 µm/µm.

    A sum of dead zones is invertible when all partial sums of its weights are positive. In this basis the weights are
    those partial sums, the slopes of the segments, so invertibility is a lower bound on each weight.
    """
    columns = dead_zone(y_um, d_um)
    columns[:, :-1] -= columns[:, 1:]
    return columns


def slopes_to_weights(slopes: FloatArray) -> FloatArray:
    """Dead-zone weights (m+1,) from the slopes of the segments (m+1,)."""
    return np.diff(slopes, prepend=0.0)
