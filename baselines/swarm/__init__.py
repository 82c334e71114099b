"""Searches that need torch: identification by particle swarm, and starts for hyper-parameters by gradient descent.

`swarm_bouc_wen` and `swarm_mpi` identify, `EvidenceSearch` finds starts. Without torch they raise `MissingTorchError`.
The names are loaded on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from baselines.swarm.evidence_search import EvidenceSearch
    from baselines.swarm.identification import swarm_bouc_wen, swarm_mpi
    from baselines.swarm.particle_swarm import MissingTorchError

_MODULES = {
    "EvidenceSearch": "evidence_search",
    "MissingTorchError": "particle_swarm",
    "swarm_bouc_wen": "identification",
    "swarm_mpi": "identification",
}
__all__ = [
    "EvidenceSearch",
    "MissingTorchError",
    "swarm_bouc_wen",
    "swarm_mpi",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
