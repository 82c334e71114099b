"""Answers to queries: voltages from the model or its stand-in, within the limits of the axis.

`answer` answers a query from `Served` snapshots; `answer_safely` computes the voltages from a model and the memory of
the caller, under `Rules`, and never raises. `Limits` bounds positions and voltages. Nothing here uses the wire or a
clock: the service and a follower in the client's process call the same functions. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.answers.answering import MemoryTracker, Served, answer, derivatives, trust_by_age
    from service.answers.fallback import Rules, answer_safely
    from service.answers.guard import Limits

_MODULES = {
    "Limits": "guard",
    "MemoryTracker": "answering",
    "Rules": "fallback",
    "Served": "answering",
    "answer": "answering",
    "answer_safely": "fallback",
    "derivatives": "answering",
    "trust_by_age": "answering",
}
__all__ = [
    "Limits",
    "MemoryTracker",
    "Rules",
    "Served",
    "answer",
    "answer_safely",
    "derivatives",
    "trust_by_age",
]

__getattr__ = lazy_names(__name__, _MODULES)
