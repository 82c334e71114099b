"""Checkpoints: the complete state of an axis in one file, and the folder that keeps them.

Layout: 8 bytes ``DHCKPT01``, u64 length of the JSON header, 16 bytes BLAKE2b of everything behind them, then the body
of `service.protocol.container`. A serving instance sends the same bytes to its standby. A file with a wrong digest is
refused.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from dehyst.adaptive.errors import DehystError, ModelFileError
from dehyst.adaptive.state import Entry, load
from dehyst.adaptive.types import OnlineModel, StateDict, joined, under
from dehyst.service.intake.sample_queue import SampleQueue
from dehyst.service.operating.server import Switch
from dehyst.service.protocol import container
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.learner_supervisor import STATE_SCHEMA, restored_learner
from dehyst.service.storage.output import atomic_write
from dehyst.service.storage.owner import FolderOwner
from dehyst.service.storage.segments import rows_behind

# --- Files.

MAGIC: Final = b"DHCKPT01"
_HEAD: Final = struct.Struct("<8sQ16s")
SUFFIX: Final = ".ckpt"
#: File that says whose checkpoints a folder holds, see `FolderOwner`.
LOCK: Final = ".lock-checkpoints"
#: Checkpoints that are never removed to make room on a full disk.
_LEAST_KEPT: Final = 2


@dataclass(frozen=True, slots=True)
class CheckpointMeta:
    """The axis and the sample that a checkpoint belongs to, declared as the state itself (`adaptive.state`)."""

    stage: Annotated[str, Entry("stage on the wire")]
    axis: Annotated[str, Entry("axis on the wire")]
    dt_s: Annotated[float, Entry("sample time", "s", low=5e-324)]
    seq: Annotated[int, Entry("the last sample handled")]
    samples: Annotated[int, Entry("count of all samples handled")]
    time_unix_s: Annotated[float, Entry("time of writing, to be shown and for operations in the journal", "s")] = 0.0
    instance: Annotated[str, Entry("the instance that wrote it")] = ""
    schema: Annotated[int, Entry("version of the state")] = STATE_SCHEMA
    models: Annotated[dict[str, str], Entry("digests of the models in the model file that it grew from")] = field(
        default_factory=dict
    )
    units: Annotated[dict[str, str], Entry("those of the model file")] = field(default_factory=container.UNITS.copy)

    @classmethod
    def of(cls, header: Mapping[str, Any]) -> CheckpointMeta:
        """From the header of a file. Raises ModelFileError."""
        try:
            tables = {name: value for name, value in header["meta"].items() if isinstance(value, dict)}
            rest = {name: value for name, value in header["meta"].items() if name not in tables}
        except (KeyError, AttributeError) as error:
            raise ModelFileError(f"its header is not valid: {error!r}") from error
        return load(cls, rest | joined(tables))

    def refuse_unless(self, stage: str, axis: str, dt_s: float, models: Mapping[str, str]) -> None:
        """Raise ModelFileError with the reason if the checkpoint is of another axis, model file or version."""
        for name, got, wanted in (
            ("schema", self.schema, STATE_SCHEMA),
            ("stage", self.stage, stage),
            ("axis", self.axis, axis),
            ("sample time", self.dt_s, dt_s),
            ("units", self.units, container.UNITS),
        ):
            if got != wanted:
                raise ModelFileError(f"{name} is {got!r}, expected {wanted!r}")
        for name in sorted(self.models.keys() | models.keys()):
            got, wanted = (str(some.get(name, "missing"))[:40] for some in (self.models, models))
            if got != wanted:
                raise ModelFileError(
                    f"it grew from another model file: the digest of {name!r} is {got}, in the present file {wanted}; "
                    "the present file serves; put the old one back to continue"
                )


def encode_checkpoint(meta: CheckpointMeta, state: StateDict) -> list[Any]:
    """The bytes of a checkpoint as buffers in order; arrays are not copied."""
    values, arrays = container.split_state(state)
    body = container.encode_body({"meta": asdict(meta), "values": values}, arrays)
    digest = hashlib.blake2b(digest_size=16)
    for buffer in body:
        digest.update(buffer)
    return [_HEAD.pack(MAGIC, len(body[0]), digest.digest()), *body]


def decode_checkpoint(data: bytes) -> tuple[CheckpointMeta, StateDict]:
    """(meta, state). Raises ModelFileError if the bytes are cut off, damaged or foreign."""
    if len(data) < _HEAD.size:
        raise ModelFileError("cut off in its header")
    magic, length, digest = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise ModelFileError("not a checkpoint of this program")
    body = memoryview(data)[_HEAD.size :]
    if length > len(body) or hashlib.blake2b(body, digest_size=16).digest() != digest:
        raise ModelFileError("damaged or cut off: its digest does not match")
    try:
        header, arrays = container.decode_body(body, length, len(body))
        return CheckpointMeta.of(header), dict(header["values"]) | arrays
    except (ValueError, KeyError, TypeError) as error:
        raise ModelFileError(f"its header is not valid: {error!r}") from error


class CheckpointFolder:
    """The checkpoints of one axis: all of the newest, and older ones at growing distances (see `is_kept`).

    One process writes; any number may read.
    """

    def __init__(
        self, directory: Path, stage: str, axis: str, dt_s: float, models: Mapping[str, str], kept: int
    ) -> None:
        self.directory = directory
        self.kept = kept
        #: Checkpoints that a start refused.
        self.refused = 0
        self._belongs = (stage, axis, dt_s, models)
        #: Until when checkpoints are kept, by their number, by ``time.monotonic``, s.
        self._pinned: dict[int, float] = {}

    def pin(self, now_s: float, until_s: float) -> frozenset[int]:
        """Keep all that stay by their age at ``now_s`` until ``until_s`` (``time.monotonic``) at least; their numbers.

        A full disk still takes them. One that is kept only by an earlier pin is not pinned again: frequent listing must
        not keep them all.
        """
        numbers = self.numbers()
        kept = self._regular(max(numbers, default=0), numbers)
        pinned = {number: end_s for number, end_s in self._pinned.items() if end_s > now_s}
        self._pinned = pinned | dict.fromkeys(kept, until_s)
        return frozenset(kept)

    def write(self, meta: CheckpointMeta, state: StateDict) -> Path:
        """Write a checkpoint under the next number, atomically and synced. Raises OSError."""
        self.directory.mkdir(parents=True, exist_ok=True)
        number = max((number_of(path) for path in self._paths()), default=0) + 1
        path = self.directory / f"checkpoint-{number:09d}{SUFFIX}"
        buffers = encode_checkpoint(meta, state)
        while True:
            try:
                with atomic_write(path) as file:
                    for buffer in buffers:
                        file.write(buffer)
                break
            except OSError as error:
                # A full disk: the oldest checkpoint is worth less than the newest.
                oldest = self._paths()[:-_LEAST_KEPT]
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not oldest:
                    raise
                oldest[0].unlink(missing_ok=True)
        self._remove_surplus(number)
        return path

    def entries(self) -> list[dict[str, Any]]:
        """checkpoint (number), seq, samples, time_unix_s and bytes of each, newest first, without unreadable ones."""
        found = []
        for path in reversed(self._paths()):
            with contextlib.suppress(OSError, ModelFileError):
                meta = _read_meta(path)
                told = {name: getattr(meta, name) for name in ("seq", "samples", "time_unix_s")}
                found.append({"checkpoint": number_of(path), **told, "bytes": path.stat().st_size})
        return found

    def read(self, number: int) -> tuple[CheckpointMeta, StateDict]:
        """(meta, state) of one checkpoint. Raises ModelFileError if it is damaged, or of another axis or model file."""
        path = self.directory / f"checkpoint-{number:09d}{SUFFIX}"
        try:
            meta, state = decode_checkpoint(path.read_bytes())
        except OSError as error:
            raise ModelFileError(f"cannot be read: {error.strerror or error}") from error
        meta.refuse_unless(*self._belongs)
        return meta, state

    def numbers(self) -> list[int]:
        """Numbers of all checkpoints, newest first."""
        return [number_of(path) for path in reversed(self._paths())]

    def learner_of(self, number: int, like: OnlineModel) -> OnlineModel:
        """The learner of a checkpoint.

        Raises InputError if it does not exist or does not match ``like``.
        """
        if number not in self.numbers():
            known = ", ".join(map(str, self.numbers()[:8])) or "none"
            raise FieldError("checkpoint", number, f"one of those there are ({known} ...)", "see 'checkpoints'")
        try:
            state = self.read(number)[1]
            return restored_learner(under("learner.", state), like)
        except ModelFileError as error:
            raise FieldError("checkpoint", number, "one that is whole and matches", str(error)) from error

    def _paths(self) -> list[Path]:
        return sorted(path for path in self.directory.glob(f"checkpoint-*{SUFFIX}") if number_of(path) >= 0)

    def _regular(self, newest: int, numbers: list[int]) -> list[int]:
        """Those of ``numbers``, newest first, that stay by their age."""
        return [number for number in numbers if is_kept(number, newest - number)][: self.kept]

    def _remove_surplus(self, newest: int) -> None:
        now_s = time.monotonic()
        keep = {*self._regular(newest, self.numbers())}
        keep |= {number for number, until_s in self._pinned.items() if now_s < until_s}
        for path in self._paths():
            if number_of(path) not in keep:
                path.unlink(missing_ok=True)
        for part in self.directory.glob("*checkpoint-*part"):  # left by a process that was killed while it wrote
            part.unlink(missing_ok=True)


def is_kept(number: int, age: int) -> bool:
    """Whether the checkpoint with this number is kept at ``age``, counted in checkpoints.

    The newest four are kept, then two of every four, two of every eight and so on: a few dozen cover months.
    """
    return age < 4 or number % (1 << (age.bit_length() - 2)) == 0


def number_of(path: Path) -> int:
    """The number in a checkpoint's file name; -1 if the file is not a checkpoint."""
    text = path.stem.removeprefix("checkpoint-")
    return int(text) if text.isdigit() else -1


def _read_meta(path: Path) -> CheckpointMeta:
    with open(path, "rb") as file:
        magic, length, _ = _HEAD.unpack(file.read(_HEAD.size).ljust(_HEAD.size))
        if magic != MAGIC or length > container.MAX_HEADER_BYTES:
            raise ModelFileError("not a checkpoint")
        try:
            return CheckpointMeta.of(container.decode_header(file.read(length)))
        except ValueError as error:
            raise ModelFileError(f"its header is not valid: {error}") from error


# --- Writes the checkpoints of an axis, and restores an axis from a checkpoint and the journal behind it.
#
# The thread that handles samples only copies the state; a thread of its own encodes and writes it.


#: Most samples that a restart learns again (one minute at 1 kHz, which takes 3 s), and samples per portion.
_MOST_AGAIN = 60_000
#: Time, s, for which checkpoints are kept after they were listed.
LISTED_S: Final = 300.0
_PORTION = 100


class CheckpointKeeper:
    """Writes the checkpoints of one axis. A failing disk costs checkpoints only; they are counted."""

    def __init__(
        self,
        axis: Axis,
        queue: SampleQueue,
        stage: str,
        instance: str,
        folder: CheckpointFolder | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder = folder
        self._axis = axis
        self._queue = queue
        self._clock = clock
        self._names = (stage, axis.config.name, instance)
        self._copied: tuple[CheckpointMeta, StateDict] | None = None
        #: Copies made; of which the newest that is on the disk, and the newest that was tried.
        self._copies = self._on_disk = self._tried = 0
        self._ready = threading.Condition()
        self._closing = False
        self._due_at_s = 0.0
        self._written_at_s: float | None = None
        self._owner = None if folder is None else FolderOwner(folder.directory, LOCK, f"{stage}/{axis.config.name}")
        self._bytes = 0
        #: Bytes of all checkpoints that were written.
        self.bytes_in_all = 0
        self._counts: dict[str, Any] = {"written": 0, "errors": 0, "degraded": False, "error": ""}
        self._thread = threading.Thread(target=self._run, name=f"checkpoints-{axis.config.name}", daemon=True)
        if folder is not None:
            self._thread.start()

    def hold(self, timeout_s: float) -> None:
        """Hold the folder for this process: two services would remove and restore each other's files.

        Waits ``timeout_s`` for a process that ends. Raises FieldError where the folder stays another's.
        """
        if self._owner is not None:
            self._owner.hold("checkpoints", timeout_s)

    def on_snapshot(self) -> None:
        """Copy the state if a checkpoint is due. Call it in the thread of the axis, right after a snapshot."""
        now_s = self._clock()
        if now_s >= self._due_at_s:
            self._due_at_s = now_s + self._axis.config.checkpoint_s
            self.copy_now()

    def keep_listed(self) -> frozenset[int]:
        """The checkpoints that may be shown to an operator, who may go back to one: they stay for `LISTED_S`."""
        now_s = self._clock()
        return frozenset() if self.folder is None else self.folder.pin(now_s, now_s + LISTED_S)

    def copy_now(self) -> None:
        """Copy the present state, to be written. Call it in the thread that handles samples."""
        if self.folder is None:
            return
        copied = (self._meta(), self._axis.state_dict())
        with self._ready:
            # Replaces a copy that has not been written yet.
            self._copied = copied
            self._copies += 1
            self._ready.notify_all()

    def wait_written(self, timeout_s: float) -> bool:
        """Wait until the last copy, or a later one, is on the disk; False if it is not, or no checkpoints are kept."""
        if self.folder is None:
            return False
        with self._ready:
            wanted = self._copies
            self._ready.wait_for(lambda: self._tried >= wanted, timeout_s)
            return self._on_disk >= wanted

    def state(self, timeout_s: float = 2.0) -> tuple[CheckpointMeta, StateDict]:
        """(meta, copy of the state), for a standby. Raises ServiceError if the learner does not respond in time."""
        return self._queue.call(lambda: (self._meta(), self._axis.state_dict()), timeout_s)

    def counters(self) -> dict[str, Any] | None:
        """Checkpoints written, and refused at the start; age of the newest, s, and its size; failures of the disk.

        None if no checkpoints are written.
        """
        if self.folder is None:
            return None
        at = self._written_at_s
        a_day = round(self._bytes * 86_400.0 / self._axis.config.checkpoint_s)
        ages = {"refused": self.folder.refused, "age_s": None if at is None else time.monotonic() - at}
        return {**self._counts, **ages, "bytes": self._bytes, "bytes_per_day": a_day}

    def close(self) -> None:
        """Write the last state and end the thread. Call it after the thread that handles samples has ended."""
        if self.folder is None:
            return
        self.copy_now()
        with self._ready:
            self._closing = True
            self._ready.notify_all()
        self._thread.join(10.0)
        if self._owner is not None:
            self._owner.release()

    def _meta(self) -> CheckpointMeta:
        (stage, name, instance), axis = self._names, self._axis
        seq, samples, unix_s = axis.handled_seq, axis.sequence.received, time.time()
        return CheckpointMeta(stage, name, axis.dt_s, seq, samples, unix_s, instance, models=axis.identified)

    def _run(self) -> None:
        assert self.folder is not None
        assert self._owner is not None
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._copied is not None or self._closing)
                if self._copied is None:
                    return
                (meta, state), self._copied = self._copied, None
                copy = self._copies
            on_disk = self._on_disk
            try:
                self._owner.take()
                self._bytes = self.folder.write(meta, state).stat().st_size
                self.bytes_in_all += self._bytes
                self._counts.update(written=self._counts["written"] + 1, degraded=False, error="")
                self._written_at_s, on_disk = time.monotonic(), copy
            except (OSError, DehystError, ValueError) as error:
                words = (isinstance(error, OSError) and error.strerror) or str(error)
                if not self._counts["degraded"]:
                    self._axis.note("checkpoint_failed", f"{words}; tried again")
                self._counts.update(errors=self._counts["errors"] + 1, degraded=True, error=words)
            with self._ready:
                self._tried, self._on_disk = copy, on_disk
                self._ready.notify_all()


def restore_newest(
    axis: Axis,
    folder: CheckpointFolder,
    recordings: Path | None = None,
    switch: Switch | None = None,
    whose: str = "",
    wanted: Callable[[CheckpointMeta], bool] = lambda _: True,
) -> int | None:
    """Restore ``axis`` from the newest checkpoint that is complete and matches; returns its number, None for none.

    Then the samples behind it in ``recordings`` are learnt, and ``switch`` is applied at its sample unless it is in the
    checkpoint. A refused checkpoint is noted as an event with the reason, and the previous one is tried.

    ``whose`` : words behind a number. ``wanted`` : whether to restore the first that matches; else none is.
    """
    for number in folder.numbers():
        try:
            meta, state = folder.read(number)
            if not wanted(meta):
                return None
            axis.restore(state)
        except (ModelFileError, OSError) as error:
            folder.refused += 1
            axis.note("checkpoint_refused", f"checkpoint {number}{whose}: {error}")
            continue
        axis.note("restored", f"from checkpoint {number}{whose}, sample {meta.seq}", checkpoint=number)
        known = switch is None or switch.is_in(meta.samples, meta.time_unix_s, meta.instance)
        learn_again(axis, recordings, None if known else switch)
        return number
    return None


def learn_again(axis: Axis, recordings: Path | None, switch: Switch | None = None) -> int:
    """Learn the samples after the restored state again, from the journals in the folder ``recordings``, if any.

    ``switch`` : an operator's command that the restored state does not include; it is applied after the sample after
    which it held, or at the end if the journals do not reach that far. Returns the number of samples. They are not
    recorded a second time.
    """
    begun = axis.sequence.received
    samples = None if recordings is None else rows_behind(recordings, begun, axis.owner)
    count = 0 if samples is None else len(samples)
    first = max(0, count - _MOST_AGAIN)
    at = count + 1 if switch is None else min(max(switch.samples - begun, first), count)
    start = first
    while samples is not None and start < count:
        if start == at and switch is not None:
            axis.set_frozen(switch.freezes, switch.who)
        stop = min(start + _PORTION, count, at if start < at else count)
        part = slice(start, stop)
        axis.handle(SampleBatch(samples.seq[part], samples.t_s[part], samples.u_V[part], samples.y_um[part]))
        start = stop
    if switch is not None and at >= count:
        axis.set_frozen(switch.freezes, switch.who)
    if samples is not None:
        axis.note("learnt_again", f"{count - first} samples from the journal")
    return count - first
