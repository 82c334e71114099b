"""Binary payload of a model snapshot: what a client needs to evaluate the model itself (docs/protocol.md)."""

from __future__ import annotations

import hashlib
import importlib
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.types import FloatArray, InverseModel, StateDict
from dehyst.service.protocol.container import decode_body, encode_body, split_state
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import MODEL, VERSION, check_header, check_length

# --- Model classes by the kind under which files and messages store them.

#: Kind in files and messages -> "module:class". The class has a ``from_state(StateDict)`` that builds an equal model.
#: A module is imported when the first model of its kind is built: a client loads the models that it uses, no others.
MODEL_CLASSES: Final = {
    "lssvm": "dehyst.adaptive.inverse_model:LssvmInverse",
    "linear": "dehyst.baselines.linear:LinearInverse",
    "bouc_wen": "dehyst.baselines.bouc_wen.model:BoucWenInverse",
    "mpi": "dehyst.baselines.prandtl_ishlinskii.model:MpiInverse",
    "champion": "dehyst.baselines.competition.champion:ChampionInverse",
}


def stored_kind(model: InverseModel) -> str:
    """The kind under which ``model`` is stored. Raises ModelFileError if its class is not in `MODEL_CLASSES`."""
    path = f"{type(model).__module__}:{type(model).__qualname__}"
    for kind, known in MODEL_CLASSES.items():
        if known == path:
            return kind
    raise ModelFileError(
        f"model {model.name!r}: got the class {path}, expected a registered one: {', '.join(MODEL_CLASSES.values())}"
    )


#: Entries of a model that may change without any change of its answers.
_UNANSWERED: Final = frozenset({"seq", "valid", "noise_variance"})


def fingerprint(model: InverseModel, whole: bool = False) -> str:
    """16 hexadecimal digits; equal for models that give the same answers to the last bit.

    ``whole`` : equal only where all parameters are the same.
    """
    made = hashlib.blake2b(digest_size=8)
    for entry, value in sorted(model.state_dict().items()):
        if entry in _UNANSWERED and not whole:
            continue
        array = value if isinstance(value, np.ndarray) else None
        told = [entry, value] if array is None else [entry, array.dtype.str, array.shape]
        made.update(json.dumps(told).encode())
        made.update(b"" if array is None else array.tobytes())
    return made.hexdigest()


def digests(models: Mapping[str, InverseModel]) -> dict[str, str]:
    """The fingerprint of each whole model, by name."""
    return {name: fingerprint(model, whole=True) for name, model in models.items()}


def build_model(kind: str, state: StateDict, where: str) -> InverseModel:
    """The model of ``kind`` with ``state``. Raises ModelFileError, beginning with ``where``, if it cannot be built."""
    if kind not in MODEL_CLASSES:
        raise ModelFileError(f"{where}: got the kind {kind!r}, expected one of {', '.join(sorted(MODEL_CLASSES))}")
    module, _, name = MODEL_CLASSES[kind].partition(":")
    try:
        from_state = cast(Callable[[StateDict], Any], getattr(importlib.import_module(module), name).from_state)
        model = from_state(state)
    except (ImportError, AttributeError) as error:
        raise ModelFileError(f"{where}: kind {kind!r} cannot be loaded: {error}") from error
    except ModelFileError as error:
        raise ModelFileError(f"{where}: {error}") from error
    except (LookupError, ValueError, TypeError, ArithmeticError) as error:
        raise ModelFileError(f"{where}: the stored state is not that of a {kind!r} model: {error!r}") from error
    if not isinstance(model, InverseModel):
        raise ModelFileError(f"{where}: {MODEL_CLASSES[kind]} does not build an inverse model")
    return model


# --- The payload.

#: version, kind, options (0), number of arrays, snapshot_seq, bytes of the JSON header, bytes of all arrays
_HEAD: Final = struct.Struct("<BBHIqII")
MAX_BYTES: Final = 64 * 2**20
#: Names of arrays that are not part of the model's own state: its memory, and state and memory of the stand-in.
_MEMORY: Final = "/memory"
_STAND_IN: Final = "/stand_in/"
_STAND_IN_MEMORY: Final = "/stand_in_memory"
#: Entries of ``safety`` in the header, with their types.
_SAFETY_TYPES: Final = {"blends": bool, "blend_share": float, "trust": float, "stale_s": float, "last_good_s": float}


class StandIn(NamedTuple):
    """The model that answers in place of another, and its (m,) memory, tracked from the samples up to the snapshot."""

    name: str
    model: InverseModel
    memory: FloatArray


@dataclass(frozen=True, slots=True)
class Safety:
    """When a stand-in answers in place of a model. With it, a client gives the same answers as the service.

    Attributes
    ----------
    blends : True if the stand-in also answers outside the domain of the model and by its trust; False if it answers
        only where the model is not finite.
    blend_share, trust : see :class:`dehyst.service.answers.fallback.Rules`.
    stale_s, last_good_s : see :class:`dehyst.service.config.settings.AxisConfig`.
    stand_in : None if there is none.
    trouble : name of what is wrong with the samples or the learner, "" while nothing is. Followers without a correction
        need not know it.
    """

    blends: bool = False
    blend_share: float = 0.5
    trust: float = 1.0
    stale_s: float = 0.0
    last_good_s: float = 60.0
    stand_in: StandIn | None = None
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class ModelMessage:
    """A snapshot of a model.

    Attributes
    ----------
    name : under which the service serves the model. snapshot_seq : number of the last sample that it has seen.
    memory : (m,) hysteresis memory after that sample.
    """

    name: str
    model: InverseModel
    snapshot_seq: int
    memory: FloatArray
    safety: Safety = field(default_factory=Safety)


def encode_model(
    name: str, model: InverseModel, snapshot_seq: int, memory: FloatArray, safety: Safety | None = None
) -> bytes:
    """Payload of a snapshot. Raises ModelFileError if the class of a model or a type of its state is unknown."""
    header, arrays = model_parts(name, model, memory, safety)
    return pack_model(encode_body(header, arrays), len(arrays), snapshot_seq)


def model_parts(
    name: str, model: InverseModel, memory: FloatArray, safety: Safety | None = None
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """(JSON, arrays) of a snapshot. Raises ModelFileError as `encode_model`."""
    values, arrays = split_state(model.state_dict())
    arrays[_MEMORY] = memory
    header: dict[str, Any] = {"name": name, "kind": stored_kind(model), "dt_s": model.dt_s, "values": values}
    if safety is not None:
        entries = {key: getattr(safety, key) for key in _SAFETY_TYPES}
        if safety.trouble:
            entries["trouble"] = safety.trouble
        header["safety"] = entries
        if safety.stand_in is not None:
            other = safety.stand_in
            other_values, other_arrays = split_state(other.model.state_dict())
            entries["stand_in"] = {"name": other.name, "kind": stored_kind(other.model), "values": other_values}
            arrays |= {_STAND_IN + key: array for key, array in other_arrays.items()}
            arrays[_STAND_IN_MEMORY] = other.memory
    return header, arrays


def pack_model(body: list[Any], count: int, snapshot_seq: int) -> bytes:
    """Payload of an encoded body with ``count`` arrays (`service.protocol.container.encode_body`)."""
    text, *buffers = body
    size = sum(map(len, buffers))
    return b"".join((_HEAD.pack(VERSION, MODEL, 0, count, snapshot_seq, len(text), size), text, *buffers))


def decode_model(data: bytes) -> ModelMessage:
    """The snapshot in a payload. Raises InputError if it is malformed, ModelFileError if the model cannot be built."""
    return assemble(*check_model(data))


def check_model(data: bytes) -> tuple[dict[str, Any], StateDict, int]:
    """(JSON, arrays, snapshot_seq) of a payload. Raises InputError if it is malformed."""
    check_header(data, MODEL, _HEAD.size)
    *_, count, snapshot_seq, header_bytes, array_bytes = _HEAD.unpack_from(data)
    if header_bytes + array_bytes > MAX_BYTES:
        raise FieldError("payload", f"{header_bytes + array_bytes} bytes", f"at most {MAX_BYTES}")
    check_length(data, _HEAD.size + header_bytes + array_bytes)
    header, state = decode_body(memoryview(data)[_HEAD.size :], header_bytes, MAX_BYTES)
    if len(state) != count:
        raise FieldError("arrays", len(state), f"{count}, by the header")
    return header, state, snapshot_seq


def assemble(header: dict[str, Any], arrays: StateDict, snapshot_seq: int) -> ModelMessage:
    """The snapshot of JSON and arrays. Raises InputError and ModelFileError as `decode_model`."""
    state = dict(arrays)
    try:
        kind, name, values = str(header["kind"]), str(header["name"]), dict(header["values"])
    except (ValueError, KeyError, TypeError) as error:
        raise FieldError("header", repr(error), "JSON with name, kind, dt_s, values and arrays") from error
    other_state = {key.removeprefix(_STAND_IN): state.pop(key) for key in list(state) if key.startswith(_STAND_IN)}
    other_memory, memory = state.pop(_STAND_IN_MEMORY, None), state.pop(_MEMORY, None)
    model, vector = _build(kind, name, values | state, memory)
    try:
        entries = dict(header.get("safety", {}))
        other = entries.pop("stand_in", None)
        # A newer service may send more entries: they are ignored.
        known: dict[str, Any] = {key: convert(entries[key]) for key, convert in _SAFETY_TYPES.items() if key in entries}
        safety = Safety(**known, trouble=str(entries.get("trouble", "")))
        if other is not None:
            other_name, other_values = str(other["name"]), dict(other["values"])
            built = _build(str(other["kind"]), other_name, other_state | other_values, other_memory)
            safety = replace(safety, stand_in=StandIn(other_name, *built))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise FieldError("safety", repr(error), "the entries in docs/protocol.md") from error
    if not (safety.blend_share > 0.0 and 0.0 <= safety.trust <= 1.0):
        raise FieldError("safety", f"{safety.blend_share}, {safety.trust}", "blend_share above 0, trust from 0 to 1")
    return ModelMessage(name, model, snapshot_seq, vector, safety)


def _build(kind: str, name: str, state: StateDict, memory: Any) -> tuple[InverseModel, FloatArray]:
    if memory is None:
        raise FieldError("arrays", f"no memory of {name!r}", f"an array with the key {_MEMORY!r}")
    with np.errstate(all="ignore"):  # numbers out of range show in the answers, which are guarded
        model = build_model(kind, state, f"model {name!r}")
    vector: FloatArray = np.asarray(memory, dtype=np.float64).reshape(-1)
    if vector.size != model.memory_size:
        raise ModelFileError(f"model {name!r}: memory of {vector.size} doubles, expected {model.memory_size}")
    return model, vector
