"""Operator's commands: requests over zenoh, their journal, and the table of statuses (docs/operating.md).

`operate` sends a command and `statuses` collects the statuses of all instances; `screen` shows them. `OperationsServer`
takes the commands of one axis, runs its verbs and writes them to a `Journal`. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.operating.remote import Standbys as Standbys
    from dehyst.service.operating.remote import operate as operate
    from dehyst.service.operating.remote import screen as screen
    from dehyst.service.operating.remote import statuses as statuses
    from dehyst.service.operating.server import Journal as Journal
    from dehyst.service.operating.server import OperationsServer as OperationsServer
    from dehyst.service.operating.verbs import Request as Request

__getattr__ = lazy_names(__name__)
