"""The verdict of a direct test."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sight:
    """What a direct test of the readings says of a cause.

    ``seen``: True or False; None where the recording does not excite the test. ``words``: what was seen, with its
    numbers, or what is missing. ``also``: other causes that show the same in this recording.
    """

    seen: bool | None
    words: str
    also: tuple[str, ...] = ()
