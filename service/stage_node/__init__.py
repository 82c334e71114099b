"""A simulated stage as a process: it takes voltages by sequence number and publishes samples in real time.

`StageNode` runs the units of a `NodeConfig`; `fault_key` and `status_key` name the keys of its faults and its status.
The names are loaded on first use: the keys and faults alone do not load the simulation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.stage_node.faults import Fault as Fault
    from dehyst.service.stage_node.faults import Injector as Injector
    from dehyst.service.stage_node.faults import fault_key as fault_key
    from dehyst.service.stage_node.node import NodeConfig as NodeConfig
    from dehyst.service.stage_node.node import StageNode as StageNode
    from dehyst.service.stage_node.node import status_key as status_key

__getattr__ = lazy_names(__name__)
