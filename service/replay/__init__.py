"""Replay of a recording through an axis, offline: the same code and the same decisions as live.

`replay.replay` runs a recording and returns a `Replayed`; `summary` gives its figures, `write_gates` the verdict on
each sample, `draw_errors` and `draw_gates` pictures. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.replay.replay import Replayed, covered, draw_errors, draw_gates, summary, write_gates

_MODULES = {
    "Replayed": "replay",
    "covered": "replay",
    "draw_errors": "replay",
    "draw_gates": "replay",
    "summary": "replay",
    "write_gates": "replay",
}
__all__ = [
    "Replayed",
    "covered",
    "draw_errors",
    "draw_gates",
    "summary",
    "write_gates",
]

__getattr__ = lazy_names(__name__, _MODULES)
