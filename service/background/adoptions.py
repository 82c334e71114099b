"""Adoptions of hyper-parameters, each at a definite sample: announced, stored, read and applied.

The file ``retuned.jsonl`` beside a recording holds one line per adoption. A replay applies them at the same samples and
gives the same snapshots bit by bit, however long the background work took.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.state import Entry, load
from dehyst.adaptive.types import Hyperparameters, OnlineModel
from dehyst.service.protocol.errors import FieldError
from dehyst.service.storage.output import append_line

ADOPTIONS_FILE: Final = "retuned.jsonl"


@dataclass(frozen=True, slots=True)
class Retuned:
    """Hyper-parameters that take effect right after the sample with the number ``seq``.

    ``seq`` continues when a stage restarts its count, as the number in the learner does.
    """

    seq: Annotated[int, Entry("number of the sample")]
    gamma: Annotated[float, Entry("weight of the errors", low=5e-324)]
    widths: Annotated[tuple[float, ...], Entry("widths of the kernel", low=5e-324)]

    def __post_init__(self) -> None:
        if not self.widths:
            raise ValueError("widths: got none, expected one or more")

    @property
    def hyper(self) -> Hyperparameters:
        return Hyperparameters(self.gamma, self.widths)

    def to_json(self) -> dict[str, Any]:
        """As written into the event and the file; floating-point numbers are restored exactly."""
        return {"seq": self.seq, "gamma": self.gamma, "widths": list(self.widths)}

    @classmethod
    def from_json(cls, values: Any, where: str = "retuned") -> Retuned:
        """Inverse of :meth:`to_json`. Raises InputError naming the field."""
        try:
            return load(cls, {**values, "widths": np.array(values["widths"], dtype=np.float64)})
        except (KeyError, TypeError, ValueError, DehystError) as error:
            expected = "an object with seq, gamma and widths: an integer, and positive numbers"
            raise FieldError(where, f"{str(values)[:80]} ({str(error).partition(';')[0]})", expected) from error


class Adoptions:
    """Pending adoptions of an axis. Any thread may add; the thread that handles samples applies.

    Attributes
    ----------
    pending : those that wait, in the order of their samples. adopted, refused : counts of the others.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Replaced as a whole, so that the check at each sample needs no lock.
        self.pending: tuple[Retuned, ...] = ()
        self.adopted = 0
        self.refused = 0

    def add(self, *retuned: Retuned) -> None:
        """Schedule adoptions at their samples; one whose sample has passed is applied at the next sample."""
        with self._lock:
            merged = {entry.seq: entry for entry in (*self.pending, *retuned)}
            self.pending = tuple(merged[seq] for seq in sorted(merged))

    def apply(self, seq: int, learner: OnlineModel) -> list[tuple[Retuned, str]]:
        """Apply the adoptions due after the sample ``seq``; returns each with "" or the reason for a refusal."""
        if not self.pending or self.pending[0].seq > seq:
            return []
        with self._lock:
            due = [entry for entry in self.pending if entry.seq <= seq]
            self.pending = self.pending[len(due) :]
        done = []
        for entry in due:
            refused = learner.adopt(entry.hyper)
            self.adopted += not refused
            self.refused += bool(refused)
            done.append((entry, refused))
        return done


def append_adoption(folder: Path, retuned: Retuned) -> None:
    """Append an adoption to the file in the folder of a recording and sync it to the disk. Raises OSError."""
    append_line(folder / ADOPTIONS_FILE, json.dumps(retuned.to_json()).encode() + b"\n")


def read_adoptions(folder: Path | str) -> Sequence[Retuned]:
    """The adoptions of a recording, in order; empty without a file. Raises InputError on a damaged line."""
    path = Path(folder) / ADOPTIONS_FILE
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
