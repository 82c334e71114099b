"""Rehearsals on a simulator of your own stage: identify it, close the loop through the real axis, and let events
happen.

>>> from dehyst.lab.rehearsal import factory_of, rehearse
>>> done = rehearse(factory_of(my_plant))
>>> done.runs[0].outcome.adaptive.settled_pct

See docs/rehearse.md.
"""

from dehyst.lab.rehearsal.config import RehearsalConfig
from dehyst.lab.rehearsal.disturbance import CLASSES, EVENT_KINDS, SENSOR, STANDARD, Event, draw
from dehyst.lab.rehearsal.plant import Change, IdentifiedPlant, PlantFactory, factory_of, identify
from dehyst.lab.rehearsal.reference import Motion, RandomReference
from dehyst.lab.rehearsal.rehearsal import rehearse, run_event, standard_events

__all__ = [
    "CLASSES",
    "EVENT_KINDS",
    "SENSOR",
    "STANDARD",
    "Change",
    "Event",
    "IdentifiedPlant",
    "Motion",
    "PlantFactory",
    "RandomReference",
    "RehearsalConfig",
    "draw",
    "factory_of",
    "identify",
    "rehearse",
    "run_event",
    "standard_events",
]
