"""Adoptions of hyper-parameters, each at a definite sample: announced, stored, read and applied.

The file ``retuned.jsonl`` beside a recording holds one line per adoption. A replay applies them at the same samples and
gives the same snapshots bit by bit, however long the background work took.
"""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from adaptive.types import Hyperparameters, OnlineModel
from service.protocol.errors import FieldError

FILE: Final = "retuned.jsonl"


@dataclass(frozen=True, slots=True)
class Retuned:
    """Hyper-parameters that take effect right after the sample with the number ``seq``.

    ``seq`` continues when a stage restarts its count, as the number in the learner does.
    """

    seq: int
    gamma: float
    widths: tuple[float, ...]

    @property
    def hyper(self) -> Hyperparameters:
        return Hyperparameters(self.gamma, self.widths)

    def to_json(self) -> dict[str, Any]:
        """As written into the event and the file; floating-point numbers are restored exactly."""
        return {"seq": self.seq, "gamma": self.gamma, "widths": list(self.widths)}

    @classmethod
    def from_json(cls, values: Any, where: str = "retuned") -> Retuned:
        """Inverse of :meth:`to_json`. Raises InputError naming the field."""
        if not isinstance(values, dict):
            raise FieldError(where, repr(values)[:80], "an object with seq, gamma and widths")
        seq, gamma, widths = (values.get(name) for name in ("seq", "gamma", "widths"))
        if not isinstance(seq, int) or isinstance(seq, bool):
            raise FieldError(f"{where}.seq", repr(seq), "an integer")
        if not isinstance(widths, list) or not widths:
            raise FieldError(f"{where}.widths", repr(widths)[:80], "a list of one or more numbers")
        for name, value in (("gamma", gamma), *((f"widths[{i}]", width) for i, width in enumerate(widths))):
            if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 < value < math.inf:
                raise FieldError(f"{where}.{name}", repr(value)[:80], "a positive number")
        return cls(seq, float(gamma), tuple(float(width) for width in widths))  # type: ignore[arg-type]


class Adoptions:
    """Pending adoptions of an axis. Any thread may add; the thread that handles samples applies."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Replaced as a whole, so that the check at each sample needs no lock.
        self._pending: tuple[Retuned, ...] = ()
        self.adopted = 0
        self.refused = 0

    @property
    def pending(self) -> tuple[Retuned, ...]:
        """Pending adoptions, in the order of their samples."""
        return self._pending

    def replace(self, pending: Sequence[Retuned]) -> None:
        """Continue with the pending adoptions of another axis or of a stored state."""
        with self._lock:
            self._pending = tuple(sorted(pending, key=lambda entry: entry.seq))

    def __bool__(self) -> bool:
        return bool(self._pending)

    def add(self, *retuned: Retuned) -> None:
        """Schedule adoptions at their samples; one whose sample has passed is applied at the next sample."""
        with self._lock:
            merged = {entry.seq: entry for entry in (*self._pending, *retuned)}
            self._pending = tuple(merged[seq] for seq in sorted(merged))

    def apply(self, seq: int, learner: OnlineModel) -> list[tuple[Retuned, str]]:
        """Apply the adoptions due after the sample ``seq``; returns each with "" or the reason for a refusal."""
        if not self._pending or self._pending[0].seq > seq:
            return []
        with self._lock:
            due = [entry for entry in self._pending if entry.seq <= seq]
            self._pending = self._pending[len(due) :]
        done = []
        for entry in due:
            refused = learner.adopt(entry.hyper)
            self.adopted += not refused
            self.refused += bool(refused)
            done.append((entry, refused))
        return done


def append(folder: Path, retuned: Retuned) -> None:
    """Append an adoption to the file in the folder of a recording and sync it to the disk. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / FILE, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        # One write of a whole line in append mode: a crash leaves the line or nothing.
        os.write(handle, json.dumps(retuned.to_json()).encode() + b"\n")
        os.fsync(handle)
    finally:
        os.close(handle)


def read(folder: Path | str) -> Sequence[Retuned]:
    """The adoptions of a recording, in order; empty without a file. Raises InputError on a damaged line."""
    path = Path(folder) / FILE
    if not path.is_file():
        return []
    found = []
    lines = path.read_text(encoding="utf-8").split("\n")
    for number, line in enumerate(lines, 1):
        if not line:
            continue
        try:
            values = json.loads(line)
        except ValueError as error:
            if number == len(lines):
                break  # cut off by a crash
            raise FieldError(f"{path}:{number}", line[:80], "a line of JSON") from error
        found.append(Retuned.from_json(values, f"{path}:{number}"))
    return found
