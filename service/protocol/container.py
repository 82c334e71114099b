"""Forms of messages and files: JSON objects, and a container of a JSON header and arrays.

Checkpoints, model messages and model files use the container.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.types import StateDict
from dehyst.service.protocol.errors import FieldError

# --- JSON on the wire: what other processes send, and what this one answers.

#: Encoding of replies and publications that are JSON.
JSON: Final = "application/json"


def fields_of(payload: bytes) -> dict[str, Any]:
    """The fields of a JSON object; empty if ``payload`` is not one. Never raises."""
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def to_json(value: Any) -> bytes:
    """JSON of ``value``, in which numpy's numbers and arrays may be; anything else becomes its text."""
    return json.dumps(value, default=_plain).encode()


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


# --- Container of a state: a JSON header and arrays. Checkpoints, model messages and model files use it.
#
# Checkpoints and model messages have the same body behind their own fixed headers (docs/protocol.md): the header as
# UTF-8 JSON, padded with blanks to a multiple of eight bytes; then the arrays, little-endian and row-major, each padded
# with zeros to a multiple of eight bytes. The entry ``arrays`` of the header lists ``[name, type, shape]`` of each
# array in order. A model file is a ``.npz`` archive, which stores names, types and shapes itself: it shares the header
# and the division of a state into values and arrays.

UNITS: Final = {"y": "um", "u": "V", "t": "s", "v": "um/s", "a": "um/s2"}
#: Types of arrays in a body, as numpy names them.
ARRAY_TYPES: Final = frozenset({"<f8", "<f4", "<i8", "<i4", "|u1", "|b1"})
MAX_DIMENSIONS: Final = 4
#: Longest header of a file that is read, so that a foreign file cannot use up the memory.
MAX_HEADER_BYTES: Final = 2**24


def split_state(state: StateDict) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """(JSON values, arrays) of a state.

    Numpy scalars become JSON numbers. JSON has no NaN and no infinity: such a number becomes an array of shape ().
    Raises ModelFileError if an array does not hold numbers or truth values.
    """
    values: dict[str, Any] = {}
    arrays: dict[str, NDArray[Any]] = {}
    for key, value in state.items():
        if isinstance(value, np.ndarray):
            if value.dtype.kind not in "fiub":
                raise ModelFileError(f"state {key!r}: arrays of {value.dtype} cannot be stored, only numbers")
            arrays[key] = value
            continue
        scalar = value.item() if isinstance(value, np.generic) else value
        if isinstance(scalar, float) and not math.isfinite(scalar):
            arrays[key] = np.array(scalar)
        else:
            values[key] = scalar
    return values, arrays


def encode_header(header: Mapping[str, Any]) -> bytes:
    """The header as UTF-8 JSON. Raises ModelFileError if a value has no JSON form."""
    try:
        return json.dumps(header, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise ModelFileError(f"header: a value cannot be written as JSON: {error}") from error


def decode_header(text: bytes) -> dict[str, Any]:
    """The header in ``text``. Raises InputError if it is not a JSON object."""
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FieldError("header", repr(error), "UTF-8 JSON") from error
    if not isinstance(header, dict):
        raise FieldError("header", type(header).__name__, "a JSON object")
    return header


def encode_body(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[Any]:
    """The body as buffers in order, the padded header first; arrays that are already little-endian are not copied.

    The table of ``arrays`` is added to the header. Raises ModelFileError for a type that is not in `ARRAY_TYPES`.
    """
    table: list[list[Any]] = []
    buffers: list[Any] = []
    for name, array in arrays.items():
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        if little.dtype.str not in ARRAY_TYPES:
            raise ModelFileError(f"state {name!r}: arrays of {array.dtype} cannot be stored; use a 64-bit type")
        table.append([name, little.dtype.str, list(array.shape)])
        buffers += [little.reshape(-1).view(np.uint8).data, bytes(-little.nbytes % 8)]
    text = encode_header({**header, "arrays": table})
    return [text + b" " * (-len(text) % 8), *buffers]


def decode_body(data: bytes | memoryview, header_bytes: int, max_bytes: int) -> tuple[dict[str, Any], StateDict]:
    """(header without its table of arrays, arrays by name) of a body whose header takes ``header_bytes`` bytes.

    The arrays are copies. Raises InputError if the header, its table or an array is malformed, if an array is longer
    than ``max_bytes`` or if it ends behind the data.
    """
    header = decode_header(bytes(data[:header_bytes]))
    try:
        table = [(str(name), str(dtype), [int(n) for n in shape]) for name, dtype, shape in header.pop("arrays")]
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise FieldError("header", repr(error), "an entry 'arrays' with rows [name, type, shape]") from error
    arrays: StateDict = {}
    offset = header_bytes
    for name, dtype, shape in table:
        if dtype not in ARRAY_TYPES or len(shape) > MAX_DIMENSIONS or any(n < 0 for n in shape):
            expected = f"one of {sorted(ARRAY_TYPES)} and at most {MAX_DIMENSIONS} dimensions"
            raise FieldError(f"arrays.{name}", f"{dtype} {str(shape)[:80]}", expected)
        itemsize = np.dtype(dtype).itemsize
        # numpy refuses an empty array whose other dimensions exceed its own limits: count a zero as one here.
        if math.prod(max(n, 1) for n in shape) * itemsize > max_bytes:
            raise FieldError(f"arrays.{name}", f"shape {str(shape)[:80]}", f"an array of at most {max_bytes} bytes")
        count = math.prod(shape)
        if offset + count * itemsize > len(data):
            got = f"{count * itemsize} bytes at {offset}"
            raise FieldError(f"arrays.{name}", got, f"no more than the {len(data)} bytes of the body")
        arrays[name] = np.frombuffer(data, dtype=dtype, count=count, offset=offset).reshape(shape).copy()
        offset += count * itemsize + (-count * itemsize % 8)
    return header, arrays
