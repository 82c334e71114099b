"""Seeded scenarios: what happens to a stage, to its sensor's readings, and to the reference it is to follow.

``scenario(kind, seed)`` gives one; ``KINDS`` names them all. A scenario is data: the same seed gives the same stage,
the same disturbance and the same reference to the last bit.
"""

from sim.scenarios.kinds import KINDS, scenario
from sim.scenarios.readings import Readings
from sim.scenarios.scenario import Scenario

__all__ = ["KINDS", "Readings", "Scenario", "scenario"]
