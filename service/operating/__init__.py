"""Operator's commands: requests over zenoh, their journal, and the table of statuses (docs/operating.md).

`operate` sends a command and `statuses` collects the statuses of all instances; `screen` shows them. `OperationsServer`
takes the commands of one axis, runs its `Verbs` and writes them to a `Journal`. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.operating.remote import Standbys, operate, screen, statuses
    from service.operating.server import Journal, OperationsServer
    from service.operating.verbs import Request, Verbs

_MODULES = {
    "Journal": "server",
    "OperationsServer": "server",
    "Request": "verbs",
    "Standbys": "remote",
    "Verbs": "verbs",
    "operate": "remote",
    "screen": "remote",
    "statuses": "remote",
}
__all__ = [
    "Journal",
    "OperationsServer",
    "Request",
    "Standbys",
    "Verbs",
    "operate",
    "screen",
    "statuses",
]

__getattr__ = lazy_names(__name__, _MODULES)
