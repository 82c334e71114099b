"""What a serving process has in use and how it grows: the slope that a soak tells, with its doubt."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np

from adaptive.types import FloatArray
from lab.soak.verdict.ledger import Ledger

T = TypeVar("T")

#: Warm-up: half of a process' life, within these, s. Rings fill and kinds of work are done for the first time for a
#: quarter of an hour. What has lived shorter than the last of them after it is not judged.
MEMORY_WARM_S: Final = (180.0, 900.0)
MEMORY_LEAST_S: Final = 300.0
#: A process under faults has a few levels of memory in use: as the one that serves, as the one that stands by, with a
#: state just handed over. Seen over half an hour of three processes that did not grow: 134.4 to 137.4 MB. A line from
#: one of them to another is no growth.
LEVELS_KB: Final = 4_000.0
_MINUTE_S: Final = 60.0
#: Of a small object of Python's on average: its allocator's pools over their blocks, as measured in a service.
_BLOCK_BYTES: Final = 100.0


@dataclass(frozen=True, slots=True)
class Trend:
    """A slope and by how much it may be wrong, both kB per hour."""

    slope: float
    doubt: float


def memory_slopes(ledger: Ledger) -> list[Trend]:
    """What the serving processes that lived longest after their warm-up have in use, the one that grows most surely
    first; empty where none lived long enough. Where the allocator cannot tell what is in use, their resident memory.

    What is in use is what the learner, its snapshots and its marks hold: it goes up and down by megabytes when faults
    take samples from the window, change the model or the role. A slope of 1 MB an hour shows in half an hour without
    faults, and in hours with them; the doubt says so.
    """
    used, levels_kb = _in_use(ledger), LEVELS_KB if ledger.faults else 0.0
    of = np.median if used else np.min
    trends = _longest(used or _resident(ledger), lambda t, kb: _trend(*_minutes(t, kb, of), levels_kb))
    return sorted(trends, key=lambda trend: trend.doubt - trend.slope)


def resident_growth(ledger: Ledger) -> float | None:
    """MB by which the resident memory of those processes ended above where it was after their warm-up, at most: the
    least of the last five minutes less the least of the first five. None where none lived for ten."""

    def growth(t_s: FloatArray, kb: FloatArray) -> float:
        first, last = t_s <= t_s[0] + MEMORY_LEAST_S, t_s >= t_s[-1] - MEMORY_LEAST_S
        return float(kb[last].min() - kb[first].min()) / 1024.0

    return max(_longest(_resident(ledger), growth, 2.0 * MEMORY_LEAST_S), default=None)


def _longest(
    rows: Mapping[str, list[tuple[float, float]]],
    what: Callable[[FloatArray, FloatArray], T],
    least_s: float = MEMORY_LEAST_S,
) -> list[T]:
    """Of each process that lived as long as the longest, to a minute; what is before its warm-up left out."""
    found: list[tuple[float, T]] = []
    for taken in rows.values():
        t, kb = (np.array(column) for column in zip(*taken, strict=True))
        after = t >= t[0] + warm_up_s(float(np.ptp(t)))
        lived = float(np.ptp(t[after])) if after.any() else 0.0
        if lived >= least_s:
            found.append((lived, what(t[after], kb[after])))
    longest = max((lived for lived, _ in found), default=0.0)
    return [told for lived, told in found if lived >= longest - _MINUTE_S]


def _resident(ledger: Ledger) -> dict[str, list[tuple[float, float]]]:
    """By serving process, (t_s, kB)."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name in ("a", "b", "service"):
        for t_s, kb, number in ledger.memory.get(name, []):
            found.setdefault(f"{name}-{number}", []).append((t_s, kb))
    return found


def _in_use(ledger: Ledger) -> dict[str, list[tuple[float, float]]]:
    """By instance, (t_s, kB): of the C library's allocator and of Python's."""
    found: dict[str, list[tuple[float, float]]] = {}
    for t_s, name, now in ledger.counters:
        if "memory.malloc_bytes" in now:
            kb = (now["memory.malloc_bytes"] + _BLOCK_BYTES * now["memory.python_blocks"]) / 1024.0
            found.setdefault(name, []).append((t_s, kb))
    return found


def warm_up_s(lived_s: float) -> float:
    """How much of the life of a process is its warm-up, s."""
    least_s, most_s = MEMORY_WARM_S
    return min(most_s, max(least_s, 0.5 * lived_s))


def _minutes(t_s: FloatArray, kb: FloatArray, of: Callable[[FloatArray], Any]) -> tuple[FloatArray, FloatArray]:
    """One value a minute, and its middle: what is in use for a moment (a state that is handed over, a checkpoint) is
    given back within a minute, and is no growth."""
    minute = ((t_s - t_s[0]) // _MINUTE_S).astype(np.int64)
    there = np.unique(minute)
    return t_s[0] + _MINUTE_S * (there + 0.5), np.array([float(of(kb[minute == m])) for m in there])


def _trend(t_s: FloatArray, kb: FloatArray, levels_kb: float) -> Trend:
    """Median of the slopes between the two halves (Theil and Sen's, each point with the one half a run later).

    ``levels_kb`` : by how much what is in use may differ from one minute to another without growing.
    """
    half = len(t_s) // 2
    slope = float(np.median((kb[half : 2 * half] - kb[:half]) / (t_s[half : 2 * half] - t_s[:half])))
    left = kb - slope * t_s
    left -= left.mean()
    square = float(left @ left)
    # What is above the line in one minute is so in the next: so many minutes count as one.
    alike = min(max(float(left[1:] @ left[:-1]) / square, 0.0), 0.9) if square > 0.0 else 0.0
    error = math.sqrt(
        square * (1.0 + alike) / (1.0 - alike) / max(len(kb) - 2, 1) / float(np.sum((t_s - t_s.mean()) ** 2))
    )
    return Trend(3600.0 * slope, 3600.0 * max(2.0 * error, levels_kb / float(np.ptp(t_s))))
