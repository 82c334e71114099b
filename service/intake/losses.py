"""Names the ways in which an axis loses the samples of its stage although they come.

A stage that is silent is stale. A stage whose samples come and are dropped, refused for their numbers, or contradicted
by another sender looks alive: the counters grow, and nothing is learnt. `SampleLosses` compares the counters of the
last second, once for each look of the publishing thread, and gives what is wrong a name.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

SAMPLES_DROPPED: Final = "samples_dropped"
SAMPLES_MALFORMED: Final = "samples_malformed"
SAMPLES_OUT_OF_ORDER: Final = "samples_out_of_order"
TWO_STAGES: Final = "two_stages"

#: What is compared: the counters of this time, s; the pause between two looks, s; and for how long it must hold, s.
WINDOW_S: Final = 1.0
_LOOK_S: Final = 0.1
_HOLDS_S: Final = 0.7
#: Fewest samples or messages that tell anything.
_LEAST: Final = 4
#: Shares of what came: dropped; refused for the number; of another sender, with as many in order at least.
_DROPPED: Final = 0.1
_REFUSED: Final = 0.6
_FOREIGN: Final = 0.4
_IN_ORDER: Final = 0.2


class Arrivals(NamedTuple):
    """Counts since the start.

    Attributes
    ----------
    received : samples that reached the axis. refused : of them, those refused for their number. foreign : of these,
    those that contradict a sample that came before, or belong to another count. dropped : samples for which the queue
    had no room. malformed : messages that could not be decoded.
    """

    received: int = 0
    refused: int = 0
    foreign: int = 0
    dropped: int = 0
    malformed: int = 0


class SampleLosses:
    """The watch over the arrivals of one axis. One thread calls it.

    Attributes
    ----------
    trouble : name of what is lost now, "" for nothing. why : the counts of the last second behind it.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self.why = ""
        self._marks: deque[tuple[float, Arrivals]] = deque()
        self._found = ""
        self._since_s = 0.0

    def look(self, now_s: float, arrivals: Arrivals) -> bool:
        """Judge the arrivals up to ``now_s`` (``time.monotonic``); whether `trouble` has changed."""
        marks = self._marks
        if marks and now_s - marks[-1][0] < _LOOK_S:
            return False
        marks.append((now_s, arrivals))
        while len(marks) > 2 and now_s - marks[1][0] >= WINDOW_S:
            marks.popleft()
        found, why = _named(Arrivals(*(now - then for now, then in zip(arrivals, marks[0][1], strict=True))))
        if found != self._found:
            self._found, self._since_s = found, now_s
        if found == self.trouble or (found and now_s - self._since_s < _HOLDS_S):
            return False
        self.trouble, self.why = found, why
        return True


def _named(came: Arrivals) -> tuple[str, str]:
    """(name, counts in words) of what the arrivals of a second show; ("", "") for nothing."""
    samples = came.received + came.dropped
    if came.malformed >= _LEAST and samples == 0:
        return SAMPLES_MALFORMED, f"{came.malformed} messages, none of which could be decoded"
    if samples < _LEAST:
        return "", ""
    if came.dropped > _DROPPED * samples:
        return SAMPLES_DROPPED, f"{came.dropped} of {samples} samples found no room in the queue"
    if came.foreign > _FOREIGN * samples and came.received - came.refused >= _IN_ORDER * samples:
        return TWO_STAGES, f"{came.foreign} of {samples} samples contradict the others: two stages send on one key"
    if came.refused > _REFUSED * samples:
        return SAMPLES_OUT_OF_ORDER, f"{came.refused} of {samples} samples were refused for their numbers"
    return "", ""
