"""The second witness of each cause: direct tests of its signature in the readings, which use no fit of the stage."""

from sim.diagnosis.witnesses.readings import Readings
from sim.diagnosis.witnesses.witness import Sight, witnesses

__all__ = ["Readings", "Sight", "witnesses"]
