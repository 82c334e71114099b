"""Binary payloads of a fleet (docs/protocol.md, "A fleet"): samples, queries, replies and changes of models.

A message is of axes ``first`` to ``first + B - 1`` of the stage. Its matrices are (k, B): all axes of one sample or
point, then those of the next. A value that is not finite concerns its axis alone.
"""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

import numpy as np

from dehyst.service.fleet.settings import MOST_AXES
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import (
    FLEET_CHANGES,
    FLEET_QUERY,
    FLEET_REPLY,
    FLEET_SAMPLES,
    HEADER,
    VERSION,
    check_header,
    check_length,
    check_seq,
)

#: What follows the header, in order: name, type, sizes.
_LAYOUT: Final[dict[int, tuple[tuple[str, str, str], ...]]] = {
    FLEET_SAMPLES: (("seq", "<i8", "k"), ("t_s", "<f8", "k"), ("u_V", "<f8", "kB"), ("y_um", "<f8", "kB")),
    FLEET_QUERY: (
        ("y_um", "<f8", "kB"), ("v_um_per_s", "<f8", "kB"), ("a_um_per_s2", "<f8", "kB"), ("memory", "<f8", "Bm"),
        ("u_before_V", "<f8", "B"),
    ),
    FLEET_REPLY: (
        ("snapshot_seq", "<i8", "1"), ("u_V", "<f8", "kB"), ("std_V", "<f8", "kB"), ("memory", "<f8", "Bm"),
        ("flags", "<u1", "kB"),
    ),
    FLEET_CHANGES: (("snapshot_seq", "<i8", "1"), ("axes", "<i8", "B"), ("frames", "<f8", "B2"), ("beta", "<f8", "Bm")),
}  # fmt: skip
#: Parts of a query that may be left out, and the bits of its options that say that they are there.
_OPTIONS: Final = {"memory": 1, "u_before_V": 2}
#: A point of a reply was refused because its query was not finite or out of range: its voltage is NaN, hold the last.
REFUSED: Final = 128
#: Most values of one matrix.
MOST_VALUES: Final = 2**22

#: Behind the header of all payloads, whose count is the number of axes B: first axis, rows k, columns m.
_SIZES: Final = struct.Struct("<III")


class FleetMessage(NamedTuple):
    """A message of ``axes`` axes from ``first`` on, and its arrays by name; those of a query that it lacks are None."""

    first: int
    axes: int
    rows: int
    parts: dict[str, Any]


def _parts_of(kind: int, options: int) -> list[tuple[str, str, str]]:
    """The parts of a message, without those that its options leave out."""
    absent = [name for name, bit in _OPTIONS.items() if kind == FLEET_QUERY and not options & bit]
    return [part for part in _LAYOUT[kind] if part[0] not in absent]


def encode_fleet(kind: int, first: int = 0, **parts: Any) -> bytes:
    """A payload of ``kind``; parts as in docs/protocol.md, (k,), (k, B) and (B, m). Raises InputError on shapes."""
    given = [name for name in _OPTIONS if kind == FLEET_QUERY and parts.get(name) is not None]
    options, sizes, body = sum(_OPTIONS[name] for name in given), {"1": 1, "2": 2}, []
    for name, dtype, letters in _parts_of(kind, options):
        values = np.ascontiguousarray(parts[name], dtype=dtype)
        expected = tuple(sizes.setdefault(*pair) for pair in zip(letters, values.shape, strict=False))
        if values.ndim != len(letters) or values.shape != expected:
            raise FieldError(name, f"shape {values.shape}", f"({', '.join(letters)}), as of the other parts")
        body.append(values.tobytes())
    head = HEADER.pack(VERSION, kind, options, sizes["B"])
    return b"".join((head, _SIZES.pack(first, sizes.get("k", 1), sizes.get("m", 0)), *body))


def decode_fleet(kind: int, data: bytes) -> FleetMessage:
    """The message in a payload of ``kind``. Raises InputError where it is malformed; values are not checked."""
    begin = HEADER.size + _SIZES.size
    options, axes = check_header(data, kind, begin, sum(_OPTIONS.values()) if kind == FLEET_QUERY else 0)
    first, rows, columns = _SIZES.unpack_from(data, HEADER.size)
    there = _parts_of(kind, options)
    wide = any("m" in letters for _, _, letters in there)
    for name, value, good, expected in (
        ("axes", axes, axes <= MOST_AXES, f"1 to {MOST_AXES}"),
        ("first", first, first < MOST_AXES, f"an axis below {MOST_AXES}"),
        ("rows", rows, rows >= 1 and rows * axes <= MOST_VALUES, f"1 to {MOST_VALUES} values in all"),
        ("columns", columns, columns * axes <= MOST_VALUES, f"at most {MOST_VALUES} values in all"),
        ("columns", columns, bool(columns) == wide, "the size of a memory or linear part, 0 without"),
    ):
        if not good:
            raise FieldError(name, value, expected)
    sizes = {"k": rows, "B": axes, "m": columns, "1": 1, "2": 2}
    layout = np.dtype([(name, dtype, tuple(sizes[letter] for letter in letters)) for name, dtype, letters in there])
    check_length(data, begin + layout.itemsize)
    body = np.frombuffer(data, layout, 1, begin)[0]
    parts: dict[str, Any] = {name: None for name, _, _ in _LAYOUT[kind]}
    parts |= {name: body[name].astype(body[name].dtype.newbyteorder("=")) for name, _, _ in there}
    for number in parts["seq"].tolist() if "seq" in parts else ():
        check_seq("seq", number)
    return FleetMessage(first, axes, rows, parts)
