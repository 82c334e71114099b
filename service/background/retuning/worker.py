"""The process that tunes: ``python -m service.background.retuning.worker FOLDER``, of the lowest priority.

See ``service.background.job`` for what it finds in the folder and leaves there.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from adaptive.types import FloatArray
from service.background.job import work


def main(arguments: list[str]) -> int:
    """Do one order. Returns 0; what goes wrong is in the result."""
    return work(Path(arguments[0]), tuned)


def tuned(order: dict[str, Any], arrays: dict[str, FloatArray]) -> dict[str, Any]:
    """``order``: ``{"kind": "propose", "search": {...}, "torch": bool}`` on the window ``before`` of the arrays, or
    ``{"kind": "compare", "search": {...}, "gamma", "widths"}`` on ``before`` and ``after``."""
    from adaptive.errors import DehystError
    from adaptive.tuning.config import RetuneConfig
    from adaptive.tuning.retuning import compare, propose
    from adaptive.types import Hyperparameters
    from service.background.retuning.job import unpack

    data = {name: unpack(name, arrays) for name in ("before", "after") if f"{name}.kernel" in arrays}
    ranges = {name: tuple(order["search"][name]) for name in ("gamma_range", "width_range")}
    config = RetuneConfig(**{**order["search"], **ranges})
    try:
        if order["kind"] == "compare":
            hyper = Hyperparameters(float(order["gamma"]), tuple(float(width) for width in order["widths"]))
            trial = compare(data["before"], data["after"], hyper, config)
            return asdict(trial)
        search, by = _search(bool(order["torch"]))
        found = propose(data["before"], config, search)
    except DehystError as error:
        return {"error": str(error)}
    return {
        "gamma": found.hyper.gamma,
        "widths": list(found.hyper.widths),
        "changed": found.hyper != data["before"].hyper,
        "J2": found.J2,
        "J2_before": found.J2_before,
        "evaluations": found.evaluations,
        "search": by,
    }


def _search(wanted: bool) -> tuple[Any, str]:
    """(what finds starts, its name): torch's batch where it is wanted and installed."""
    if wanted:
        from baselines.swarm.evidence_search import EvidenceSearch
        from baselines.swarm.particle_swarm import MissingTorchError, torch_module

        try:
            torch_module().set_num_threads(1)
            search = EvidenceSearch()
        except MissingTorchError:
            return None, "starts around the present (torch is not installed)"
        return search, f"torch on {search.device}"
    return None, "starts around the present"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
