"""What a client gets for a query, and what of it goes into the next one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptive.types import FloatArray
from service.protocol.errors import FieldError
from service.protocol.query import Pending
from service.protocol.reply import FeedforwardReply

#: Samples under way that are kept: those after the newest snapshot matter, which is some tens of samples old.
UNDER_WAY: Final = 512


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The answer to a trajectory.

    Attributes
    ----------
    u_V, std_V : (n,) voltage and its standard deviation, V.
    flags : (n,) bits, see :func:`service.protocol.reply.flag_names`.
    memory : (m,) hysteresis memory after the last point. model : that answered. snapshot_seq : the last sample it
    had seen. fallback : whether something went wrong and a stand-in answered for it. tracked_memory : whether the
    memory was the service's own. stand_in : name of the model that answered, in part or whole, where the flags say so.
    pending : what is under way once it has been commanded, where ``begin`` was given.
    """

    u_V: FloatArray
    std_V: FloatArray
    flags: NDArray[np.uint8]
    memory: FloatArray
    model: str
    snapshot_seq: int
    fallback: bool
    tracked_memory: bool
    stand_in: str = ""
    pending: Pending | None = None


@dataclass(frozen=True, slots=True)
class Point:
    """The answer to one point; as :class:`Trajectory`, with ``u_V``, ``std_V`` and ``flags`` as numbers."""

    u_V: float
    std_V: float
    flags: int
    memory: FloatArray
    model: str
    snapshot_seq: int
    fallback: bool
    tracked_memory: bool
    stand_in: str = ""
    pending: Pending | None = None


def as_trajectory(reply: FeedforwardReply, pending: Pending | None = None) -> Trajectory:
    """All points of a reply."""
    return Trajectory(
        reply.u_V, reply.std_V, reply.flags, reply.memory, reply.model, reply.snapshot_seq, reply.fallback,
        reply.tracked_memory, reply.stand_in, pending,
    )  # fmt: skip


def as_point(reply: FeedforwardReply, pending: Pending | None = None) -> Point:
    """The one point of a reply."""
    return Point(
        float(reply.u_V[0]), float(reply.std_V[0]), int(reply.flags[0]), reply.memory, reply.model, reply.snapshot_seq,
        reply.fallback, reply.tracked_memory, reply.stand_in, pending,
    )  # fmt: skip


def under_way(after: Point | Trajectory | None, begin: int) -> Pending | None:
    """What is under way before sample ``begin``: what ``after`` left, replaced from ``begin`` on; None for nothing.

    Over samples for which nothing was commanded the stage has held its last voltage.
    """
    if after is None or after.pending is None or begin <= after.pending.first:
        return None
    first, y_um, u_V = after.pending
    wanted = begin - first
    if wanted >= y_um.size + UNDER_WAY:
        return None
    held = max(wanted - y_um.size, 0)
    y_um, u_V = np.pad(y_um, (0, held), "edge")[:wanted], np.pad(u_V, (0, held), "edge")[:wanted]
    return Pending(begin - min(wanted, UNDER_WAY), y_um[-UNDER_WAY:], u_V[-UNDER_WAY:])


def extended(before: Pending | None, begin: int, y_um: FloatArray, u_V: FloatArray) -> Pending:
    """``before`` and the (n,) samples from ``begin`` on."""
    if before is None:
        return Pending(begin, y_um, u_V)
    return Pending(before.first, np.concatenate([before.y_um, y_um]), np.concatenate([before.u_V, u_V]))


@dataclass(slots=True)
class Commanded:
    """What a run in one process has commanded so far: it asks as a client on the wire does that gives ``begin``."""

    answer: Trajectory | None = None

    def before(self, begin: int) -> Pending | None:
        """What is under way before sample ``begin``."""
        return under_way(self.answer, begin)

    def take(self, begin: int, y_um: FloatArray, reply: FeedforwardReply) -> None:
        """The (n,) voltages of ``reply`` for ``y_um``, µm, are commanded from sample ``begin`` on."""
        self.answer = as_trajectory(reply, extended(self.before(begin), begin, y_um, reply.u_V))


def continued(
    memory: ArrayLike | None, model: str, u_before_V: float, after: Point | Trajectory | None, begin: int | None = None
) -> dict[str, Any]:
    """Memory, model and voltage before of a query that goes on from the answer ``after`` where they are not given.

    With ``begin``, the number of its first sample, what is under way takes the place of the memory.
    """
    if begin is not None:
        if memory is not None:
            raise FieldError("memory", "one beside begin", "one of the two: with begin the service tracks the memory")
        under = under_way(after, begin)
        asked = continued(np.empty(0), model, u_before_V, after)
        # The voltage before the first point is that of the sample before it, also where the last answer is replaced.
        before_V = float(under.u_V[-1]) if under is not None and math.isnan(u_before_V) else asked["u_before_V"]
        return asked | {"memory": None, "pending": under, "u_before_V": before_V}
    if after is not None:
        memory = after.memory if memory is None else memory
        model = model or after.model
        if math.isnan(u_before_V):
            u_before_V = after.u_V if isinstance(after, Point) else float(after.u_V[-1])
    return {"memory": memory, "model": model, "u_before_V": u_before_V}
