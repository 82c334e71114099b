"""An adoption of hyper-parameters as an event at a definite sample: announced, written down, read again, applied.

The file ``retuned.jsonl`` beside a recording holds one line an adoption. Applied at the same samples again, a replay
gives the same snapshots to the last bit, whenever the background work was done.
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

    ``seq`` counts on where a stage began its count anew, as the learner's does.
    """

    seq: int
    gamma: float
    widths: tuple[float, ...]

    @property
    def hyper(self) -> Hyperparameters:
        return Hyperparameters(self.gamma, self.widths)

    def to_json(self) -> dict[str, Any]:
        """As it is written into the event and the file; numbers come back to the last bit."""
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
    """Adoptions that an axis has yet to make. Any thread may add; the one that handles samples applies."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Replaced whole, so that the look at each sample takes no lock.
        self._pending: tuple[Retuned, ...] = ()
        self.adopted = 0
        self.refused = 0

    @property
    def pending(self) -> tuple[Retuned, ...]:
        """Those to come, in order."""
        return self._pending

    def replace(self, pending: Sequence[Retuned]) -> None:
        """Go on from another's ``pending``."""
        with self._lock:
            self._pending = tuple(sorted(pending, key=lambda entry: entry.seq))

    def __bool__(self) -> bool:
        return bool(self._pending)

    def add(self, *retuned: Retuned) -> None:
        """Make these at their samples; one whose sample has passed is made at the next."""
        with self._lock:
            merged = {entry.seq: entry for entry in (*self._pending, *retuned)}
            self._pending = tuple(merged[seq] for seq in sorted(merged))

    def apply(self, seq: int, learner: OnlineModel) -> list[tuple[Retuned, str]]:
        """Make what is due after the sample ``seq``: each with "" or the reason why the learner refused it."""
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
    """Write an adoption into the folder of a recording; on the disk when it returns. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / FILE, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        # One write of a whole line in append mode: a crash leaves the line or nothing.
        os.write(handle, json.dumps(retuned.to_json()).encode() + b"\n")
        os.fsync(handle)
    finally:
        os.close(handle)


def read(folder: Path | str) -> Sequence[Retuned]:
    """The adoptions of a recording in order; none where there is no file. Raises InputError on a damaged line."""
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
                break  # cut off by a crash: it was never announced
            raise FieldError(f"{path}:{number}", line[:80], "a line of JSON") from error
        found.append(Retuned.from_json(values, f"{path}:{number}"))
    return found
