"""The process that tunes (see `service.background.job`): ``-m service.background.retuning.worker FOLDER``."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Any

from adaptive.types import FloatArray
from service.background.job import run_worker


def tuned(order: dict[str, Any], arrays: dict[str, FloatArray]) -> dict[str, Any]:
    """The result of one order.

    ``order`` is ``{"kind": "propose", "search": {...}, "torch": bool}`` for the window ``before`` in the arrays, or
    ``{"kind": "compare", "search": {...}, "gamma", "widths"}`` for ``before`` and ``after``. Raises DehystError.
    """
    from adaptive.tuning.config import RetuneConfig
    from adaptive.tuning.retuning import compare, propose
    from adaptive.types import Hyperparameters
    from service.background.retuning.job import unpack

    data = {name: unpack(name, arrays) for name in ("before", "after") if f"{name}.kernel" in arrays}
    ranges = {name: tuple(order["search"][name]) for name in ("gamma_range", "width_range")}
    config = RetuneConfig(**{**order["search"], **ranges})
    if order["kind"] == "compare":
        hyper = Hyperparameters(float(order["gamma"]), tuple(float(width) for width in order["widths"]))
        trial = compare(data["before"], data["after"], hyper, config)
        return asdict(trial)
    search, by = _search(bool(order["torch"]))
    found = propose(data["before"], config, search)
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
    """(search for starting points, its name): the batch search with torch if it is wanted and installed."""
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
    sys.exit(run_worker(tuned))
