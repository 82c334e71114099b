"""Taking over hyper-parameters that were tuned elsewhere: refused unless better, and without a jump of the output."""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from adaptive.errors import DehystError

if TYPE_CHECKING:
    from adaptive.online.learner_parts import Parts
    from adaptive.types import Hyperparameters

#: Samples on which the old and the new are compared: the newest that the window holds.
NEWEST = 100
#: What is served may move by this many of its stated deviations (rms over the newest samples).
MOST_MOVED = 2.0


def adopt(parts: Parts, hyper: Hyperparameters) -> str:
    """Let the window of ``parts`` go on with other hyper-parameters. Returns "", or why they were refused.

    The window is factored anew over its own samples: O(N³), once. The linear part stays but for its constant, which
    takes up the difference at the last point that taught, so that what is served there does not jump. Refused, and
    nothing changed, where the kernel matrix can't be factored, where each of the newest samples is foretold worse by
    all others (rms of the exact leave-one-out residuals), or where the output would move too far.
    """
    window = parts.window
    try:
        challenger = window.with_hyperparameters(hyper)
        now_V, then_V = challenger.newest_error_V(NEWEST), window.newest_error_V(NEWEST)
    except DehystError as error:
        return f"numerics: {error}"
    if not now_V <= then_V:
        return f"worse: {now_V:.3g} V rms on the newest samples, {then_V:.3g} V as it is"
    point = parts.point
    shift_V = window.mean(point) - challenger.mean(point) if np.all(np.isfinite(point)) else 0.0
    moves_V = np.array([challenger.mean(x) + shift_V - window.mean(x) for x in window.newest(NEWEST)])
    moved_V = max(abs(shift_V), sqrt(float(np.mean(moves_V**2))) if moves_V.size else 0.0)
    limit_V = MOST_MOVED * sqrt(parts.judgement.variance_V2)
    if not moved_V <= limit_V:
        return f"jump: the output would move by {moved_V:.3g} V, {limit_V:.3g} V is the most"
    parts.window = challenger
    parts.shift_constant(shift_V)
    return ""
