"""Compile the diagnosis' loops once, on a record of nothing much."""

from __future__ import annotations

import numpy as np

from sim.diagnosis import loops
from sim.diagnosis.dynamics import Dynamics, Restoring, respond


def warm() -> None:
    """Call every compiled loop of this package once."""
    u = np.linspace(0.0, 1.0, 8)
    two = np.array([0.1, 0.2])
    loops.bouc_wen_loop(u, 1.0, 0.9, 0.9, 0.0)
    loops.bouc_wen_paced(u, 1.0, 0.9, 0.9, 0.0, u, 0.1)
    loops.felt_rate(u, 0.5, 1.0)
    loops.grown_plays(u, two, two, u, u)
    loops.plays_sum(u, two, two)
    loops.plays_matrix(u, two)
    loops.lag_mean(u, 0.5)
    loops.slew_mean(u, 0.5)
    loops.slow_poles(u, two)
    loops.friction(u, 0.1, 0.5)
    loops.resample(u, 0.0, 0.5)
    system = Dynamics((2e-3,), ((300.0, 0.02),))
    respond(u, system, 5e-4)
    respond(u, system, 5e-4, Restoring(two, two))
