"""One thing that must hold in a soak: whether it did, the worst that was met, and the words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Invariant:
    """``held``, the worst value met, the limit it was held against, and both in words.

    ``held`` is None where the machine allowed no judgement; the text then says why.
    """

    held: bool | None
    worst: float | None
    limit: float
    unit: str
    text: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        worst = None if self.worst is None or not math.isfinite(self.worst) else round(self.worst, 6)
        return {"held": self.held, "worst": worst, "limit": self.limit, "unit": self.unit, "text": self.text}


def most(worst: float, limit: float, unit: str, text: str) -> Invariant:
    """Holds where ``worst`` is at most ``limit``."""
    return Invariant(bool(worst <= limit), float(worst), limit, unit, text)
