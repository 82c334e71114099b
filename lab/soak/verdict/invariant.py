"""One thing that must hold in a soak: whether it did, the worst that was met, and the words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True, slots=True)
class Invariant:
    """``held``, the worst value met, the limit it was held against, and both in words.

    ``held`` is None where this run allowed no judgement; ``why`` then says so in a few words, ``text`` in more.
    """

    held: bool | None
    worst: float | None
    limit: float
    unit: str
    text: str
    why: str = ""

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        worst = None if self.worst is None or not math.isfinite(self.worst) else round(self.worst, 6)
        told = {"held": self.held, "worst": worst, "limit": self.limit, "unit": self.unit, "text": self.text}
        return told | {"why": self.why}


def most(worst: float, limit: float, unit: str, text: str) -> Invariant:
    """Holds where ``worst`` is at most ``limit``."""
    return Invariant(bool(worst <= limit), float(worst), limit, unit, text)


def worse(one: Invariant, other: Invariant) -> Invariant:
    """Of two stretches of one run: broken where either is, judged where either could be, the worst of both."""
    found = max((one, other), key=lambda i: -math.inf if i.worst is None else i.worst)
    held = False if False in (one.held, other.held) else True if True in (one.held, other.held) else None
    return replace(found, held=held, why=found.why if held is None else "")


def added(one: Invariant, other: Invariant) -> Invariant:
    """Of two stretches of one run in which something is counted."""
    return most((one.worst or 0.0) + (other.worst or 0.0), other.limit, other.unit, other.text)


def unjudged(limit: float, unit: str, why: str, text: str = "") -> Invariant:
    """What this run does not tell, and why."""
    return Invariant(None, None, limit, unit, f"{text}: not judged" if text else f"not judged: {why}", why)
