"""How a recorder writes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from service.errors import FieldError

#: Folder, in that of a recorder, for samples that were never handled; what reads a folder passes over such names.
ASIDE: Final = "_aside"


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """How a recorder writes.

    Attributes
    ----------
    directory : where the segments go; made if missing. One axis has one directory.
    segment_rows : samples a segment holds before it is closed (600,000 are ten minutes at 1 kHz, some 15 MB).
    max_bytes : all closed segments together, bytes; the oldest are removed beyond that. The journals of the newest two
    segments, 40 bytes a sample, come on top.
    queue_samples : samples that may wait for the disk.
    flush_s : longest time that a sample waits in memory, s. It is about a millisecond where the disk keeps up: handing
    samples over wakes who writes them. And how often it is looked whether a segment is closed.
    sync_s : longest time that a sample waits for the disk itself, s: what a cut of the power loses.
    retry_s : pause after a failure of the disk, s.
    """

    directory: Path
    segment_rows: int = 600_000
    max_bytes: int = 2_000_000_000
    queue_samples: int = 100_000
    flush_s: float = 0.03
    sync_s: float = 5.0
    retry_s: float = 5.0

    def __post_init__(self) -> None:
        for name, least in (("segment_rows", 1), ("max_bytes", 1), ("queue_samples", 1)):
            value = getattr(self, name)
            if value < least:
                raise FieldError(name, value, f"a whole number of at least {least}")
        for name in ("flush_s", "sync_s", "retry_s"):
            if not getattr(self, name) > 0.0:
                raise FieldError(name, getattr(self, name), "a positive time in s")

    def aside(self) -> RecorderConfig:
        """For samples that nobody handles: beside the others, with a tenth of their share of the disk on top of it."""
        return replace(self, directory=self.directory / ASIDE, max_bytes=max(1, self.max_bytes // 10))
