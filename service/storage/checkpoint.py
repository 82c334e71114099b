"""A checkpoint: all that an axis has learnt, in one file that is whole or refused, with what it belongs to.

Layout: 8 bytes ``DHCKPT01``, u64 length of the JSON text, 16 bytes BLAKE2b of everything after them, JSON text, arrays
each at a multiple of 8 bytes from the end of the text. The same bytes travel from a serving instance to its standby.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import struct
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive.errors import ModelFileError
from adaptive.state_codec import under
from adaptive.types import OnlineModel, StateDict
from service.protocol.errors import FieldError
from service.server.axis_state import STATE_SCHEMA, restored_learner
from service.storage.model_file import UNITS, split_state

MAGIC: Final = b"DHCKPT01"
_HEAD: Final = struct.Struct("<8sQ16s")
SUFFIX, PART = ".ckpt", ".ckpt-part"
_DTYPES: Final = {"<f8", "<f4", "<i8", "<i4", "|u1", "|b1"}


@dataclass(frozen=True, slots=True)
class CheckpointMeta:
    """What a checkpoint belongs to, and when it was made.

    Attributes
    ----------
    stage, axis : names on the wire. dt_s : sample time, s. units : those of the model file.
    schema : of the state. seq : last sample handled. samples : handled in all until then.
    time_unix_s : for people only; nothing is decided by it. instance : that made it.
    """

    stage: str
    axis: str
    dt_s: float
    seq: int
    samples: int
    time_unix_s: float = 0.0
    instance: str = ""
    schema: int = STATE_SCHEMA
    units: dict[str, str] | None = None

    def refuse_unless(self, stage: str, axis: str, dt_s: float) -> None:
        """ModelFileError with the reason, unless it belongs to this axis and can be read by this program."""
        for name, got, wanted in (
            ("schema", self.schema, STATE_SCHEMA),
            ("stage", self.stage, stage),
            ("axis", self.axis, axis),
            ("sample time", self.dt_s, dt_s),
            ("units", self.units, UNITS),
        ):
            if got != wanted:
                raise ModelFileError(f"{name} is {got!r}, expected {wanted!r}")


def encode_checkpoint(meta: CheckpointMeta, state: StateDict) -> list[Any]:
    """The bytes of a checkpoint as buffers in their order; nothing of the arrays is copied."""
    values, arrays = split_state(state)
    listed: list[list[Any]] = []
    buffers: list[Any] = []
    for name, array in arrays.items():
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        listed.append([name, little.dtype.str, list(array.shape)])
        buffers += [little.reshape(-1).view(np.uint8).data, bytes(-little.nbytes % 8)]
    header = {"meta": {**asdict(meta), "units": UNITS}, "values": values, "arrays": listed}
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 8)
    sha = hashlib.blake2b(digest_size=16)
    for buffer in (text, *buffers):
        sha.update(buffer)
    return [_HEAD.pack(MAGIC, len(text), sha.digest()), text, *buffers]


def decode_checkpoint(data: bytes) -> tuple[CheckpointMeta, StateDict]:
    """(meta, state). Raises ModelFileError saying what is wrong with the bytes."""
    if len(data) < _HEAD.size:
        raise ModelFileError("cut off in its header")
    magic, length, digest = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise ModelFileError("not a checkpoint of this program")
    view = memoryview(data)[_HEAD.size :]
    if length > len(view) or hashlib.blake2b(view, digest_size=16).digest() != digest:
        raise ModelFileError("damaged or cut off: its digest does not match")
    try:
        header = json.loads(bytes(view[:length]))
        meta = CheckpointMeta(**header["meta"])
        state: StateDict = dict(header["values"])
        offset = length
        for name, dtype, shape in header["arrays"]:
            if dtype not in _DTYPES:
                raise ValueError(f"{name}: type {dtype}")
            count = math.prod(shape)
            array = np.frombuffer(view, dtype=dtype, count=count, offset=offset).reshape(shape)
            state[str(name)] = array.copy()
            offset += array.nbytes + (-array.nbytes % 8)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ModelFileError(f"its header does not fit: {error!r}") from error
    return meta, state


class CheckpointFolder:
    """The checkpoints of one axis: the newest, and older ones further and further apart.

    One process writes; anybody may read.
    """

    def __init__(self, directory: Path, stage: str, axis: str, dt_s: float, kept: int) -> None:
        self.directory = directory
        self.kept = kept
        self._belongs = (stage, axis, dt_s)

    def write(self, meta: CheckpointMeta, state: StateDict) -> Path:
        """Write one under the next number: whole or not at all, and on the disk itself. Raises OSError."""
        self.directory.mkdir(parents=True, exist_ok=True)
        number = max((number_of(path) for path in self._paths()), default=0) + 1
        path = self.directory / f"checkpoint-{number:09d}{SUFFIX}"
        part = path.with_suffix(PART)
        try:
            with open(part, "wb") as file:
                for buffer in encode_checkpoint(meta, state):
                    file.write(buffer)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise
        self._remove_surplus(number)
        return path

    def entries(self) -> list[dict[str, Any]]:
        """checkpoint (number), seq, samples, time_unix_s, bytes of each, newest first; damaged ones are left out."""
        found = []
        for path in reversed(self._paths()):
            with contextlib.suppress(OSError, ModelFileError):
                meta = _read_meta(path)
                found.append(
                    {
                        "checkpoint": number_of(path),
                        "seq": meta.seq,
                        "samples": meta.samples,
                        "time_unix_s": meta.time_unix_s,
                        "bytes": path.stat().st_size,
                    }
                )
        return found

    def read(self, number: int) -> tuple[CheckpointMeta, StateDict]:
        """(meta, state) of one. Raises ModelFileError with the reason why it is refused."""
        path = self.directory / f"checkpoint-{number:09d}{SUFFIX}"
        try:
            meta, state = decode_checkpoint(path.read_bytes())
        except OSError as error:
            raise ModelFileError(f"cannot be read: {error.strerror or error}") from error
        meta.refuse_unless(*self._belongs)
        return meta, state

    def numbers(self) -> list[int]:
        """Numbers of all there are, newest first."""
        return [number_of(path) for path in reversed(self._paths())]

    def learner_of(self, number: int, like: OnlineModel) -> OnlineModel:
        """The learner of a checkpoint. Raises FieldError where there is none such, or it does not match ``like``."""
        if number not in self.numbers():
            known = ", ".join(map(str, self.numbers()[:8])) or "none"
            raise FieldError("checkpoint", number, f"one of those there are ({known} ...)", "see 'checkpoints'")
        try:
            return restored_learner(under("learner.", self.read(number)[1]), like)
        except ModelFileError as error:
            raise FieldError("checkpoint", number, "one that is whole and matches", str(error)) from error

    def _paths(self) -> list[Path]:
        return sorted(path for path in self.directory.glob(f"checkpoint-*{SUFFIX}") if number_of(path) >= 0)

    def _remove_surplus(self, newest: int) -> None:
        keep = [number for number in self.numbers() if is_kept(number, newest - number)][: self.kept]
        for path in self._paths():
            if number_of(path) not in keep:
                path.unlink(missing_ok=True)
        for part in self.directory.glob(f"*{PART}"):
            part.unlink(missing_ok=True)


def is_kept(number: int, age: int) -> bool:
    """Whether the checkpoint with this number is kept at this age, counted in checkpoints.

    The newest four, then two of every four, two of every eight and so on: a few dozen reach back for months.
    """
    return age < 4 or number % (1 << (age.bit_length() - 2)) == 0


def number_of(path: Path) -> int:
    """The running number in a checkpoint's name, -1 where it is none of ours."""
    text = path.stem.removeprefix("checkpoint-")
    return int(text) if text.isdigit() else -1


def _read_meta(path: Path) -> CheckpointMeta:
    with open(path, "rb") as file:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size or head[: len(MAGIC)] != MAGIC:
            raise ModelFileError("not a checkpoint")
        length = _HEAD.unpack(head)[1]
        if length > 2**24:
            raise ModelFileError("not a checkpoint")
        try:
            return CheckpointMeta(**json.loads(file.read(length))["meta"])
        except (ValueError, KeyError, TypeError) as error:
            raise ModelFileError(f"its header does not fit: {error!r}") from error
