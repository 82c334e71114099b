"""Binary payload of the reply to a feedforward query; docs/protocol.md is the page about it."""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.protocol.errors import FieldError
from service.protocol.samples import (
    FEEDFORWARD_REPLY,
    VERSION,
    check_finite,
    check_header,
    check_length,
    check_name,
    check_sizes,
    doubles,
)

#: Reply options: the learner has not yet handled all that ``as_of`` needs, so this answer may differ from a repeated
#: one; the query brought no memory, so the service's own was used; another model than the one asked for answered in
#: part or whole because something went wrong; the name of the model that stood in follows that of the one asked.
BEHIND: Final = 1
TRACKED_MEMORY: Final = 2
FALLBACK: Final = 4
HAS_STAND_IN: Final = 8

#: Snapshots from before the first sample have this number.
_LEAST_SEQ: Final = -1

# version, kind, options, n, snapshot_seq, m, bytes of the name
_REPLY: Final = struct.Struct("<BBHIqII")


class FeedforwardReply(NamedTuple):
    """Voltages for n desired points.

    Attributes
    ----------
    u_V : (n,) finite and within the limits, V.
    std_V : (n,) one standard deviation, V; NaN where the model has no notion of it.
    flags : (n,) bits LIMITED_VOLTAGE, LIMITED_SLEW, OUTSIDE_DOMAIN, NOT_FINITE_REPLACED, BLENDED, STAND_IN, STALE.
    memory : (m,) after the last point, for the next query.
    snapshot_seq : the last sample that the answering snapshot had seen, -1 before any.
    model : name of the model that was asked.
    stand_in : name of the model that answered where the flags say NOT_FINITE_REPLACED or STAND_IN, and with a share
    where they say BLENDED; empty where no point is of it.
    behind, tracked_memory, fallback : the reply's options, see the module's constants.
    """

    u_V: FloatArray
    std_V: FloatArray
    flags: NDArray[np.uint8]
    memory: FloatArray
    snapshot_seq: int
    model: str
    behind: bool = False
    tracked_memory: bool = False
    fallback: bool = False
    stand_in: str = ""


def encode_reply(reply: FeedforwardReply) -> bytes:
    """Payload of a reply."""
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


def decode_reply(data: bytes) -> FeedforwardReply:
    """The reply in a payload. Raises InputError where it is malformed or a voltage is not finite."""
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
    name, stand_in = check_name(data[end + n :]), ""
    if options & HAS_STAND_IN:
        name, _, stand_in = name.partition("/")
    return FeedforwardReply(
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


# --- What was done to a voltage, told with it: a byte of flags for each point of a reply.


#: What was done to a voltage, one bit each, as documented in docs/protocol.md.
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


def flag_names(bits: int) -> list[str]:
    """The names of the bits set in a point's flags."""
    return [name for bit, name in FLAG_NAMES.items() if bits & bit]
