"""Binary payloads of a feedforward query and of its answer (docs/protocol.md)."""

from __future__ import annotations

import struct
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import (
    FEEDFORWARD_QUERY,
    FEEDFORWARD_REPLY,
    HEADER,
    MAX_NAME_BYTES,
    MAX_SEQ,
    VERSION,
    check_finite,
    check_header,
    check_length,
    check_seq,
    check_sizes,
    column,
    decode_name,
    doubles,
    number,
)

# --- Binary payload of a feedforward query (docs/protocol.md).

#: Options: the query has accelerations (bit 0), a memory (bit 1), or samples under way (bit 2).
HAS_ACCELERATION: Final = 1
HAS_MEMORY: Final = 2
HAS_PENDING: Final = 4
#: Most samples under way in a query.
MAX_PENDING: Final = 4096
#: ``as_of`` of a query to the newest snapshot.
NEWEST: Final = -1

# version, kind, options, n, as_of, u_before_V, m, bytes of the name
_QUERY: Final = struct.Struct("<BBHIqdII")
# first sample under way, and their number
_PENDING: Final = struct.Struct("<qI")
# y, v, a of a query for one point
_ONE_POINT: Final = struct.Struct("<3d")


class Pending(NamedTuple):
    """What is under way: commanded, but not yet seen in the samples.

    Attributes
    ----------
    first : number of the first sample. y_um, u_V : (k,) desired displacement, µm, and commanded voltage, V.
    """

    first: int
    y_um: FloatArray
    u_V: FloatArray


class FeedforwardQuery(NamedTuple):
    """n desired points, one sample time apart.

    Attributes
    ----------
    y_um, v_um_per_s, a_um_per_s2 : (n,) each, finite; displacement, µm, velocity, µm/s, and acceleration, µm/s².
    memory : (m,) from the previous reply; None: start from the memory that the service tracks from the samples.
    pending : advance the tracked memory by this up to the first point; None for nothing. Not with ``memory``.
    model : name of the model to ask; empty for the default of the service.
    as_of : answer from the newest snapshot that has seen no sample after this number; NEWEST for the newest.
    u_before_V : voltage before the first point, V, for the slew limit; NaN if there is none.
    """

    y_um: FloatArray
    v_um_per_s: FloatArray
    a_um_per_s2: FloatArray
    memory: FloatArray | None = None
    model: str = ""
    as_of: int = NEWEST
    u_before_V: float = float("nan")
    pending: Pending | None = None


def encode_query(
    y_um: ArrayLike,
    v_um_per_s: ArrayLike,
    a_um_per_s2: ArrayLike | None = None,
    memory: ArrayLike | None = None,
    model: str = "",
    as_of: int = NEWEST,
    u_before_V: float = float("nan"),
    pending: Pending | None = None,
) -> bytes:
    """Payload of a query; shapes as in :class:`FeedforwardQuery`. Raises InputError with the invalid field."""
    options, m, n = 0, 0, 1
    parts = []
    if memory is not None:
        vector = column("memory", memory, least=0)
        options, m = HAS_MEMORY, vector.size
        parts.append(vector.astype("<f8", copy=False).tobytes())
    if type(y_um) is float and type(v_um_per_s) is float and type(a_um_per_s2) is float:
        options |= HAS_ACCELERATION
        parts.append(_ONE_POINT.pack(y_um, v_um_per_s, a_um_per_s2))
    else:
        y = column("y_um", y_um)
        n = y.size
        columns = [y, _same_length("v_um_per_s", v_um_per_s, n)]
        if a_um_per_s2 is not None:
            columns.append(_same_length("a_um_per_s2", a_um_per_s2, n))
            options |= HAS_ACCELERATION
        parts += [values.astype("<f8", copy=False).tobytes() for values in columns]
    if not isinstance(model, str):
        raise FieldError("model", repr(model)[:80], "a name, or an empty text for the default")
    name = model.encode()
    if len(name) > MAX_NAME_BYTES:
        raise FieldError("model", f"{len(name)} bytes", f"a name of at most {MAX_NAME_BYTES} bytes")
    under_way = b""
    if pending is not None:
        options |= HAS_PENDING
        y, u = column("pending.y_um", pending.y_um), _same_length("pending.u_V", pending.u_V, len(pending.y_um))
        first = _PENDING.pack(check_seq("pending.first", pending.first), y.size)
        under_way = b"".join((first, y.astype("<f8", copy=False).tobytes(), u.astype("<f8", copy=False).tobytes()))
    if not (isinstance(as_of, int | np.integer) and as_of == NEWEST):
        check_seq("as_of", as_of)
    head = _QUERY.pack(VERSION, FEEDFORWARD_QUERY, options, n, as_of, number("u_before_V", u_before_V), m, len(name))
    return b"".join((head, *parts, name, under_way))


def points_of(data: bytes) -> int:
    """Number of points in the payload of a query, by its header; 0 where it is too short to have one."""
    return int(HEADER.unpack_from(data)[3]) if len(data) >= HEADER.size else 0


def decode_query(data: bytes) -> FeedforwardQuery:
    """The query in a payload. Raises InputError if it is malformed, not finite, or out of bounds."""
    options, n = check_header(data, FEEDFORWARD_QUERY, _QUERY.size, HAS_ACCELERATION | HAS_MEMORY | HAS_PENDING)
    *_, as_of, u_before_V, m, name_bytes = _QUERY.unpack_from(data)
    check_sizes(m, name_bytes)
    if m and not options & HAS_MEMORY:
        raise FieldError("m", m, "0 without the option for a memory")
    if not NEWEST <= as_of <= MAX_SEQ:
        raise FieldError("as_of", as_of, "a sequence number from 0 to 2**62, or -1 for the newest")
    if u_before_V in (float("inf"), float("-inf")):
        raise FieldError("u_before_V", u_before_V, "a finite voltage in V, or NaN for none")
    columns = 3 if options & HAS_ACCELERATION else 2
    end = _QUERY.size + 8 * (m + columns * n)
    pending = _pending(data, end + name_bytes, options) if options & HAS_PENDING else None
    if pending is None:
        check_length(data, end + name_bytes)
    values = doubles(data, _QUERY.size, m + columns * n)
    memory, y, v = values[:m], values[m : m + n], values[m + n : m + 2 * n]
    a = values[m + 2 * n :] if columns == 3 else np.zeros(n)
    if not all_finite(values):
        for name, part in (("memory", memory), ("y_um", y), ("v_um_per_s", v), ("a_um_per_s2", a)):
            check_finite(name, part)
    return FeedforwardQuery(
        y, v, a, memory if options & HAS_MEMORY else None,
        decode_name(data[end : end + name_bytes]) if name_bytes else "", as_of, u_before_V, pending,
    )  # fmt: skip


def _pending(data: bytes, begin: int, options: int) -> Pending:
    """What is under way, from byte ``begin`` to the end of a query. Raises InputError if it is malformed."""
    if options & HAS_MEMORY:
        raise FieldError("pending", "a memory too", "one of the two: a memory is of the instant before y_um[0]")
    if len(data) < begin + _PENDING.size:
        raise FieldError("payload", f"{len(data)} bytes", f"at least {begin + _PENDING.size}, for what is under way")
    first, k = _PENDING.unpack_from(data, begin)
    if not 1 <= k <= MAX_PENDING:
        raise FieldError("pending.k", k, f"1 to {MAX_PENDING} samples")
    check_length(data, begin + _PENDING.size + 16 * k)
    values = doubles(data, begin + _PENDING.size, 2 * k)
    pending = Pending(check_seq("pending.first", first), values[:k], values[k:])
    check_finite("pending.y_um", pending.y_um)
    check_finite("pending.u_V", pending.u_V)
    return pending


def _same_length(field: str, values: ArrayLike, n: int) -> FloatArray:
    array = column(field, values)
    if array.size != n:
        raise FieldError(field, f"{array.size} values", f"{n}, as many as y_um")
    return array


# --- The answer to a feedforward query, and its binary payload (docs/protocol.md).

#: What was done to a voltage, one bit each (docs/protocol.md).
LIMITED_VOLTAGE: Final = 1
LIMITED_SLEW: Final = 2
OUTSIDE_DOMAIN: Final = 4
NOT_FINITE_REPLACED: Final = 8
BLENDED: Final = 16
STAND_IN: Final = 32
STALE: Final = 64
CORRECTED: Final = 128
FLAG_NAMES: Final = {
    LIMITED_VOLTAGE: "limited_voltage",
    LIMITED_SLEW: "limited_slew",
    OUTSIDE_DOMAIN: "outside_domain",
    NOT_FINITE_REPLACED: "not_finite_replaced",
    BLENDED: "blended",
    STAND_IN: "stand_in",
    STALE: "stale",
    CORRECTED: "corrected",
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
    flags : bits LIMITED_VOLTAGE, LIMITED_SLEW, OUTSIDE_DOMAIN, NOT_FINITE_REPLACED, BLENDED, STAND_IN, STALE,
        CORRECTED.
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
