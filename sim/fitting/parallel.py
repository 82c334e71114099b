"""Run independent pieces of work on two threads. The compiled loops release the interpreter's lock."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

#: Each piece of work holds its own signals, so more threads would cost memory.
_MOST_THREADS = 2


class _Worker(threading.local):
    """Whether the current thread is one of the pool's."""

    busy: bool = False


_worker = _Worker()


def _mark_busy() -> None:
    _worker.busy = True


def side_by_side(work: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``work`` of each item, in order. A nested call runs its items one after the other.

    Raises the first exception that ``work`` raises.
    """
    todo = list(items)
    threads = min(_MOST_THREADS, os.cpu_count() or 1, len(todo))
    if threads < 2 or _worker.busy:
        return [work(item) for item in todo]
    with ThreadPoolExecutor(threads, "diagnosis", initializer=_mark_busy) as pool:
        return list(pool.map(work, todo))
