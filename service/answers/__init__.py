"""Answers to queries: voltages from the model or its stand-in, within the limits of the axis.

`answer` answers a query from `Served` snapshots; `answer_safely` computes the voltages from a model and the memory of
the caller, under `Rules`, and never raises. `Limits` bounds positions and voltages. Nothing here uses the wire or a
clock: the service and a follower in the client's process call the same functions. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.answers.answering import MemoryTracker as MemoryTracker
    from dehyst.service.answers.answering import Served as Served
    from dehyst.service.answers.answering import answer as answer
    from dehyst.service.answers.answering import derivatives as derivatives
    from dehyst.service.answers.fallback import Rules as Rules
    from dehyst.service.answers.fallback import answer_safely as answer_safely
    from dehyst.service.answers.guard import Limits as Limits
    from dehyst.service.answers.which_model import Answering as Answering
    from dehyst.service.answers.which_model import trust_by_age as trust_by_age

__getattr__ = lazy_names(__name__)
