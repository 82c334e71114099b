"""Which sample numbers have been seen, as few intervals as they make."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray


class Intervals:
    """A set of integers that come mostly in order; memory grows with the number of gaps only."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._stops: list[int] = []

    def __len__(self) -> int:
        return sum(stop - start for start, stop in zip(self._starts, self._stops, strict=True))

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The intervals, in order, as (first, one past the last)."""
        return list(zip(self._starts, self._stops, strict=True))

    def add(self, start: int, stop: int) -> None:
        """Take the numbers from ``start`` to ``stop`` - 1."""
        if stop <= start:
            return
        i = bisect_right(self._starts, start)
        # All that touch the new one are joined with it.
        first = i - 1 if i and self._stops[i - 1] >= start else i
        last = first
        while last < len(self._starts) and self._starts[last] <= stop:
            start, stop = min(start, self._starts[last]), max(stop, self._stops[last])
            last += 1
        self._starts[first:last] = [start]
        self._stops[first:last] = [stop]

    def add_all(self, numbers: NDArray[np.int64]) -> None:
        """Take numbers in any order."""
        if not numbers.size:
            return
        if numbers[-1] - numbers[0] + 1 == numbers.size and (np.diff(numbers) == 1).all():
            self.add(int(numbers[0]), int(numbers[-1]) + 1)
            return
        distinct = np.unique(numbers)
        breaks = np.flatnonzero(np.diff(distinct) != 1)
        for start, stop in zip(np.r_[0, breaks + 1], np.r_[breaks, distinct.size - 1], strict=True):
            self.add(int(distinct[start]), int(distinct[stop]) + 1)

    def minus(self, other: Intervals) -> list[tuple[int, int]]:
        """What is here and not in ``other``, as (first, one past the last)."""
        missing = []
        for start, stop in self.spans:
            at = start
            for other_start, other_stop in other.spans:
                if other_stop <= at or other_start >= stop:
                    continue
                if other_start > at:
                    missing.append((at, other_start))
                at = max(at, other_stop)
            if at < stop:
                missing.append((at, stop))
        return missing
