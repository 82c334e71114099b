"""Rehearsals on a simulator of your own stage: identify it, close the loop through the real axis, and let events
happen.

>>> from lab.rehearsal import factory_of, rehearse
>>> done = rehearse(factory_of(my_plant))
>>> done.runs[0].outcome.adaptive.settled_pct

See docs/rehearse.md.
"""

from lab.rehearsal.config import RehearsalConfig
from lab.rehearsal.disturbance import CLASSES, EVENT_KINDS, INTACT, SENSOR, STANDARD, Event, draw
from lab.rehearsal.outcome import ErrorFigures, HealthyOutcome, Outcome, Trouble
from lab.rehearsal.plant import (
    Change,
    Changeable,
    FunctionPlant,
    IdentifiedPlant,
    Plant,
    PlantFactory,
    factory_of,
    identify,
)
from lab.rehearsal.reference import Motion, RandomReference, Reference, ReferenceRequest
from lab.rehearsal.rehearsal import EventRun, Rehearsal, rehearse, run_event, run_healthy, standard_events
from lab.rehearsal.runs import LoopRecord

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
