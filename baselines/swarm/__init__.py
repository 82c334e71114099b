"""Searches that need torch: identification by particle swarm, and starts for hyper-parameters by gradient descent.

`swarm_bouc_wen` and `swarm_mpi` identify, `EvidenceSearch` finds starts. Without torch they raise `MissingTorchError`.
The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.baselines.swarm.evidence_search import EvidenceSearch as EvidenceSearch
    from dehyst.baselines.swarm.identification import MissingTorchError as MissingTorchError
    from dehyst.baselines.swarm.identification import swarm_bouc_wen as swarm_bouc_wen
    from dehyst.baselines.swarm.identification import swarm_mpi as swarm_mpi

__getattr__ = lazy_names(__name__)
