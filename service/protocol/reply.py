"""The answer to a feedforward query, and its binary payload (docs/protocol.md)."""

from __future__ import annotations

import struct
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.protocol.errors import FieldError
from service.protocol.query import Pending
from service.protocol.samples import (
    FEEDFORWARD_REPLY,
    VERSION,
    check_finite,
    check_header,
    check_length,
    check_sizes,
    decode_name,
    doubles,
)

#: What was done to a voltage, one bit each (docs/protocol.md).
LIMITED_VOLTAGE: Final = 1
LIMITED_SLEW: Final = 2
OUTSIDE_DOMAIN: Final = 4
NOT_FINITE_REPLACED: Final = 8
BLENDED: Final = 16
STAND_IN: Final = 32
STALE: Final = 64
FLAG_NAMES: Final = {
    LIMITED_VOLTAGE: "limited_voltage",
    LIMITED_SLEW: "limited_slew",
    OUTSIDE_DOMAIN: "outside_domain",
    NOT_FINITE_REPLACED: "not_finite_replaced",
    BLENDED: "blended",
    STAND_IN: "stand_in",
    STALE: "stale",
}

#: Options of a reply: the learner has not yet handled all samples that ``as_of`` covers, so that the same query may get
#: another answer later; the query had no memory and the service used its own; another model than the asked one answered
#: in part or completely because something went wrong; the name of the stand-in follows the name of the asked model.
BEHIND: Final = 1
TRACKED_MEMORY: Final = 2
FALLBACK: Final = 4
HAS_STAND_IN: Final = 8

#: ``snapshot_seq`` of a snapshot from before the first sample.
_LEAST_SEQ: Final = -1

# version, kind, options, n, snapshot_seq, m, bytes of the name
_REPLY: Final = struct.Struct("<BBHIqII")


Voltage = TypeVar("Voltage")
Flag = TypeVar("Flag")


class Answer(NamedTuple, Generic[Voltage, Flag]):
    """Voltages for desired points, from the model to the client: `Trajectory` for (n,) points, `Point` for one.

    Attributes
    ----------
    u_V : voltage, V; finite and within the limits.
    std_V : one standard deviation, V; NaN if the model does not state it.
    flags : bits LIMITED_VOLTAGE, LIMITED_SLEW, OUTSIDE_DOMAIN, NOT_FINITE_REPLACED, BLENDED, STAND_IN, STALE.
    memory : (m,) hysteresis memory after the last point, for the next query.
    snapshot_seq : number of the last sample that the answering snapshot has seen; -1 before any.
    model : name of the model that was asked.
    behind, tracked_memory, fallback : the options of the reply, see the constants of this module.
    stand_in : name of the stand-in. It answered the points with the flag STAND_IN or NOT_FINITE_REPLACED, and with a
        share the points with the flag BLENDED. Empty if there are none.
    pending : what is under way once the answer has been commanded; set by a client that was given ``begin``.
    """

    u_V: Voltage
    std_V: Voltage
    flags: Flag
    memory: FloatArray
    snapshot_seq: int = -1
    model: str = ""
    behind: bool = False
    tracked_memory: bool = False
    fallback: bool = False
    stand_in: str = ""
    pending: Pending | None = None


Trajectory = Answer[FloatArray, NDArray[np.uint8]]
Point = Answer[float, int]


def encode_reply(reply: Trajectory) -> bytes:
    """Payload of a reply; ``pending`` is not part of it."""
    options = BEHIND * reply.behind | TRACKED_MEMORY * reply.tracked_memory | FALLBACK * reply.fallback
    name = reply.model.encode()
    if reply.stand_in:
        options |= HAS_STAND_IN
        name += b"/" + reply.stand_in.encode()
    n, m = reply.u_V.size, reply.memory.size
    return b"".join(
        (
            _REPLY.pack(VERSION, FEEDFORWARD_REPLY, options, n, reply.snapshot_seq, m, len(name)),
            reply.u_V.astype("<f8", copy=False).tobytes(),
            reply.std_V.astype("<f8", copy=False).tobytes(),
            reply.memory.astype("<f8", copy=False).tobytes(),
            reply.flags.tobytes(),
            name,
        )
    )


def decode_reply(data: bytes) -> Trajectory:
    """The reply in a payload. Raises InputError if it is malformed or a voltage is not finite."""
    options, n = check_header(data, FEEDFORWARD_REPLY, _REPLY.size, BEHIND | TRACKED_MEMORY | FALLBACK | HAS_STAND_IN)
    *_, snapshot_seq, m, name_bytes = _REPLY.unpack_from(data)
    check_sizes(m, name_bytes // 2)
    if snapshot_seq < _LEAST_SEQ:
        raise FieldError("snapshot_seq", snapshot_seq, "-1 or more")
    end = _REPLY.size + 8 * (2 * n + m)
    check_length(data, end + n + name_bytes)
    values = doubles(data, _REPLY.size, 2 * n + m)
    u, std, memory = values[:n], values[n : 2 * n], values[2 * n :]
    check_finite("u_V", u)
    check_finite("memory", memory)
    flags = np.frombuffer(data, dtype=np.uint8, count=n, offset=end)
    name, stand_in = decode_name(data[end + n :]), ""
    if options & HAS_STAND_IN:
        name, _, stand_in = name.partition("/")
    return Answer(
        u,
        std,
        flags,
        memory,
        snapshot_seq,
        name,
        bool(options & BEHIND),
        bool(options & TRACKED_MEMORY),
        bool(options & FALLBACK),
        stand_in,
    )


def flag_names(bits: int) -> list[str]:
    """The names of the bits set in a point's flags."""
    return [name for bit, name in FLAG_NAMES.items() if bits & bit]
