"""Checkpoints of a fleet: one file for each axis, in the format of a single learner's (docs/protocol.md).

The axes are written in turn, so that each is once in a period; a file replaces the axis' last one. The learner of such
a file and that of an axis of its own are the same entries. Numbers of samples are not continued: after a restart an
axis takes its next sample whatever its number.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.fleet.fleet import Fleet
from dehyst.adaptive.types import StateDict, prefixed, under
from dehyst.service.config.settings import LEARN
from dehyst.service.protocol.model import digests
from dehyst.service.storage.checkpoint import LOCK, SUFFIX, CheckpointMeta, decode_checkpoint, encode_checkpoint
from dehyst.service.storage.output import atomic_write
from dehyst.service.storage.owner import FolderOwner

#: How long a start waits for a process that still holds the folder, s.
_HOLD_S = 5.0
#: Most copies of states that wait to be written.
_MOST_WAITING = 3


class FleetCheckpoints:
    """Writes the axes of ``fleet`` in turn, each once in ``period_s``, in the thread ``checkpoints-fleet_0``.

    Raises FieldError where the folder is another's.
    """

    def __init__(self, fleet: Fleet, directory: Path, stage: str, instance: str, period_s: float) -> None:
        self._owner = FolderOwner(directory, LOCK, f"{stage}/fleet")
        self._owner.hold("fleet.checkpoints", _HOLD_S)
        self._fleet, self._directory, self._names = fleet, directory, (stage, instance)
        self._step_s = period_s / fleet.axes
        self._axis, self._due_s = 0, time.monotonic()
        self._writer = ThreadPoolExecutor(1, "checkpoints-fleet")
        self._writing: list[Future[None]] = []
        #: Why the last file was refused.
        self.error = ""
        self.counts = {"written": 0, "errors": 0, "restored": 0, "refused": 0}

    def restore(self, axes: Iterable[int]) -> list[int]:
        """Continue axes from their files; returns those that do. What does not fit is counted, its axis stays."""
        stage, dt_s, restored = self._names[0], self._fleet.bases[0].dt_s, []
        for axis in axes:
            if not self._path(axis).exists():
                continue
            try:
                meta, state = decode_checkpoint(self._path(axis).read_bytes())
                # Of a service with competing models, the one that learns.
                learns = {name: found for name, found in meta.models.items() if name == LEARN}
                replace(meta, models=learns).refuse_unless(stage, self._name(axis), dt_s, self._identified(axis))
                learner = under("learner.", state)
                self._fleet.load_axis(axis, under(f"model.{LEARN}.", learner) or learner, anew=True)
                restored.append(axis)
            except (OSError, DehystError) as error:
                self.counts["refused"] += 1
                self.error = f"{self._path(axis)}: {error}"
        self.counts["restored"] += len(restored)
        return restored

    def write_due(self) -> None:
        """Copy the axes that are due, in the thread that learns; fewer where the disk is slower."""
        self._writing = [one for one in self._writing if not one.done()]
        while time.monotonic() >= self._due_s and len(self._writing) < _MOST_WAITING:
            self._copy(self._axis)
            self._axis = (self._axis + 1) % self._fleet.axes
            self._due_s += self._step_s
        self._due_s = max(self._due_s, time.monotonic() - self._step_s)

    def close(self) -> None:
        """Write all axes once more and end the thread."""
        self.write(range(self._fleet.axes))
        self._writer.shutdown()
        self._owner.release()

    def write(self, axes: Iterable[int]) -> bool:
        """Write some axes now and wait for the disk; whether all of them are there."""
        errors, all_known = self.counts["errors"], True
        for axis in axes:
            all_known &= self._copy(axis)
            # One at a time: a state may be megabytes.
            wait(self._writing)
        return all_known and self.counts["errors"] == errors

    def _copy(self, axis: int) -> bool:
        """Copy the state of an axis to be written; False where it never had a sample."""
        learner, (stage, instance) = self._fleet.learner_of(axis), self._names
        if learner.memory_for(learner.base) is None:
            return False
        unix_s = time.time()
        samples = int(self._fleet.outcomes()[axis].sum())
        meta = CheckpointMeta(
            stage, self._name(axis), self._fleet.bases[0].dt_s, learner.seq, samples, unix_s, instance,
            models=self._identified(axis),
        )  # fmt: skip
        self._writing.append(self._writer.submit(self._write, axis, meta, learner.state_dict()))
        return True

    def _write(self, axis: int, meta: CheckpointMeta, state: StateDict) -> None:
        try:
            with atomic_write(self._path(axis)) as file:
                file.writelines(encode_checkpoint(meta, prefixed("learner.", state)))
            self.counts["written"] += 1
        except OSError:
            self.counts["errors"] += 1

    def _identified(self, axis: int) -> dict[str, str]:
        return digests({LEARN: self._fleet.bases[axis]})

    def _path(self, axis: int) -> Path:
        return self._directory / f"{self._name(axis)}{SUFFIX}"

    @staticmethod
    def _name(axis: int) -> str:
        """The axis as a service of a single axis may be called: its files are those of such a service."""
        return f"axis-{axis:04d}"
