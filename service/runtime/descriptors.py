"""File descriptors of a process: enough at the start, and plain words where none is left."""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
from typing import Any, Final

from dehyst.service.protocol.errors import FieldError

# Now: where no descriptor is left, nothing can be imported.
resource: Any = None
with contextlib.suppress(ImportError):  # Windows
    resource = importlib.import_module("resource")

#: Descriptors that serving needs: of the process and its session, of as many connections, and of each axis (recording,
#: checkpoint, locks, and the pipes of three processes beside it, a few of which are open at a time).
_OWN: Final = 32
_CONNECTIONS: Final = 32
_AN_AXIS: Final = 16
#: That a session of a client opens.
_SESSION: Final = 10


def need_descriptors(axes: int) -> None:
    """Make sure that ``axes`` axes can be served: a soft limit below the need is raised to the hard one.

    Raises FieldError with the need and the limit where that is not enough.
    """
    needed = _OWN + _CONNECTIONS + _AN_AXIS * axes
    limit = _raised(needed)
    if limit is not None and limit < needed:
        raise FieldError(
            "file descriptors",
            f"a limit of {limit}",
            f"at least {needed} for {axes} axes and their clients",
            f"'ulimit -n {needed}' before the start, or LimitNOFILE of the systemd unit",
        )


def too_few() -> str:
    """In words that this process cannot open what a session needs, and what to do; "" where it can."""
    opened: list[int] = []
    try:
        for _ in range(_SESSION):
            opened.append(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        return too_many(error)
    finally:
        for one in opened:
            os.close(one)
    return ""


def too_many(error: OSError) -> str:
    """The same for an error of the system; "" for another one."""
    if error.errno == errno.EMFILE:
        return (
            f"too few file descriptors are left in this process, the limit is {_raised(0)}: raise it with 'ulimit -n'"
        )
    if error.errno == errno.ENFILE:
        return "no file descriptor is left on this machine: close programs, or raise fs.file-max"
    return ""


def _raised(needed: int) -> int | None:
    """The limit of open files, after it was raised where it is below ``needed``; None where there is none."""
    if resource is None:
        return None
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return None
    if soft < needed:
        # Some systems have no hard limit and refuse to go without one.
        for wanted in (hard, needed):
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
                break
        soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return None if soft == resource.RLIM_INFINITY else soft
