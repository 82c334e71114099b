"""Rehearsals on a simulator of your own stage: identify it, close the loop through the real axis, and let events
happen.

>>> from dehyst.lab.rehearsal import factory_of, rehearse
>>> done = rehearse(factory_of(my_plant))
>>> done.runs[0].outcome.adaptive.settled_pct

See docs/rehearse.md.
"""

from dehyst.lab.rehearsal.config import RehearsalConfig
from dehyst.lab.rehearsal.disturbance import CLASSES, EVENT_KINDS, INTACT, SENSOR, STANDARD, Event, draw
from dehyst.lab.rehearsal.outcome import ErrorFigures, HealthyOutcome, Outcome, Trouble
from dehyst.lab.rehearsal.plant import (
    Change,
    Changeable,
    FunctionPlant,
    IdentifiedPlant,
    Plant,
    PlantFactory,
    factory_of,
    identify,
)
from dehyst.lab.rehearsal.reference import Motion, RandomReference, Reference, ReferenceRequest
from dehyst.lab.rehearsal.rehearsal import EventRun, Rehearsal, rehearse, run_event, run_healthy, standard_events
from dehyst.lab.rehearsal.runs import LoopRecord

__all__ = [
    "CLASSES",
    "EVENT_KINDS",
    "INTACT",
    "SENSOR",
    "STANDARD",
    "Change",
    "Changeable",
    "ErrorFigures",
    "Event",
    "EventRun",
    "FunctionPlant",
    "HealthyOutcome",
    "IdentifiedPlant",
    "LoopRecord",
    "Motion",
    "Outcome",
    "Plant",
    "PlantFactory",
    "RandomReference",
    "Reference",
    "ReferenceRequest",
    "Rehearsal",
    "RehearsalConfig",
    "Trouble",
    "draw",
    "factory_of",
    "identify",
    "rehearse",
    "run_event",
    "run_healthy",
    "standard_events",
]
