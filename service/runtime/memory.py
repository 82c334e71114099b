"""Memory of a process that runs for months: what is freed goes back to the system, and does not add up in pieces."""

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

#: How often what is free inside the heaps is given back, s: it takes milliseconds, in which who asks for some waits.
TRIM_S: Final = 60.0

#: By default glibc has eight heaps a core, of which each keeps what its threads have ever needed at once, and puts even
#: the megabytes of a learner's state between small things, once one such block has been freed.
_OPTIONS: Final = {_ARENA_MAX: 2, _MMAP_THRESHOLD: 256 * 1024, _TRIM_THRESHOLD: 1024 * 1024}


def keep_little() -> bool:
    """Few heaps, and large blocks apart from them. False where the C library is another one, which is left as it is."""
    if not sys.platform.startswith("linux"):
        return False
    with contextlib.suppress(OSError, AttributeError):
        return all([_library().mallopt(option, value) == 1 for option, value in _OPTIONS.items()])
    return False


def give_back() -> bool:
    """Give what is free inside the heaps back to the system. False where the C library is another one."""
    if not sys.platform.startswith("linux"):
        return False
    with contextlib.suppress(OSError, AttributeError):
        return bool(_library().malloc_trim(0) >= 0)
    return False


@contextlib.contextmanager
def starting() -> Iterator[Callable[[], None]]:
    """While a process starts there is much to look through for garbage, and none to find. Call what is yielded once it
    has started: what is there by then stays, and is never looked through again.

    A collection of all of a serving process holds everybody up for 0.1 to 0.3 s; one of what it made since, for
    milliseconds.
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
    given back to it (None where that cannot tell); ``python_blocks``, of Python's own allocator for small objects.

    Resident memory goes up and down by megabytes with what lies free between other things; the other two do not, and
    tell a leak early.
    """
    return {
        "resident_bytes": _PROCESS.memory_info().rss,
        "malloc_bytes": _malloc_bytes(),
        "python_blocks": sys.getallocatedblocks(),
    }


def _malloc_bytes() -> int | None:
    if not sys.platform.startswith("linux"):
        return None
    with contextlib.suppress(OSError, AttributeError):
        told = _library().mallinfo2()
        return int(told.uordblks + told.hblkhd)
    return None


@cache
def _library() -> ctypes.CDLL:
    """The C library, opened once: each time anew leaves classes behind, in circles that are found late."""
    library = ctypes.CDLL(None)
    with contextlib.suppress(AttributeError):  # the C library is older than this function, or another one
        library.mallinfo2.restype = _Mallinfo2
    return library
