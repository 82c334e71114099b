"""Binary payloads of a fleet (docs/protocol.md, "A fleet"): samples, queries, replies and changes of models.

A message is of axes ``first`` to ``first + B - 1`` of the stage. Its matrices are (k, B): all axes of one sample or
point, then those of the next. A value that is not finite concerns its axis alone.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptive.types import FloatArray, IntArray
from service.fleet.settings import MOST_AXES
from service.protocol.errors import FieldError
from service.protocol.samples import VERSION, check_length, check_seq

FLEET_SAMPLES: Final = 7
FLEET_QUERY: Final = 8
FLEET_REPLY: Final = 9
FLEET_CHANGES: Final = 10
_NAMES: Final = {FLEET_SAMPLES: "fleet samples", FLEET_QUERY: "fleet query", FLEET_REPLY: "fleet reply",
                 FLEET_CHANGES: "fleet changes"}  # fmt: skip
#: Options of a query: it has a memory (bit 0), voltages before the first point (bit 1).
HAS_MEMORY: Final = 1
HAS_BEFORE: Final = 2
#: A point of a reply was refused because its query was not finite or out of range: its voltage is NaN, hold the last.
REFUSED: Final = 128
#: Most values of one matrix.
MOST_VALUES: Final = 2**22

# version, kind, options, axes B, first axis, rows k, columns m of the memory
_HEAD: Final = struct.Struct("<BBHIIII")
_SEQ: Final = struct.Struct("<q")


@dataclass(frozen=True, slots=True)
class FleetSamples:
    """k samples of B axes: ``seq`` (k,), ``t_s`` (k,) s, ``u_V`` and ``y_um`` (k, B). Both NaN: the axis is missing."""

    first: int
    seq: IntArray
    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray


class FleetQuery(NamedTuple):
    """k points of B axes: y, v, a (k, B) µm, µm/s, µm/s²; memory (B, m) or None; u_before_V (B,) or None."""

    first: int
    y_um: FloatArray
    v_um_per_s: FloatArray
    a_um_per_s2: FloatArray
    memory: FloatArray | None
    u_before_V: FloatArray | None


class FleetReply(NamedTuple):
    """u_V, std_V (k, B) V, flags (k, B) as of a feedforward reply, and REFUSED; memory (B, m) after the last point.

    snapshot_seq : of the newest sample that any of the models has seen, -1 before any.
    """

    first: int
    snapshot_seq: int
    u_V: FloatArray
    std_V: FloatArray
    flags: NDArray[np.uint8]
    memory: FloatArray


class FleetChanges(NamedTuple):
    """Models that have changed: axes (n,), their frames (n, 2) gain and offset in µm, and linear parts (n, p) V."""

    snapshot_seq: int
    axes: IntArray
    frames: FloatArray
    beta: FloatArray


def _pack(kind: int, options: int, shape: tuple[int, int, int, int], *parts: ArrayLike) -> bytes:
    rows = [np.ascontiguousarray(part) for part in parts]
    return _HEAD.pack(VERSION, kind, options, *shape) + b"".join(row.tobytes() for row in rows)


def _unpack(data: bytes, kind: int, allowed: int = 0) -> tuple[int, int, int, int, int]:
    """(options, B, first, k, m). Raises InputError naming the field."""
    if len(data) < _HEAD.size:
        raise FieldError("payload", f"{len(data)} bytes", f"at least {_HEAD.size} for the kind '{_NAMES[kind]}'")
    version, got, options, axes, first, rows, columns = _HEAD.unpack_from(data)
    for name, value, good, expected in (
        ("version", version, version == VERSION, str(VERSION)),
        ("kind", got, got == kind, f"{kind} ({_NAMES[kind]})"),
        ("options", f"0x{options:04x}", not options & ~allowed, f"no bit outside 0x{allowed:04x}"),
        ("axes", axes, 1 <= axes <= MOST_AXES, f"1 to {MOST_AXES}"),
        ("first", first, first < MOST_AXES, f"an axis below {MOST_AXES}"),
        ("rows", rows, rows >= 1 and rows * axes <= MOST_VALUES, f"1 to {MOST_VALUES} values in all"),
        ("columns", columns, columns * axes <= MOST_VALUES, f"at most {MOST_VALUES} values in all"),
    ):
        if not good:
            raise FieldError(name, value, expected)
    return options, axes, first, rows, columns


def _take(data: bytes, at: int, *shape: int) -> tuple[FloatArray, int]:
    count = int(np.prod(shape))
    values = np.frombuffer(data, dtype="<f8", count=count, offset=at).astype(np.float64)
    return values.reshape(shape), at + 8 * count


def _matrix(name: str, values: ArrayLike, rows: int | None = None) -> FloatArray:
    array = np.atleast_2d(np.asarray(values, dtype="<f8"))
    if array.ndim != 2 or (rows is not None and array.shape[0] != rows):
        raise FieldError(name, f"shape {array.shape}", f"({rows or 'k'}, axes)")
    return array


def encode_fleet_samples(seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, first: int = 0) -> bytes:
    """A message of k samples; seq, t_s (k,) or numbers, u_V and y_um (k, B), or (B,) of one sample."""
    numbers, times = np.atleast_1d(np.asarray(seq, dtype="<i8")), np.atleast_1d(np.asarray(t_s, dtype="<f8"))
    u, y = _matrix("u_V", u_V, numbers.size), _matrix("y_um", y_um, numbers.size)
    if u.shape != y.shape or times.shape != numbers.shape:
        raise FieldError("y_um", f"shapes {times.shape}, {u.shape}, {y.shape}", "one time a sample, equal matrices")
    return _pack(FLEET_SAMPLES, 0, (u.shape[1], first, numbers.size, 0), numbers, times, u, y)


def decode_fleet_samples(data: bytes) -> FleetSamples:
    """The samples of a message. Raises InputError where it is malformed; values are not checked."""
    _, axes, first, k, m = _unpack(data, FLEET_SAMPLES)
    if m:
        raise FieldError("columns", m, "0 in samples")
    check_length(data, _HEAD.size + 16 * k * (1 + axes))
    seq = np.frombuffer(data, dtype="<i8", count=k, offset=_HEAD.size).astype(np.int64)
    for number in (int(seq.min()), int(seq.max())):
        check_seq("seq", number)
    t_s, at = _take(data, _HEAD.size + 8 * k, k)
    u, at = _take(data, at, k, axes)
    y, _ = _take(data, at, k, axes)
    return FleetSamples(first, seq, t_s, u, y)


def encode_fleet_query(
    y_um: ArrayLike,
    v_um_per_s: ArrayLike,
    a_um_per_s2: ArrayLike,
    memory: ArrayLike | None = None,
    u_before_V: ArrayLike | None = None,
    first: int = 0,
) -> bytes:
    """A query of k points, (k, B) or (B,); see `FleetQuery`."""
    y = _matrix("y_um", y_um)
    parts = [y, _matrix("v_um_per_s", v_um_per_s, y.shape[0]), _matrix("a_um_per_s2", a_um_per_s2, y.shape[0])]
    if len({part.shape for part in parts}) != 1:
        raise FieldError("v_um_per_s", f"shapes {[part.shape for part in parts]}", "three of equal shape")
    options, m = 0, 0
    if memory is not None:
        kept = _matrix("memory", memory, y.shape[1])
        options, m = HAS_MEMORY, kept.shape[1]
        parts.append(kept)
    if u_before_V is not None:
        options |= HAS_BEFORE
        parts.append(_matrix("u_before_V", u_before_V, 1))
    return _pack(FLEET_QUERY, options, (y.shape[1], first, y.shape[0], m), *parts)


def decode_fleet_query(data: bytes) -> FleetQuery:
    """The query in a payload. Raises InputError where it is malformed; values are not checked."""
    options, axes, first, k, m = _unpack(data, FLEET_QUERY, HAS_MEMORY | HAS_BEFORE)
    if bool(m) != bool(options & HAS_MEMORY):
        raise FieldError("columns", m, "the size of a memory with its option, 0 without")
    before = axes if options & HAS_BEFORE else 0
    check_length(data, _HEAD.size + 8 * (3 * k * axes + m * axes + before))
    y, at = _take(data, _HEAD.size, k, axes)
    v, at = _take(data, at, k, axes)
    a, at = _take(data, at, k, axes)
    memory, at = _take(data, at, axes, m)
    u, _ = _take(data, at, before)
    return FleetQuery(first, y, v, a, memory if m else None, u if before else None)


def encode_fleet_reply(reply: FleetReply) -> bytes:
    """Payload of a reply."""
    k, axes = reply.u_V.shape
    head = np.array([reply.snapshot_seq], dtype="<i8")
    return _pack(
        FLEET_REPLY, 0, (axes, reply.first, k, reply.memory.shape[1]), head, reply.u_V, reply.std_V, reply.memory,
        reply.flags,
    )  # fmt: skip


def decode_fleet_reply(data: bytes) -> FleetReply:
    """The reply in a payload. Raises InputError where it is malformed."""
    _, axes, first, k, m = _unpack(data, FLEET_REPLY)
    check_length(data, _HEAD.size + 8 + 17 * k * axes + 8 * axes * m)
    (seq,) = _SEQ.unpack_from(data, _HEAD.size)
    u, at = _take(data, _HEAD.size + 8, k, axes)
    std, at = _take(data, at, k, axes)
    memory, at = _take(data, at, axes, m)
    flags = np.frombuffer(data, dtype=np.uint8, offset=at).reshape(k, axes).copy()
    return FleetReply(first, seq, u, std, flags, memory)


def encode_fleet_changes(changes: FleetChanges) -> bytes:
    """Payload of changed models; rows are the models, columns the size of the linear part."""
    n, p = changes.beta.shape
    head = np.concatenate(([changes.snapshot_seq], changes.axes)).astype("<i8")
    return _pack(FLEET_CHANGES, 0, (n, 0, 1, p), head, changes.frames, changes.beta)


def decode_fleet_changes(data: bytes) -> FleetChanges:
    """The changed models in a payload. Raises InputError where it is malformed."""
    _, n, _, _, p = _unpack(data, FLEET_CHANGES)
    check_length(data, _HEAD.size + 8 * (1 + n + n * (2 + p)))
    head = np.frombuffer(data, dtype="<i8", count=1 + n, offset=_HEAD.size).astype(np.int64)
    frames, at = _take(data, _HEAD.size + 8 * (1 + n), n, 2)
    beta, _ = _take(data, at, n, p)
    return FleetChanges(int(head[0]), head[1:], frames, beta)
