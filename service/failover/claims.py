"""Claims to serve an axis, and the rule that decides which instance serves.

A serving instance holds a liveliness token with its *epoch*: one more than any epoch that it knew when it took over. Of
two serving instances the one with the lower epoch stands down; with equal epochs, the one with the lower name. An
instance that was suspended therefore stands down when it returns, because its successor has the higher epoch. Clocks
are not compared.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from service.protocol.keys import Keys


@dataclass(frozen=True, slots=True, order=True)
class Claim:
    """One claim; the greatest one has precedence."""

    epoch: int
    instance: str


def parse_claim(key: str) -> Claim | None:
    """The claim in the key of a token; None if the key is not a claim."""
    parts = key.split("/")
    return Claim(int(parts[-2]), parts[-1]) if len(parts) > 2 and parts[-2].isdigit() else None


class Claims:
    """The claims of other instances that are alive. Zenoh's thread updates them, the thread of the role reads them.

    Attributes
    ----------
    changed : set after every update.
    """

    def __init__(self, keys: Keys, instance: str) -> None:
        self.keys = keys
        self.instance = instance
        self.changed = threading.Event()
        self._alive: set[Claim] = set()
        self._highest_epoch = 0
        self._lock = threading.Lock()

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared (``alive``) or disappeared."""
        claim = parse_claim(key)
        if claim is None or claim.instance == self.instance:
            return
        with self._lock:
            self._highest_epoch = max(self._highest_epoch, claim.epoch)
            (self._alive.add if alive else self._alive.discard)(claim)
        self.changed.set()

    def highest(self) -> Claim | None:
        """The claim with precedence among the others; None if there is none."""
        with self._lock:
            return max(self._alive, default=None)

    def next_epoch(self) -> int:
        """One more than any known epoch."""
        with self._lock:
            return self._highest_epoch + 1
