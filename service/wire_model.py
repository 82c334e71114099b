"""Binary payload of a model snapshot: what a client needs to evaluate it in its own process (docs/protocol.md)."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from adaptive.errors import ModelFileError
from adaptive.types import FloatArray, InverseModel, StateDict
from service.errors import FieldError
from service.modelfile import split_state
from service.registry import build, kind_of
from service.wire import MODEL, VERSION, check_header, check_length

#: version, kind, options (0), number of arrays, snapshot_seq, bytes of the JSON text, bytes of all arrays
_HEAD: Final = struct.Struct("<BBHIqII")
MAX_BYTES: Final = 64 * 2**20
_DTYPES: Final = {"<f8", "<f4", "<i8", "<i4", "|u1", "|b1"}
_MEMORY: Final = "/memory"


@dataclass(frozen=True, slots=True)
class ModelMessage:
    """A snapshot: the name it is served by, the model, the last sample it had seen, and the tracked memory then."""

    name: str
    model: InverseModel
    snapshot_seq: int
    memory: FloatArray


def encode_model(name: str, model: InverseModel, snapshot_seq: int, memory: FloatArray) -> bytes:
    """Payload of a snapshot: header, JSON, padding to eight bytes, then the arrays, each padded to eight bytes."""
    values, arrays = split_state(model.state_dict())
    listed = []
    blobs = []
    for key, array in {**arrays, _MEMORY: memory}.items():
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        blob = little.tobytes()
        listed.append([key, little.dtype.str, list(array.shape)])
        blobs.append(blob + bytes(-len(blob) % 8))
    text = json.dumps(
        {"name": name, "kind": kind_of(model), "dt_s": model.dt_s, "values": values, "arrays": listed}, allow_nan=False
    ).encode()
    text += b" " * (-len(text) % 8)
    body = b"".join(blobs)
    return _HEAD.pack(VERSION, MODEL, 0, len(listed), snapshot_seq, len(text), len(body)) + text + body


def decode_model(data: bytes) -> ModelMessage:
    """The snapshot in a payload. Raises InputError where it is malformed, ModelFileError where it cannot be built."""
    check_header(data, MODEL, _HEAD.size)
    *_, count, snapshot_seq, text_bytes, body_bytes = _HEAD.unpack_from(data)
    if text_bytes + body_bytes > MAX_BYTES:
        raise FieldError("payload", f"{text_bytes + body_bytes} bytes", f"at most {MAX_BYTES}")
    check_length(data, _HEAD.size + text_bytes + body_bytes)
    try:
        header: dict[str, Any] = json.loads(data[_HEAD.size : _HEAD.size + text_bytes])
        listed = [(str(key), str(dtype), [int(n) for n in shape]) for key, dtype, shape in header["arrays"]]
        kind, name, state = str(header["kind"]), str(header["name"]), dict(header["values"])
    except (ValueError, KeyError, TypeError) as error:
        raise FieldError("header", repr(error), "JSON with name, kind, dt_s, values and arrays") from error
    if len(listed) != count:
        raise FieldError("arrays", len(listed), f"{count}, by the header")
    memory = _arrays(data, _HEAD.size + text_bytes, listed, state)
    model = build(kind, state, f"model {name!r}")
    if memory.size != model.memory_size:
        raise ModelFileError(f"model {name!r}: memory of {memory.size} doubles, expected {model.memory_size}")
    return ModelMessage(name, model, snapshot_seq, memory)


def _arrays(data: bytes, offset: int, listed: list[tuple[str, str, list[int]]], state: StateDict) -> FloatArray:
    """Put the arrays into ``state``; returns the memory vector that travels with them."""
    memory: FloatArray | None = None
    for key, dtype, shape in listed:
        if dtype not in _DTYPES or any(n < 0 for n in shape) or len(shape) > 4:
            raise FieldError(f"arrays.{key}", f"{dtype} {shape}", f"one of {sorted(_DTYPES)} and at most 4 dimensions")
        count = 1
        for n in shape:
            count *= n
        size = count * np.dtype(dtype).itemsize
        if offset + size > len(data):
            raise FieldError(f"arrays.{key}", f"{size} bytes at {offset}", f"no more than the payload's {len(data)}")
        array = np.frombuffer(data[offset : offset + size], dtype=dtype).copy().reshape(shape)
        if key == _MEMORY:
            memory = array.astype(np.float64).reshape(-1)
        else:
            state[key] = array
        offset += size + (-size % 8)
    if memory is None:
        raise FieldError("arrays", "no memory", f"one array with the key {_MEMORY!r}")
    return memory
