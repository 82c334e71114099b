"""Binary payloads of the stage and the controller, and the checks that all payloads share (docs/protocol.md).

Numbers are little-endian. Every payload begins with the same eight bytes: version (u8), kind (u8), options (u16), count
n (u32); columns of n values follow. Decoding is strict: a payload of another length, version or kind is refused with an
:class:`InputError` that has the field, what was got and what was expected.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from operator import index
from typing import Any, Final, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.errors import FieldError

VERSION: Final = 1
SAMPLES: Final = 1
COMMAND: Final = 2
REFERENCE: Final = 3
FEEDFORWARD_QUERY: Final = 4
FEEDFORWARD_REPLY: Final = 5
MODEL: Final = 6
DELTA: Final = 7
FLEET_SAMPLES: Final = 8
FLEET_QUERY: Final = 9
FLEET_REPLY: Final = 10
FLEET_CHANGES: Final = 11
KIND_NAMES: Final = {
    SAMPLES: "samples",
    COMMAND: "command",
    REFERENCE: "reference",
    FEEDFORWARD_QUERY: "feedforward query",
    FEEDFORWARD_REPLY: "feedforward reply",
    MODEL: "model",
    DELTA: "model delta",
    FLEET_SAMPLES: "fleet samples",
    FLEET_QUERY: "fleet query",
    FLEET_REPLY: "fleet reply",
    FLEET_CHANGES: "fleet changes",
}

#: Longest block that is accepted, so that one message cannot use up the memory.
MAX_COUNT: Final = 65_536
MAX_SEQ: Final = 2**62
MAX_MEMORY: Final = 4096
MAX_NAME_BYTES: Final = 64

HEADER: Final = struct.Struct("<BBHI")
_BLOCK: Final = struct.Struct("<BBHIq")


@dataclass(frozen=True, slots=True)
class SampleBatch:
    """n samples of a stage: ``seq`` (n,), ``t_s`` (n,) s, ``u_V`` (n,) V, ``y_um`` (n,) µm.

    Values may be NaN or infinite: a stage reports what it measured, and the gates of the learner refuse it.
    """

    seq: NDArray[np.int64]
    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray

    def __len__(self) -> int:
        return int(self.seq.size)

    def where(self, kept: ArrayLike) -> SampleBatch:
        """The samples for which ``kept``, (n,) truth values, is true."""
        rows = np.asarray(kept, dtype=np.bool_)
        return SampleBatch(self.seq[rows], self.t_s[rows], self.u_V[rows], self.y_um[rows])


def joined(batches: Sequence[SampleBatch]) -> SampleBatch:
    """The samples of several messages in order."""
    return SampleBatch(
        *(np.concatenate([getattr(batch, name) for batch in batches]) for name in ("seq", "t_s", "u_V", "y_um"))
    )


@dataclass(frozen=True, slots=True)
class Block:
    """n consecutive finite values from sequence number ``seq`` on: voltages in V, or displacements in µm."""

    seq: int
    values: FloatArray

    def __len__(self) -> int:
        return int(self.values.size)


def check_header(data: bytes, kind: int, least_bytes: int, allowed_options: int = 0) -> tuple[int, int]:
    """(options, n) of a payload. Raises InputError if it is not of ``kind`` or shorter than ``least_bytes``."""
    if len(data) < least_bytes:
        raise FieldError(
            "payload", f"{len(data)} bytes", f"at least {least_bytes} bytes for the kind '{KIND_NAMES[kind]}'"
        )
    version, got_kind, options, n = HEADER.unpack_from(data)
    if version != VERSION:
        raise FieldError("version", version, f"{VERSION}", "use a client of the same wire version as the service")
    if got_kind != kind:
        raise FieldError("kind", f"{got_kind} ({KIND_NAMES.get(got_kind, 'unknown')})", f"{kind} ({KIND_NAMES[kind]})")
    if options & ~allowed_options:
        raise FieldError("options", f"0x{options:04x}", f"no bit outside 0x{allowed_options:04x}")
    if not 1 <= n <= MAX_COUNT:
        raise FieldError("n", n, f"1 to {MAX_COUNT}", "split a longer block into several messages")
    return options, n


def check_length(data: bytes, expected: int) -> None:
    """Raise InputError if the payload is not exactly as long as its header says."""
    if len(data) != expected:
        raise FieldError("payload", f"{len(data)} bytes", f"exactly {expected} bytes by its own header")


def check_finite(field: str, values: FloatArray) -> None:
    """Raise InputError with the first element of ``values`` that is not finite."""
    if not all_finite(values):
        bad = int(np.argmin(np.isfinite(values)))
        raise FieldError(f"{field}[{bad}]", float(values[bad]), "a finite number")


def check_seq(field: str, seq: SupportsIndex) -> int:
    """``seq`` as int. Raises InputError if it is not a sequence number."""
    try:
        checked = index(seq)
    except TypeError:
        checked = -1
    if not 0 <= checked <= MAX_SEQ:
        raise FieldError(field, repr(seq)[:80], "a sequence number from 0 to 2**62")
    return checked


def check_sizes(m: int, name_bytes: int) -> None:
    """Raise InputError if a memory or a name is too long."""
    if m > MAX_MEMORY:
        raise FieldError("m", m, f"at most {MAX_MEMORY} doubles of memory")
    if name_bytes > MAX_NAME_BYTES:
        raise FieldError("b", name_bytes, f"a name of at most {MAX_NAME_BYTES} bytes")


def decode_name(raw: bytes) -> str:
    """The name of a model. Raises InputError if it is not UTF-8."""
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise FieldError("model", repr(raw), "a name in UTF-8") from error


def doubles(data: bytes, offset: int, count: int) -> FloatArray:
    """``count`` doubles from byte ``offset`` on, as a copy."""
    return np.frombuffer(data, dtype="<f8", count=count, offset=offset).astype(np.float64)


def number(field: str, value: float) -> float:
    """``value`` as float. Raises InputError for a text, a list, an array and all else that is no number."""
    try:
        # numpy takes an array of one value for a number, with a warning.
        if isinstance(value, str | bytes | bytearray) or np.ndim(value):
            raise TypeError(value)
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise FieldError(field, repr(value)[:80], "a number") from error


def waiting_time(field: str, value: float) -> float:
    """``value`` as a time to wait, s. Raises InputError if it is no number, or negative."""
    seconds = number(field, value)
    if not seconds >= 0.0:
        raise FieldError(field, repr(value)[:80], "a time in s, not negative")
    return seconds


def column(field: str, values: ArrayLike, least: int = 1) -> FloatArray:
    """``values`` as a contiguous (n,) array of doubles. Raises InputError if it is not, or n is out of range."""
    array = np.ascontiguousarray(_of_kind(field, values, "biuf", "numbers"), dtype=np.float64)
    if array.ndim > 1:
        raise FieldError(field, f"shape {array.shape}", "one number or a one-dimensional array")
    if not least <= array.size <= MAX_COUNT:
        raise FieldError(field, f"{array.size} values", f"{least} to {MAX_COUNT} values")
    return array.reshape(-1)


def sequence(field: str, values: ArrayLike) -> NDArray[np.int64]:
    """Sample numbers (n,). Raises InputError where one is not whole."""
    array = _of_kind(field, values, "iuf", "whole numbers")
    if array.dtype.kind == "f" and not np.array_equal(array, np.rint(array)):
        raise FieldError(field, repr(values)[:80], "whole numbers, one for each sample time")
    return np.ascontiguousarray(array, dtype=np.int64).reshape(-1)


def _of_kind(field: str, values: ArrayLike, kinds: str, expected: str) -> NDArray[Any]:
    """``values`` as an array of one of the kinds of numpy's types. Texts are no numbers, even where they show some."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise FieldError(field, repr(values)[:80], expected) from error
    if array.dtype.kind not in kinds:
        raise FieldError(field, repr(values)[:80], expected)
    return array


def encode_samples(seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike) -> bytes:
    """A message of n samples; arguments are numbers or (n,). Raises InputError for unequal lengths or a bad seq."""
    numbers = sequence("seq", seq)
    columns = [column("t_s", t_s), column("u_V", u_V), column("y_um", y_um)]
    for name, values in zip(("t_s", "u_V", "y_um"), columns, strict=True):
        if values.size != numbers.size:
            raise FieldError(name, f"{values.size} values", f"{numbers.size}, as many as seq")
    check_seq("seq", int(numbers.min()))
    head = HEADER.pack(VERSION, SAMPLES, 0, numbers.size)
    return b"".join((head, numbers.astype("<i8").tobytes(), *(c.astype("<f8", copy=False).tobytes() for c in columns)))


def decode_samples(data: bytes) -> SampleBatch:
    """The samples of a message. Raises InputError if it is malformed; values are not checked."""
    _, n = check_header(data, SAMPLES, HEADER.size)
    check_length(data, HEADER.size + 32 * n)
    seq = np.frombuffer(data, dtype="<i8", count=n, offset=HEADER.size).astype(np.int64)
    check_seq("seq", int(seq.min()))
    check_seq("seq", int(seq.max()))
    rest = doubles(data, HEADER.size + 8 * n, 3 * n)
    return SampleBatch(seq, rest[:n], rest[n : 2 * n], rest[2 * n :])


def encode_command(seq: int, u_V: ArrayLike) -> bytes:
    """Voltages, V, for samples ``seq``, ``seq + 1``, …; (n,) and finite."""
    return _encode_block(COMMAND, "u_V", seq, u_V)


def decode_command(data: bytes) -> Block:
    """The block of a command. Raises InputError if it is malformed or not finite."""
    return _decode_block(COMMAND, "u_V", data)


def encode_reference(seq: int, y_um: ArrayLike) -> bytes:
    """Desired displacements, µm, at samples ``seq``, ``seq + 1``, …; (n,) and finite."""
    return _encode_block(REFERENCE, "y_um", seq, y_um)


def decode_reference(data: bytes) -> Block:
    """The block of a reference. Raises InputError if it is malformed or not finite."""
    return _decode_block(REFERENCE, "y_um", data)


def _encode_block(kind: int, field: str, seq: int, values: ArrayLike) -> bytes:
    array = column(field, values)
    check_finite(field, array)
    return _BLOCK.pack(VERSION, kind, 0, array.size, check_seq("seq", seq)) + array.astype("<f8", copy=False).tobytes()


def _decode_block(kind: int, field: str, data: bytes) -> Block:
    _, n = check_header(data, kind, _BLOCK.size)
    check_length(data, _BLOCK.size + 8 * n)
    seq = check_seq("seq", _BLOCK.unpack_from(data)[4])
    values = doubles(data, _BLOCK.size, n)
    check_finite(field, values)
    return Block(seq, values)
