"""Events of an axis: kept for the wire, and written to the log of the process."""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import Any, Final

#: Parent of all loggers of axes: ``dehyst.axis.<stage>.<axis>``. Without a handler of the program nothing is printed.
LOGGER: Final = "dehyst.axis"
#: Levels of the events that are not information.
LEVELS: Final = {
    "learner_failed": logging.ERROR,
    "internal_error": logging.ERROR,
    "trouble": logging.WARNING,
    "stale": logging.WARNING,
    "samples_dropped": logging.WARNING,
    "malformed_samples": logging.WARNING,
    "contestant_failed": logging.WARNING,
    "checkpoint_failed": logging.WARNING,
    "checkpoint_refused": logging.WARNING,
    "journal_failed": logging.WARNING,
    "operation_refused": logging.WARNING,
    "standby_refused": logging.WARNING,
    "standby_differed": logging.WARNING,
}
#: Events that wait for the publisher; of a flood only the newest are kept.
_KEPT: Final = 256

logging.getLogger("dehyst").addHandler(logging.NullHandler())


class EventLog:
    """The events of one axis. Any thread may note and take.

    Parameters
    ----------
    stage, axis : names on the wire, for the name of the logger; ``stage`` may be empty.
    """

    def __init__(self, stage: str, axis: str) -> None:
        self._logger = logging.getLogger(".".join(name for name in (LOGGER, stage, axis) if name))
        self._waiting: deque[dict[str, Any]] = deque(maxlen=_KEPT)

    def note(self, seq: int, event: str, detail: str, **more: Any) -> None:
        """Keep an event with the number of the last sample and the present time, and log it.

        A standby publishes its events when it takes over, which may be much later.
        """
        self._waiting.append({"seq": seq, "event": event, "detail": detail, "time_unix_s": time.time(), **more})
        self._logger.log(LEVELS.get(event, logging.INFO), "%s: %s (sample %d)", event, detail, seq)

    def take(self) -> list[dict[str, Any]]:
        """The events since the last call, oldest first."""
        events = []
        while self._waiting:
            events.append(self._waiting.popleft())
        return events


class EventLimiter:
    """Limits repeated events: the first of a kind is told, and the next one after ``calm`` samples without any.

    A flood counts as one event; the counters still count each.
    """

    def __init__(self, calm: int) -> None:
        self._calm = calm
        self._last: dict[str, int] = {}

    def allows(self, event: str, received: int) -> bool:
        """Whether to tell ``event``, which has just occurred at sample number ``received`` of all that came."""
        last = self._last.get(event)
        self._last[event] = received
        return last is None or received - last > self._calm
