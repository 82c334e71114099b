"""Changes of a followed model: the payload of kind 7, and the state that both ends keep (docs/protocol.md).

A model payload is a list of entries, each some doubles. A change replaces doubles of one entry. Each message states the
fingerprint of the model that it changes and that of the result, so that a lost message and a wrong sum are noticed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray, StateDict
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.protocol.container import encode_body
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.model import ModelMessage, assemble, check_model, pack_model
from dehyst.service.protocol.samples import DELTA, VERSION, check_header, check_length

#: version, kind, options, number of changes, snapshot_seq, fingerprints of the model before and after
_HEAD: Final = struct.Struct("<BBHIqII")
#: entry, doubles that it has from now on, first double that changes, doubles that change
_CHANGE: Final = struct.Struct("<IIII")
#: Option: a whole model in place of changes.
WHOLE: Final = 1
#: Most doubles of an entry: those of the largest model payload.
MAX_DOUBLES: Final = 2**23
_DOUBLE: Final = struct.Struct("<d")
#: Places where entries of the JSON other than ``values`` stand, in their names.
_SAFETY: Final = "/safety/"
_STAND_IN: Final = "/stand_in/"
#: Unchanged doubles between two changed ones that are sent along rather than begin another change, and doubles up to
#: which an entry is sent as a whole.
_BRIDGED: Final = 2
_SHORT: Final = 128
#: Entries of an LSSVM that change with every step of its linear part, and the memories.
_MOVING: Final = frozenset(("features.gain", "features.offset_um", "beta", "domain", "noise_variance"))
_MEMORIES: Final = frozenset(("/memory", "/stand_in_memory"))


class Change(NamedTuple):
    """``data`` (bytes of doubles) from double ``first`` of entry number ``entry``, which has ``size`` from now on."""

    entry: int
    size: int
    first: int
    data: bytes


@dataclass(frozen=True, slots=True)
class DeltaMessage:
    """A payload of kind 7: ``changes``, or a whole ``model`` (a payload of kind 6)."""

    snapshot_seq: int
    before: int
    after: int
    changes: tuple[Change, ...] = ()
    model: bytes = b""


def encode_delta(message: DeltaMessage) -> bytes:
    """The payload."""
    whole = bool(message.model)
    n = 1 if whole else len(message.changes)
    head = _HEAD.pack(VERSION, DELTA, whole * WHOLE, n, message.snapshot_seq, message.before, message.after)
    if whole:
        return head + message.model
    parts = [head]
    for entry, size, first, data in message.changes:
        parts += (_CHANGE.pack(entry, size, first, len(data) // 8), data)
    return b"".join(parts)


def decode_delta(data: bytes) -> DeltaMessage:
    """Inverse of `encode_delta`; the model inside is not decoded. Raises InputError if it is malformed."""
    options, n = check_header(data, DELTA, _HEAD.size, WHOLE)
    *_, seq, before, after = _HEAD.unpack_from(data)
    if seq < -1:
        raise FieldError("snapshot_seq", seq, "a sequence number, or -1 before any sample")
    if options & WHOLE:
        if n != 1:
            raise FieldError("n", n, "1 with a whole model")
        if before:
            raise FieldError("before", before, "0 with a whole model")
        return DeltaMessage(seq, 0, after, (), data[_HEAD.size :] or b"\x00")
    changes, at = [], _HEAD.size
    for i in range(n):
        if at + _CHANGE.size > len(data):
            raise FieldError("payload", f"{len(data)} bytes", f"change {i} of {n} at {at}")
        entry, size, first, k = _CHANGE.unpack_from(data, at)
        at += _CHANGE.size
        if size > MAX_DOUBLES:
            raise FieldError(f"change[{i}].size", size, f"at most {MAX_DOUBLES} doubles")
        if first + k > size:
            raise FieldError(f"change[{i}].k", f"{first} + {k}", f"an end within the {size} doubles of the entry")
        changes.append(Change(entry, size, first, data[at : at + 8 * k]))
        at += 8 * k
    check_length(data, at)
    return DeltaMessage(seq, before, after, tuple(changes))


#: What changes cannot change of a model: its JSON without values; the types of its numbers; the other values; of each
#: array its type, the shape of a row, and whether it has rows.
_Shape = tuple[dict[str, Any], dict[str, type], dict[str, Any], dict[str, tuple[str, tuple[int, ...], int]]]


class _Form:
    """The entries of models of one shape, in order. ``texts`` : values that are no entries."""

    def __init__(self, shape: _Shape, texts: Mapping[str, Any]) -> None:
        self.shape = shape
        self.rest, self.numbers, _, self.arrays = shape
        self.texts = texts
        self.names = tuple(sorted((*self.numbers, *self.arrays), key=str.encode))
        self.index = {name: i for i, name in enumerate(self.names)}
        #: CRC-32 of the names, the first word of the fingerprint's bytes.
        self.first = zlib.crc32("\n".join(self.names).encode())
        self.words = struct.Struct(f"<{len(self.names) + 1}I")
        if len(self.index) < len(self.names):
            raise FieldError("header", "a name twice", "each name once, in values or in arrays")


def _uncounted(name: str) -> bool:
    """``seq`` of a model, which no evaluation needs; as a double it would not be exact."""
    return name == "seq" or name.endswith((".seq", "/seq"))


def _split(header: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(the JSON without values, the values by the names that they have as entries). Inverse of `_join`."""
    rest, flat = dict(header), dict(header.get("values", {}))
    rest["values"] = {}
    if "safety" in rest:
        safety = dict(rest["safety"])
        stand_in = dict(safety.pop("stand_in", {}))
        flat |= {_SAFETY + name: value for name, value in safety.items()}
        flat |= {_STAND_IN + name: value for name, value in dict(stand_in.get("values", {})).items()}
        rest["safety"] = {"stand_in": stand_in | {"values": {}}} if stand_in else {}
    return rest, flat


def _join(rest: Mapping[str, Any], flat: Mapping[str, Any]) -> dict[str, Any]:
    below: dict[str, dict[str, Any]] = {_SAFETY: {}, _STAND_IN: {}, "": {}}
    for name, value in flat.items():
        place = next(place for place in below if name.startswith(place))
        below[place][name.removeprefix(place)] = value
    header = {**rest, "values": below[""]}
    if "safety" in rest:
        header["safety"] = below[_SAFETY]
        if rest["safety"]:
            header["safety"]["stand_in"] = {**rest["safety"]["stand_in"], "values": below[_STAND_IN]}
    return header


def doubles(value: Any) -> bytes:
    """The doubles of an entry, little-endian: a number, a truth value as 0 or 1, or an array, row by row."""
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value, dtype="<f8").tobytes()
    return _DOUBLE.pack(value)


class FollowedState:
    """All entries of a model at one moment; immutable. The sum of a whole model and of the changes after it."""

    __slots__ = ("_crcs", "_data", "_form", "fingerprint", "snapshot_seq")

    def __init__(self, form: _Form, data: dict[str, bytes], crcs: list[int], snapshot_seq: int) -> None:
        self._form, self._data, self._crcs = form, data, crcs
        self.snapshot_seq = snapshot_seq
        #: CRC-32 of the CRC-32 of the names and of those of the entries.
        self.fingerprint = zlib.crc32(form.words.pack(form.first, *crcs))

    @classmethod
    def of(
        cls,
        header: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        snapshot_seq: int,
        like: FollowedState | None = None,
    ) -> FollowedState:
        """The state of a model payload, given as its JSON and arrays (`service.protocol.model.model_parts`).

        ``like`` : an earlier state, with which this one shares what is equal. Raises InputError where an entry is not
        as the page says.
        """
        try:
            rest, flat = _split(header)
            numbers = {
                name: value for name, value in flat.items() if isinstance(value, float | int) and not _uncounted(name)
            }
            texts = {name: value for name, value in flat.items() if name not in numbers}
            shape = (
                rest,
                {name: type(value) for name, value in numbers.items()},
                {name: None if _uncounted(name) else value for name, value in texts.items()},
                {name: (array.dtype.str, array.shape[1:], array.ndim) for name, array in arrays.items()},
            )
            data = {name: doubles(value) for name, value in (*numbers.items(), *arrays.items())}
        except (ValueError, TypeError, AttributeError, OverflowError, struct.error) as error:
            raise FieldError("header", repr(error), "the JSON of a model in docs/protocol.md") from error
        if like is not None and like._form.shape == shape:
            return like._with({name: new for name, new in data.items() if new != like._data[name]}, snapshot_seq)
        form = _Form(shape, texts)
        return cls(form, data, [zlib.crc32(data[name]) for name in form.names], snapshot_seq)

    def _with(self, entries: Mapping[str, bytes], snapshot_seq: int) -> FollowedState:
        data, crcs = {**self._data, **entries}, self._crcs.copy()
        for name, entry in entries.items():
            crcs[self._form.index[name]] = zlib.crc32(entry)
        return FollowedState(self._form, data, crcs, snapshot_seq)

    @classmethod
    def decode(cls, payload: bytes) -> FollowedState:
        """The state of a payload of kind 6. Raises InputError if it is malformed."""
        return cls.of(*check_model(payload))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries, in order."""
        return self._form.names

    def payload(self) -> bytes:
        """The payload of kind 6."""
        header, arrays = self._parts()
        return pack_model(encode_body(header, arrays), len(arrays), self.snapshot_seq)

    # ---- the sender's side

    def changed(self, new: Mapping[str, bytes], snapshot_seq: int) -> tuple[FollowedState, DeltaMessage | None]:
        """(the state with the entries ``new``, the message that leads there); None where nothing has changed.

        Names that this model does not have are left out.
        """
        entries = {name: entry for name, entry in new.items() if self._data.get(name, entry) != entry}
        if not entries:
            return self, None
        after, index = self._with(entries, snapshot_seq), self._form.index
        runs = (run for name, entry in entries.items() for run in _runs(index[name], self._data[name], entry))
        return after, DeltaMessage(snapshot_seq, self.fingerprint, after.fingerprint, tuple(runs))

    def replaced(self, new: FollowedState) -> tuple[FollowedState, DeltaMessage | None]:
        """(``new``, the message that leads there from this state): changes, or the whole model in another form.

        ``new`` : made ``like`` this state.
        """
        if self._form is not new._form:
            return new, new.whole()
        return self.changed(new._data, new.snapshot_seq)

    def whole(self) -> DeltaMessage:
        """The message with the whole model."""
        return DeltaMessage(self.snapshot_seq, 0, self.fingerprint, (), self.payload())

    # ---- the follower's side

    def applied(self, message: DeltaMessage) -> tuple[FollowedState, set[str]]:
        """(the state after the changes of ``message``, names of the changed entries).

        Raises InputError where a change does not fit this model. The fingerprints are the caller's to compare.
        """
        names, touched = self._form.names, dict[str, bytearray]()
        for i, (entry, size, first, run) in enumerate(message.changes):
            if entry >= len(names):
                raise FieldError(f"change[{i}].entry", entry, f"below {len(names)}, the entries of this model")
            now = touched.get(names[entry])
            if now is None:
                now = touched[names[entry]] = bytearray(self._data[names[entry]])
            have = len(now) // 8
            if size != have:
                self._check_size(i, names[entry], size)
                if size > have and not (first <= have and first + len(run) // 8 == size):
                    raise FieldError(f"change[{i}].first", first, f"all of the new doubles from {have} on")
                del now[8 * size :]
            now[8 * first : 8 * first + len(run)] = run
        return self._with({name: bytes(now) for name, now in touched.items()}, message.snapshot_seq), set(touched)

    def _check_size(self, i: int, name: str, size: int) -> None:
        dtype, behind, dimensions = self._form.arrays.get(name, ("", (), 0))
        row = int(np.prod(behind)) if dimensions else 0
        if dtype != "<f8" or row == 0 or size % row:
            raise FieldError(f"change[{i}].size", size, f"whole rows of {name!r}, an array of doubles")

    def message(self, before: ModelMessage | None = None, changed: set[str] | None = None) -> ModelMessage:
        """The model, ready to be evaluated. Raises InputError or ModelFileError if it cannot be built.

        ``before``, ``changed`` : the model from which this state differs in these entries alone. Where only its linear
        part and the memories have moved, the rest is taken from it.
        """
        moved = None if before is None or changed is None else self._moved(before, changed)
        return moved or assemble(*self._parts(), self.snapshot_seq)

    def _moved(self, before: ModelMessage, changed: set[str]) -> ModelMessage | None:
        """The model where only its linear part and the memories have moved, at little cost; None where more has."""
        model, memory, safety = before.model, before.memory, before.safety
        own = changed - _MEMORIES
        if own:
            prefix = "" if isinstance(model, LssvmInverse) else next(iter(own)).partition(".")[0] + "."
            if not own <= {prefix + name for name in _MOVING}:
                return None
            if isinstance(model, ChampionInverse) and prefix[:-1] in model.names:
                contestant = model.models[model.names.index(prefix[:-1])]
                if type(contestant) is not LssvmInverse:
                    return None
                model = model.with_model(prefix[:-1], self._moved_lssvm(contestant, prefix))
            elif type(model) is LssvmInverse:
                model = self._moved_lssvm(model, prefix)
            else:
                return None
        if "/memory" in changed:
            memory = self._doubles("/memory")
        if "/stand_in_memory" in changed and safety.stand_in is not None:
            other = safety.stand_in._replace(memory=self._doubles("/stand_in_memory"))
            safety = replace(safety, stand_in=other)
        if memory.shape != before.memory.shape:
            raise FieldError("/memory", f"{memory.size} doubles", f"{before.memory.size}")
        return ModelMessage(before.name, model, self.snapshot_seq, memory, safety)

    def _moved_lssvm(self, model: LssvmInverse, prefix: str) -> LssvmInverse:
        frame = (
            float(self._doubles(prefix + "features.gain")[0]),
            float(self._doubles(prefix + "features.offset_um")[0]),
        )
        beta, domain = self._doubles(prefix + "beta"), self._doubles(prefix + "domain")
        return model.moved(frame, beta, domain, float(self._doubles(prefix + "noise_variance")[0]))

    def _doubles(self, name: str) -> FloatArray:
        return np.frombuffer(self._data[name], dtype="<f8")

    def _parts(self) -> tuple[dict[str, Any], StateDict]:
        """JSON and arrays, as of a payload. Raises InputError where a number is not of the type that it had."""
        form, flat, arrays = self._form, dict(self._form.texts), StateDict()
        for name in form.names:
            if name in form.numbers:
                flat[name] = _number(name, self._data[name], form.numbers[name])
                continue
            dtype, behind, dimensions = form.arrays[name]
            array = np.frombuffer(self._data[name], dtype="<f8")
            if dtype != "<f8":
                array = array.astype(dtype)
            shape = ((-1, *behind) if array.size else (0, *behind)) if dimensions else ()
            arrays[name] = array.reshape(shape)
        return _join(form.rest, flat), arrays


def _number(name: str, data: bytes, kind: type) -> Any:
    (value,) = _DOUBLE.unpack(data)
    if kind is float:
        return value
    if value != value or value != int(value) or (kind is bool and value not in (0.0, 1.0)):
        raise FieldError(name, value, "a truth value, 0 or 1" if kind is bool else "a whole number")
    return kind(value)


def _runs(entry: int, old: bytes, new: bytes) -> list[Change]:
    """The changes from ``old`` to ``new``, both doubles as bytes."""
    size, had = len(new) // 8, len(old) // 8
    both = min(size, had)
    if both <= _SHORT:
        return [Change(entry, size, 0, new)]
    a, b = (np.frombuffer(data, dtype="<u8", count=both) for data in (old, new))
    at = np.flatnonzero(a != b)
    changes = [] if size == had else [Change(entry, size, both, new[8 * both :])]
    if at.size:
        ends = np.flatnonzero(np.diff(at) > _BRIDGED)
        firsts, lasts = at[np.concatenate(([0], ends + 1))], at[np.concatenate((ends, [at.size - 1]))]
        for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
            changes.append(Change(entry, size, first, new[8 * first : 8 * last + 8]))
    return changes
