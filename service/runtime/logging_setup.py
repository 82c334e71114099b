"""Set up the standard library's logging for a process: one handler that writes to stderr.

Messages of this project have loggers below ``dehyst``. Under systemd each line begins with its priority ("<4>") and has
no time, since the journal adds both; elsewhere it has time, level and logger.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import Final, TextIO

#: Priorities of syslog, (level, priority), from the highest level on.
_PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG_PRIORITY: Final = 7


class _JournalFormatter(logging.Formatter):
    """``<priority>logger: message``; every line of a message has the prefix, as the journal reads line by line."""

    def format(self, record: logging.LogRecord) -> str:
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), _DEBUG_PRIORITY)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


def set_up_logging(level: str = "warning", stream: TextIO | None = None) -> None:
    """Write messages of ``dehyst`` from ``level`` on to ``stream`` (stderr), others from warnings on.

    ``level`` is the name of one of logging's levels in lower case. A later call replaces the handler of an earlier one.
    """
    stream = sys.stderr if stream is None else stream
    handler = logging.StreamHandler(stream)
    handler.set_name("dehyst")
    if is_journal(stream):
        handler.setFormatter(_JournalFormatter("%(name)s: %(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root, ours = logging.getLogger(), logging.getLogger("dehyst")
    for old in [each for each in root.handlers if each.get_name() == "dehyst"]:
        root.removeHandler(old)
    root.addHandler(handler)
    ours.setLevel(level.upper())
    root.setLevel(max(ours.level, logging.WARNING))


def is_journal(stream: TextIO) -> bool:
    """Whether systemd's journal reads ``stream``: JOURNAL_STREAM holds the device and inode of it."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
