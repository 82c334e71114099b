"""The play (backlash) operator (2.4), (2.5): thresholds in volts of the input, any number of them at once.

A walk up and down a loop, threshold 1 V, from rest::

    >>> import numpy as np
    >>> from baselines.prandtl_ishlinskii.play import play_run, play_start
    >>> walk_V = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 2.5, 1.0, 0.5, 0.0, 3.0])
    >>> state = play_start(0.0, np.array([1.0]))
    >>> play_run(walk_V, np.array([1.0]), state)[:, 0].tolist()
    [0.0, 0.0, 0.0, 1.0, 2.0, 2.0, 2.0, 1.5, 1.0, 2.0]

Up to 1 V nothing moves; then the play follows 1 V behind; at the reversal it rests until the input has come
back by 2 V, and follows 1 V above. The way back up to 3 V closes the loop at the 2 V where it was left:
the inner excursion is wiped out. A threshold of zero passes the input through::

    >>> play_run(walk_V[:4], np.array([0.0]), play_start(0.0, np.array([0.0])))[:, 0].tolist()
    [0.0, 0.5, 1.0, 2.0]
"""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray


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
    """Initial states (2.5) at the first input ``u_V`` for thresholds ``r_V`` (n,); returns (n,) V."""
    state = np.full(r_V.size, float(y0_V))
    play_step(float(u_V), r_V, state)
    return state


def play_run(u_V: FloatArray, r_V: FloatArray, state_V: FloatArray) -> FloatArray:
    """Outputs (n_samples, n_thresholds) in V for inputs ``u_V`` (n_samples,); ``state_V`` is advanced in place."""
    out = np.empty((u_V.size, r_V.size))
    _run(np.ascontiguousarray(u_V, dtype=np.float64), r_V, state_V, out)
    return out
