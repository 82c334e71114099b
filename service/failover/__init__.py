"""Failover of an axis: one instance serves, standbys hold the same model, and one of them takes over if it fails.

`role_control` decides the role of an instance, `claims` holds the rule of precedence, `reachability` detects a lost
router, `standby_model` keeps the model of a standby equal to the served one, `state_transfer` sends its state, and
`peer_files` reads what the other instance has left on the disk. The names are loaded on first use: the server needs
some of these modules, and `role_control` needs the server.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from service.failover.peer_files import PeerFiles, standby_folder
    from service.failover.reachability import Reachability
    from service.failover.role_control import RoleControl

__all__ = ["PeerFiles", "Reachability", "RoleControl", "standby_folder"]

_MODULES: Final = {
    "PeerFiles": "service.failover.peer_files",
    "Reachability": "service.failover.reachability",
    "RoleControl": "service.failover.role_control",
    "standby_folder": "service.failover.peer_files",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
