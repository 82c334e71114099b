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
from typing import Any, Final

import zenoh

#: Log filter of zenoh: one line a refusal, none for what is allowed (those would cost microseconds a message).
_LOG: Final = ",".join(
    (
        "warn",
        "zenoh::net::routing::interceptor=trace",
        "zenoh::net::routing::interceptor::access_control=info",
    )
)
_PIPE_BYTES: Final = 1 << 20
_COLOUR: Final = re.compile(rb"\x1b\[[0-9;]*m")
#: Pattern of a log line -> its counter. The first matching pattern counts.
_PATTERNS: Final = (
    (re.compile(rb"interceptor: +Msg intercepted"), "messages"),
    (re.compile(rb"did not match any configured ACL subject"), "identities"),
    (re.compile(rb"zenoh_link_(tls|quic)\S*: .*"), "certificates"),
)
#: Lines of the modules asked for that are no refusals and need not be shown.
_NOISE: Final = re.compile(rb" (TRACE|DEBUG|INFO) ")

_installed: Refusals | None = None


class Refusals:
    """Counters of refusals since :func:`count_refusals`.

    ``certificates``: connections without a valid one. ``identities``: connections with a valid certificate of nobody
    who is known. ``messages``: publications, queries and declarations that access control dropped.
    """

    def __init__(self) -> None:
        self._counts = {name: 0 for _, name in _PATTERNS}
        self._rest = b""

    def counters(self) -> dict[str, int]:
        """A copy of the counters."""
        return dict(self._counts)

    def feed(self, chunk: bytes) -> bytes:
        """Count the lines in a piece of log; returns those that are to be shown."""
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        shown = []
        for line in lines:
            plain = _COLOUR.sub(b"", line)
            for pattern, name in _PATTERNS:
                if pattern.search(plain):
                    self._counts[name] += 1
                    break
            else:
                if plain.strip() and not _NOISE.search(plain):
                    shown.append(plain + b"\n")
        if len(self._rest) > _PIPE_BYTES:
            self._rest = b""
        return b"".join(shown)


def count_refusals() -> Refusals:
    """Begin to count, once a process; to be called before the first session is opened. Later calls return the same.

    The environment variable RUST_LOG, where set, is added to the filter and its lines go to the standard error.
    """
    global _installed
    if _installed is not None:
        return _installed
    asked = os.environ.get("RUST_LOG")
    os.environ["RUST_LOG"] = f"{_LOG},{asked}" if asked else _LOG
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    refusals = Refusals()
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
    threading.Thread(target=_read, args=(reading, refusals), name="refusals", daemon=True).start()
    _installed = refusals
    return refusals


def refusal_counters() -> dict[str, Any] | None:
    """For the status: the counters, or None where nothing is counted."""
    return None if _installed is None else _installed.counters()


def _read(reading: int, refusals: Refusals) -> None:
    while chunk := os.read(reading, _PIPE_BYTES):
        if shown := refusals.feed(chunk):
            with contextlib.suppress(OSError):
                os.write(2, shown)
