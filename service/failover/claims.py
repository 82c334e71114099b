"""Claims to serve an axis, and the rule by which one of several instances does.

An instance that serves holds a liveliness token with the number of its take-over, its *epoch*: one more than any it had
heard of. Of two that serve, the one with the lower epoch yields; with equal epochs the one whose name is the lower. So
a service that was stopped and comes back meets the higher claim of the one that took over, and stands down.
No clock decides anything.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from service.protocol.keys import Keys


@dataclass(frozen=True, slots=True, order=True)
class Claim:
    """Ordered by precedence: the greatest one serves."""

    epoch: int
    instance: str


def parse_claim(key: str) -> Claim | None:
    """The claim in the key of a token; None where it is none."""
    parts = key.split("/")
    return Claim(int(parts[-2]), parts[-1]) if len(parts) > 2 and parts[-2].isdigit() else None


class Claims:
    """The claims of others that are alive. The wire's thread tells; another one asks."""

    def __init__(self, keys: Keys, instance: str) -> None:
        self.keys = keys
        self.instance = instance
        self.changed = threading.Event()
        self._alive: set[Claim] = set()
        self._highest = 0
        self._lock = threading.Lock()

    def hear(self, key: str, alive: bool) -> None:
        """A token has come or gone."""
        claim = parse_claim(key)
        if claim is None or claim.instance == self.instance:
            return
        with self._lock:
            self._highest = max(self._highest, claim.epoch)
            (self._alive.add if alive else self._alive.discard)(claim)
        self.changed.set()

    def first(self) -> Claim | None:
        """The one of the others that takes precedence; None where there is none."""
        with self._lock:
            return max(self._alive, default=None)

    def next_epoch(self) -> int:
        """One more than any that was heard of."""
        with self._lock:
            return self._highest + 1
