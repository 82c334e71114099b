"""What a direct test says of one cause."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sight:
    """What a direct test of the readings says of the cause ``name``.

    ``seen``: True or False; None where the recording does not excite the test. ``words``: what was seen, with its
    numbers, or what is missing.
    """

    name: str
    seen: bool | None
    words: str
