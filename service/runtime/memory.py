"""Memory of a process that runs for months: freed memory returns to the system instead of fragmenting the heaps."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import sys
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, ClassVar, Final

import psutil

# Of glibc's malloc.h.
_TRIM_THRESHOLD: Final = -1
_MMAP_THRESHOLD: Final = -3
_ARENA_MAX: Final = -8

#: Interval at which free memory of the heaps is returned, s; it takes milliseconds, in which allocations wait.
TRIM_S: Final = 60.0

#: By default glibc has eight heaps a core, of which each keeps what its threads have ever needed at once, and puts even
#: the megabytes of a learner's state between small things, once one such block has been freed.
_OPTIONS: Final = {_ARENA_MAX: 2, _MMAP_THRESHOLD: 256 * 1024, _TRIM_THRESHOLD: 1024 * 1024}


def keep_little() -> bool:
    """Use few heaps, and keep large blocks out of them. False, without effect, if the C library is not glibc."""
    return all([_asked("mallopt", option, value) == 1 for option, value in _OPTIONS.items()])


def give_back() -> bool:
    """Return free memory of the heaps to the system. False if the C library is not glibc."""
    return _asked("malloc_trim", 0) is not None


@contextlib.contextmanager
def starting() -> Iterator[Callable[[], None]]:
    """Switch the garbage collector off while a process starts. Call the yielded function once it has started.

    Objects that exist by then are excluded from later collections. A full collection of a serving process stops all
    threads for 0.1 to 0.3 s; one of the objects made since takes milliseconds.
    """
    gc.disable()

    def started() -> None:
        gc.freeze()
        gc.enable()

    try:
        yield started
    finally:
        gc.enable()


_PROCESS: Final = psutil.Process()
_MALLINFO2: Final = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"


class _Mallinfo2(ctypes.Structure):
    """Of glibc's malloc.h, from 2.33 on; bytes and numbers of blocks, over all heaps."""

    _fields_: ClassVar[list[tuple[str, Any]]] = [(name, ctypes.c_size_t) for name in _MALLINFO2.split()]


def in_use() -> dict[str, int | None]:
    """What this process holds: ``resident_bytes``; ``malloc_bytes``, handed out by the C library's allocator and not
    given back to it; ``python_blocks``, of Python's own allocator for small objects. None for what cannot be told.

    Resident memory goes up and down by megabytes with what lies free between other things; the other two do not, and
    tell a leak early.
    """
    resident_bytes = None
    with contextlib.suppress(OSError):  # no file descriptor is left: a status needs none
        resident_bytes = int(_PROCESS.memory_info().rss)
    told = _asked("mallinfo2")
    malloc_bytes = None if told is None else int(told.uordblks + told.hblkhd)
    blocks = sys.getallocatedblocks()
    return {"resident_bytes": resident_bytes, "malloc_bytes": malloc_bytes, "python_blocks": blocks}


def _asked(function: str, *values: int) -> Any:
    """What a function of glibc returns; None if the C library is another one, or older than the function."""
    if not sys.platform.startswith("linux"):
        return None
    with contextlib.suppress(OSError, AttributeError):
        return getattr(_library(), function)(*values)


@cache
def _library() -> ctypes.CDLL:
    """The C library, opened once: each opening leaves classes in reference cycles behind."""
    library = ctypes.CDLL(None)
    with contextlib.suppress(AttributeError):
        library.mallinfo2.restype = _Mallinfo2
    return library
