"""Independent pieces of work on two cores. The compiled loops let go of the interpreter, so threads are enough."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

#: More would only add to the memory: each piece holds its own signals.
_MOST = 2
_within = threading.local()


def side_by_side(work: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``work`` of each item, in order; pieces of a piece are done one after the other. Raises what the first raises."""
    todo = list(items)
    threads = min(_MOST, os.cpu_count() or 1, len(todo))
    if threads < 2 or getattr(_within, "piece", False):
        return [work(item) for item in todo]

    def begin() -> None:
        _within.piece = True

    with ThreadPoolExecutor(threads, "piece", initializer=begin) as pool:
        return list(pool.map(work, todo))
