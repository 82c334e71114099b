"""Compiles the loops of this package once, so that no process waits for it at start."""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.types import Sample
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse
from dehyst.baselines.bouc_wen.online import BoucWenOnline, TrackingConfig
from dehyst.baselines.common import Domain
from dehyst.baselines.online_baseline import LeastSquaresConfig
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline
from dehyst.baselines.prandtl_ishlinskii.operators import play_run
from dehyst.baselines.swarm import TABLE_2_1_UPPER, bouc_wen_costs


def warm() -> None:
    """Call every compiled function on tiny inputs of the types that it is used with."""
    u, rest, domain = np.array([0.0, 1.0, 0.2]), np.zeros(3), Domain(0.0, 20.0, 1e4)
    TABLE_2_1.simulate(u, 1e-3)
    TABLE_2_1.with_gain(11.0, 0.0).motion(u, 1e-3)
    mpi = MpiParameters((0.0, 0.5), (8.0, 2.0), (0.0, 5.0), (1.0, -0.1), lag_s=1e-3)
    play_run(u, mpi.r_, mpi.start())
    mpi.simulate(u, 1e-3)
    bouc_wen_costs(TABLE_2_1_UPPER[None, :] * 0.4, u, u, 1e-3)
    bouc_wen, inverse = BoucWenInverse(TABLE_2_1, 1e-3, domain, 0.01), MpiInverse(mpi, 1e-3, domain, 0.01)
    for model in (bouc_wen, inverse):
        memory = model.rest_memory(1.0)
        model.feedforward(u, rest, rest, memory)
        model.track(u, rest, rest, u, memory)
    for online in (
        BoucWenOnline(bouc_wen, TrackingConfig(settle=0, learn_every=1)),
        MpiOnline(inverse, LeastSquaresConfig(settle=0, learn_every=5)),
    ):
        for k in range(20):
            online.handle(Sample(k, k * 1e-3, 0.1 * k, k))


if __name__ == "__main__":
    warm()
