"""Compile the diagnosis' loops once, on a record of nothing much."""

from __future__ import annotations

import numpy as np

from sim.diagnosis.causes.slip_dates import dated, moved, slips_of
from sim.diagnosis.model import loops, loops_linear
from sim.diagnosis.model.dynamics import Dynamics, respond
from sim.diagnosis.model.restoring_force import Loop, Stops


def warm() -> None:
    """Call every compiled loop of this package once."""
    u = np.linspace(0.0, 1.0, 8)
    two = np.array([0.1, 0.2])
    loops.bouc_wen_loop(u, 1.0, 0.9, 0.9, 0.0)
    loops.bouc_wen_paced(u, 1.0, 0.9, 0.9, 0.0, u, 0.1)
    loops.felt_rate(u, 0.5, 1.0)
    loops.grown_plays(u, two, two, u, u)
    loops.asymmetric(u, u, u, np.zeros(6), two, two, two, np.ones(3), 1.0)
    loops.plays_nested(u, two, two)
    loops_linear.lag_ends(u, 0.5, True)
    loops_linear.slew_ends(u, 0.5, True)
    loops_linear.slow_poles(u, two)
    loops_linear.friction(u, 0.1, 0.5)
    loops_linear.resample(u, 0.0, 0.5)
    there = np.ones(u.size, dtype=np.bool_)
    slips_of(u, u, there)
    moved(dated(((4, 1),), u, u, there), u, u, there)
    system = Dynamics((2e-3,), ((300.0, 0.02),))
    respond(u, system, 5e-4)
    respond(u, system, 5e-4, Stops(two, two))
    respond(u, system, 5e-4, Loop(0.5, 1.0, 0.5))
