"""A simulated stage as a process: it takes voltages by sequence number and publishes samples in real time.

`StageNode` runs the units of a `NodeConfig`; `fault_key` and `status_key` name the keys of its faults and its status.
The names are loaded on first use: the keys and faults alone do not load the simulation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.stage_node.faults import Fault, Injector, fault_key
    from service.stage_node.node import NodeConfig, StageNode, status_key

__all__ = ["Fault", "Injector", "NodeConfig", "StageNode", "fault_key", "status_key"]

_MODULES: Final = {
    "NodeConfig": "node",
    "StageNode": "node",
    "status_key": "node",
    "Fault": "faults",
    "Injector": "faults",
    "fault_key": "faults",
}

__getattr__ = lazy_names(__name__, _MODULES)
