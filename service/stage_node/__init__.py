"""A simulated stage as a process: it takes voltages by sequence number and publishes samples in real time.

`StageNode` runs the units of a `NodeConfig`; `fault_key` and `status_key` name the keys of its faults and its status.
The names are loaded on first use: the keys and faults alone do not load the simulation.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from service.stage_node.faults import Fault, Injector, fault_key
    from service.stage_node.node import NodeConfig, StageNode, status_key

__all__ = ["Fault", "Injector", "NodeConfig", "StageNode", "fault_key", "status_key"]

_MODULES: Final = {
    "NodeConfig": "service.stage_node.node",
    "StageNode": "service.stage_node.node",
    "status_key": "service.stage_node.node",
    "Fault": "service.stage_node.faults",
    "Injector": "service.stage_node.faults",
    "fault_key": "service.stage_node.faults",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
