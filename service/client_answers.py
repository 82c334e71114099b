"""What a client gets for a query, and what of it goes into the next one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptive.types import FloatArray
from service.wire_query import FeedforwardReply


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The answer to a trajectory.

    Attributes
    ----------
    u_V, std_V : (n,) voltage and its standard deviation, V.
    flags : (n,) bits, see :func:`service.wire_query.flag_names`.
    memory : (m,) hysteresis memory after the last point. model : that answered. snapshot_seq : the last sample it
    had seen. fallback : whether something went wrong and a stand-in answered for it. tracked_memory : whether the
    memory was the service's own. stand_in : name of the model that answered, in part or whole, where the flags say so.
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


def as_trajectory(reply: FeedforwardReply) -> Trajectory:
    """All points of a reply."""
    return Trajectory(
        reply.u_V, reply.std_V, reply.flags, reply.memory, reply.model, reply.snapshot_seq, reply.fallback,
        reply.tracked_memory, reply.stand_in,
    )  # fmt: skip


def as_point(reply: FeedforwardReply) -> Point:
    """The one point of a reply."""
    return Point(
        float(reply.u_V[0]), float(reply.std_V[0]), int(reply.flags[0]), reply.memory, reply.model, reply.snapshot_seq,
        reply.fallback, reply.tracked_memory, reply.stand_in,
    )  # fmt: skip


def continued(
    memory: ArrayLike | None, model: str, u_before_V: float, after: Point | Trajectory | None
) -> dict[str, Any]:
    """Memory, model and voltage before of a query that goes on from the answer ``after`` where they are not given."""
    if after is not None:
        memory = after.memory if memory is None else memory
        model = model or after.model
        if math.isnan(u_before_V):
            u_before_V = after.u_V if isinstance(after, Point) else float(after.u_V[-1])
    return {"memory": memory, "model": model, "u_before_V": u_before_V}
