"""Compiles the loops of the simulation once, so that no process waits for it at start."""

from __future__ import annotations

import numpy as np

from dehyst.sim.effects import EFFECTS, Chain, simulate
from dehyst.sim.effects.slew_limit import slew_ends
from dehyst.sim.effects.stick_slip import friction
from dehyst.sim.effects.timing import best_slip_move, date_slips, find_slips, resample
from dehyst.sim.fitting.dynamics import Dynamics, ForceLoop, ForceStops, respond
from dehyst.sim.fitting.hysteresis_loops import (
    asymmetric,
    bouc_wen_loop,
    bouc_wen_paced,
    filtered_rate,
    grown_plays,
    plays_nested,
)
from dehyst.sim.fitting.lags import lag_ends, slow_poles
from dehyst.sim.stage.presets import PRESETS
from dehyst.sim.stage.stage import Stage


def warm() -> None:
    """Run every effect and every preset over two samples, and the loops of the diagnosis."""
    u_V = np.zeros(2)
    for kind in EFFECTS.values():
        if kind.block is not None:
            simulate(Chain((kind(),)), u_V, 1e-3)
    for make in PRESETS.values():
        stage = Stage(make())
        stage.run(stage.initial_state(), u_V)
    _warm_diagnosis()


def _warm_diagnosis() -> None:
    """Call every compiled loop of the diagnosis once, on a short record."""
    u = np.linspace(0.0, 1.0, 8)
    two = np.array([0.1, 0.2])
    bouc_wen_loop(u, 1.0, 0.9, 0.9, 0.0)
    bouc_wen_paced(u, 1.0, 0.9, 0.9, 0.0, u, 0.1)
    filtered_rate(u, 0.5, 1.0)
    grown_plays(u, two, two, u, u)
    asymmetric(u, u, u, np.zeros(6), two, two, two, np.ones(3), 1.0)
    plays_nested(u, two, two)
    lag_ends(u, 0.5, True)
    slew_ends(u, 0.5, True)
    slow_poles(u, two)
    friction(u, 0.1, 0.5)
    resample(u, 0.0, 0.5)
    there = np.ones(u.size, dtype=np.bool_)
    find_slips(u, u, there)
    best_slip_move(date_slips(((4, 1),), u, u, there), u, u, there)
    system = Dynamics((2e-3,), ((300.0, 0.02),))
    respond(u, system, 5e-4)
    respond(u, system, 5e-4, ForceStops(two, two))
    respond(u, system, 5e-4, ForceLoop(0.5, 1.0, 0.5))
