"""Binary payload of a model snapshot: what a client needs to evaluate it in its own process (docs/protocol.md)."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from adaptive.errors import ModelFileError
from adaptive.types import FloatArray, InverseModel, StateDict
from service.answers.fallback import StandIn
from service.protocol.errors import FieldError
from service.protocol.samples import MODEL, VERSION, check_header, check_length
from service.storage.model_file import build, kind_of, split_state

#: version, kind, options (0), number of arrays, snapshot_seq, bytes of the JSON text, bytes of all arrays
_HEAD: Final = struct.Struct("<BBHIqII")
MAX_BYTES: Final = 64 * 2**20
_DTYPES: Final = {"<f8", "<f4", "<i8", "<i4", "|u1", "|b1"}
_MEMORY: Final = "/memory"
#: The arrays of the model that stands in, and its memory, are listed under these names.
_STAND_IN: Final = "/stand_in/"
_STAND_IN_MEMORY: Final = "/stand_in_memory"


#: What the payload says of the rules, and of which type.
_RULES: Final = {"blends": bool, "blend_share": float, "trust": float, "stale_s": float, "last_good_s": float}


@dataclass(frozen=True, slots=True)
class Safety:
    """By what rules a snapshot gives way to another model, so that a client's answers are those of the service.

    Attributes
    ----------
    blends : whether it does so outside its domain and by its trust, or only where it is not finite.
    blend_share, trust : see :class:`service.answers.fallback.Rules`. stale_s, last_good_s : see the configuration.
    stand_in : the model that stands in; None for none.
    """

    blends: bool = False
    blend_share: float = 0.5
    trust: float = 1.0
    stale_s: float = 0.0
    last_good_s: float = 60.0
    stand_in: StandIn | None = None


@dataclass(frozen=True, slots=True)
class ModelMessage:
    """A snapshot: the name it is served by, the model, the last sample it had seen, and the tracked memory then."""

    name: str
    model: InverseModel
    snapshot_seq: int
    memory: FloatArray
    safety: Safety = field(default_factory=Safety)


def encode_model(
    name: str, model: InverseModel, snapshot_seq: int, memory: FloatArray, safety: Safety | None = None
) -> bytes:
    """Payload of a snapshot: header, JSON, padding to eight bytes, then the arrays, each padded to eight bytes."""
    values, arrays = split_state(model.state_dict())
    arrays[_MEMORY] = memory
    header: dict[str, Any] = {"name": name, "kind": kind_of(model), "dt_s": model.dt_s, "values": values}
    if safety is not None:
        told = {key: getattr(safety, key) for key in _RULES}
        header["safety"] = told
        if safety.stand_in is not None:
            other = safety.stand_in
            its_values, its_arrays = split_state(other.model.state_dict())
            told["stand_in"] = {"name": other.name, "kind": kind_of(other.model), "values": its_values}
            arrays |= {_STAND_IN + key: array for key, array in its_arrays.items()}
            arrays[_STAND_IN_MEMORY] = other.memory
    listed = []
    blobs = []
    for key, array in arrays.items():
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        blob = little.tobytes()
        listed.append([key, little.dtype.str, list(array.shape)])
        blobs.append(blob + bytes(-len(blob) % 8))
    text = json.dumps({**header, "arrays": listed}, allow_nan=False).encode()
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
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise FieldError("header", repr(error), "JSON with name, kind, dt_s, values and arrays") from error
    if len(listed) != count:
        raise FieldError("arrays", len(listed), f"{count}, by the header")
    _arrays(data, _HEAD.size + text_bytes, listed, state)
    its = {key.removeprefix(_STAND_IN): state.pop(key) for key in list(state) if key.startswith(_STAND_IN)}
    its_memory = state.pop(_STAND_IN_MEMORY, None)
    model, memory = _build(kind, name, state, state.pop(_MEMORY, None))
    try:
        told = dict(header.get("safety", {}))
        other = told.pop("stand_in", None)
        # What a newer service tells beyond this is not for us.
        known: dict[str, Any] = {key: make(told[key]) for key, make in _RULES.items() if key in told}
        safety = Safety(**known)
        if other is not None:
            its_name = str(other["name"])
            made = _build(str(other["kind"]), its_name, its | dict(other["values"]), its_memory)
            safety = replace(safety, stand_in=StandIn(its_name, *made))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise FieldError("safety", repr(error), "the rules of the page docs/protocol.md") from error
    if not (safety.blend_share > 0.0 and 0.0 <= safety.trust <= 1.0):
        raise FieldError("safety", f"{safety.blend_share}, {safety.trust}", "blend_share above 0, trust from 0 to 1")
    return ModelMessage(name, model, snapshot_seq, memory, safety)


def _build(kind: str, name: str, state: StateDict, memory: Any) -> tuple[InverseModel, FloatArray]:
    if memory is None:
        raise FieldError("arrays", f"no memory of {name!r}", f"an array with the key {_MEMORY!r}")
    with np.errstate(all="ignore"):  # numbers beyond bounds show in the answers, which are guarded
        model = build(kind, state, f"model {name!r}")
    vector: FloatArray = np.asarray(memory, dtype=np.float64).reshape(-1)
    if vector.size != model.memory_size:
        raise ModelFileError(f"model {name!r}: memory of {vector.size} doubles, expected {model.memory_size}")
    return model, vector


def _arrays(data: bytes, offset: int, listed: list[tuple[str, str, list[int]]], state: StateDict) -> None:
    """Put the arrays into ``state``."""
    for key, dtype, shape in listed:
        if dtype not in _DTYPES or any(n < 0 for n in shape) or len(shape) > 4:
            raise FieldError(f"arrays.{key}", f"{dtype} {shape}", f"one of {sorted(_DTYPES)} and at most 4 dimensions")
        itemsize = np.dtype(dtype).itemsize
        # Without its zeros too: numpy refuses an empty array whose other dimensions are beyond its own bounds.
        if math.prod(max(n, 1) for n in shape) * itemsize > MAX_BYTES:
            raise FieldError(f"arrays.{key}", f"shape {str(shape)[:80]}", f"an array of at most {MAX_BYTES} bytes")
        size = math.prod(shape) * itemsize
        if offset + size > len(data):
            raise FieldError(f"arrays.{key}", f"{size} bytes at {offset}", f"no more than the payload's {len(data)}")
        state[key] = np.frombuffer(data[offset : offset + size], dtype=dtype).copy().reshape(shape)
        offset += size + (-size % 8)
