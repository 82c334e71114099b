"""Compiles the loops of the simulation once, so that no process waits for it at start."""

from __future__ import annotations

import numpy as np

from sim.diagnosis.warm import warm as warm_diagnosis
from sim.effects import EFFECTS, Chain, simulate
from sim.stage.presets import PRESETS
from sim.stage.stage import Stage


def warm() -> None:
    """Run every effect and every preset over two samples, and the loops of the diagnosis."""
    u_V = np.zeros(2)
    for kind in EFFECTS.values():
        if kind.block is not None:
            simulate(Chain((kind(),)), u_V, 1e-3)
    for make in PRESETS.values():
        stage = Stage(make())
        stage.run(stage.initial_state(), u_V)
    warm_diagnosis()
