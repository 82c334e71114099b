"""Counts connections and messages that zenoh refuses, from its log.

Access control drops a message without notice to either end. Each drop and wrong certificate shows only
as a line of zenoh's log, which goes to the standard output. A pipe therefore replaces the standard output of the
process; a thread reads it, counts refusals and passes other lines to the standard error. Python's own prints go to the
original standard output.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
from collections.abc import Iterable
from typing import Final

import zenoh

#: Log filter of zenoh: one line a refusal, none for what is allowed (those would cost microseconds a message).
_LOG: Final = "warn,zenoh::net::routing::interceptor=trace,zenoh::net::routing::interceptor::access_control=info"
_PIPE_BYTES: Final = 1 << 20
#: Counter -> what its lines have. The first one that fits counts.
_PATTERNS: Final = {
    "messages": re.compile(rb"interceptor: +Msg intercepted"),
    "identities": re.compile(rb"did not match any configured ACL subject"),
    "certificates": re.compile(rb"zenoh_link_(tls|quic)\S*: "),
}
#: Lines of the modules asked for that are no refusals and need not be shown.
_NOISE: Final = re.compile(rb" (TRACE|DEBUG|INFO) ")
_counts: Final[dict[str, int]] = {}


def count_refusals() -> None:
    """Begin to count, once a process; to be called before the first session is opened.

    The environment variable RUST_LOG, where set, is added to the filter and its lines go to the standard error.
    """
    if _counts:
        return
    _counts.update(dict.fromkeys(_PATTERNS, 0))
    os.environ["RUST_LOG"] = ",".join(filter(None, (_LOG, os.environ.get("RUST_LOG"))))
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    sys.stdout.flush()
    output = os.dup(1)
    reading, writing = os.pipe()
    # A flood of refusals must not hold up zenoh's threads while the reader waits for its turn.
    with contextlib.suppress(OSError, AttributeError, ImportError):
        import fcntl  # there is none on Windows

        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    os.dup2(writing, 1)
    os.close(writing)
    sys.stdout = os.fdopen(output, "w", encoding="utf-8", buffering=1, closefd=False)
    threading.Thread(target=_read, args=(os.fdopen(reading, "rb"),), name="refusals", daemon=True).start()


def refusal_counters() -> dict[str, int] | None:
    """For the status: a copy of the counters, or None where nothing is counted.

    ``certificates``: connections without a valid one. ``identities``: connections with a valid certificate of nobody
    who is known. ``messages``: publications, queries and declarations that access control dropped.
    """
    return dict(_counts) or None


def note(line: bytes, counts: dict[str, int]) -> bool:
    """Count a line of the log; returns whether it is another one that is to be shown."""
    plain = re.sub(rb"\x1b\[[0-9;]*m", b"", line)
    name = next((name for name, pattern in _PATTERNS.items() if pattern.search(plain)), None)
    if name is not None:
        counts[name] += 1
    return name is None and bool(plain.strip()) and not _NOISE.search(plain)


def _read(log: Iterable[bytes]) -> None:
    for line in log:
        if note(line, _counts):
            with contextlib.suppress(OSError):
                os.write(2, line)
