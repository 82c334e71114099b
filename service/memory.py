"""Memory of a process that runs for months: what is freed goes back to the system, and does not add up in pieces."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from typing import Final

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
        library = ctypes.CDLL(None)
        return all([library.mallopt(option, value) == 1 for option, value in _OPTIONS.items()])
    return False


def give_back() -> bool:
    """Give what is free inside the heaps back to the system. False where the C library is another one."""
    if not sys.platform.startswith("linux"):
        return False
    with contextlib.suppress(OSError, AttributeError):
        return bool(ctypes.CDLL(None).malloc_trim(0) >= 0)
    return False
