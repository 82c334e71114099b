"""How a query continues from the answer before it: its memory, its last voltage, and what is under way.

Under way are the samples that are commanded and not yet seen by the service.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from adaptive.types import FloatArray
from service.protocol.errors import FieldError
from service.protocol.query import MAX_PENDING, Pending, Point, Trajectory

#: Fewest samples under way that are kept. Only those after the newest snapshot matter, some tens of samples.
#: While no samples arrive, all since that snapshot are kept, up to MAX_PENDING, because the stage may have turned.
UNDER_WAY: Final = 512


def pending_before(after: Point | Trajectory | None, begin: int) -> Pending | None:
    """What is under way before sample ``begin``; None for nothing.

    It is what ``after`` left, without the samples from ``begin`` on. Between its end and ``begin`` nothing was
    commanded: the stage holds the last voltage there.
    """
    if after is None or after.pending is None or begin <= after.pending.first:
        return None
    first, y_um, u_V = after.pending
    wanted = begin - first
    if wanted >= y_um.size + UNDER_WAY:
        return None
    held = max(wanted - y_um.size, 0)
    y_um, u_V = np.pad(y_um, (0, held), "edge")[:wanted], np.pad(u_V, (0, held), "edge")[:wanted]
    kept = min(wanted, max(UNDER_WAY, min(begin - after.snapshot_seq, MAX_PENDING)))
    return Pending(begin - kept, y_um[-kept:], u_V[-kept:])


def extended(before: Pending | None, begin: int, y_um: FloatArray, u_V: FloatArray) -> Pending:
    """``before`` and the (n,) samples from ``begin`` on."""
    if before is None:
        return Pending(begin, y_um, u_V)
    return Pending(before.first, np.concatenate([before.y_um, y_um]), np.concatenate([before.u_V, u_V]))


def with_pending(answer: Trajectory, before: Pending | None, begin: int, y_um: FloatArray) -> Trajectory:
    """``answer`` to (n,) ``y_um``, commanded from sample ``begin`` on, behind what is under way ``before`` it."""
    return answer._replace(pending=extended(before, begin, y_um, answer.u_V))


@dataclass(slots=True)
class PendingCommands:
    """The commands under way of a loop in one process, which asks as a client that gives ``begin``."""

    answer: Trajectory | None = None

    def before(self, begin: int) -> Pending | None:
        """What is under way before sample ``begin``."""
        return pending_before(self.answer, begin)

    def take(self, begin: int, y_um: FloatArray, answer: Trajectory) -> None:
        """Note that the (n,) voltages of ``answer`` to ``y_um``, µm, are commanded from sample ``begin`` on."""
        self.answer = with_pending(answer, self.before(begin), begin, y_um)


def continued(
    memory: ArrayLike | None, model: str, u_before_V: float, after: Point | Trajectory | None, begin: int | None = None
) -> dict[str, Any]:
    """Arguments ``memory``, ``model``, ``u_before_V`` (and ``pending``) of a query that continues from ``after``.

    Arguments that are given are kept. With ``begin``, the number of the first sample of the query, ``pending`` replaces
    the memory. Raises InputError if both ``memory`` and ``begin`` are given.
    """
    if begin is not None:
        if memory is not None:
            raise FieldError("memory", "memory and begin", "one of the two: with begin the service tracks the memory")
        under = pending_before(after, begin)
        asked = continued(np.empty(0), model, u_before_V, after)
        # The answer may replace the end of the one before: then the last voltage under way is the one before it.
        before_V = float(under.u_V[-1]) if under is not None and math.isnan(u_before_V) else asked["u_before_V"]
        return asked | {"memory": None, "pending": under, "u_before_V": before_V}
    if after is not None:
        memory = after.memory if memory is None else memory
        model = model or after.model
        if math.isnan(u_before_V):
            u_before_V = after.u_V if isinstance(after.u_V, float) else float(after.u_V[-1])
    return {"memory": memory, "model": model, "u_before_V": u_before_V}
