"""Anyone's stage, rehearsed: identify a simulator, close the loop over it through the real axis, let things happen.

>>> from service.rehearsal import factory_of, rehearse
>>> done = rehearse(factory_of(my_plant))
>>> done.runs[0].outcome.adaptive.settled_pct

docs/rehearse.md is the page about it.
"""

from service.rehearsal.config import RehearsalConfig
from service.rehearsal.events import CLASSES, INTACT, KINDS, SENSOR, STANDARD, Event, draw
from service.rehearsal.identification import Identified, identify
from service.rehearsal.loop import Course
from service.rehearsal.outcome import Figures, Outcome, Trouble
from service.rehearsal.plant import Change, Changeable, FunctionPlant, Plant, PlantFactory, factory_of
from service.rehearsal.reference import Motion, RandomReference, Reference, Wish
from service.rehearsal.rehearsing import Rehearsal, Run, rehearse, run_event, standard_events

__all__ = [
    "CLASSES",
    "INTACT",
    "KINDS",
    "SENSOR",
    "STANDARD",
    "Change",
    "Changeable",
    "Course",
    "Event",
    "Figures",
    "FunctionPlant",
    "Identified",
    "Motion",
    "Outcome",
    "Plant",
    "PlantFactory",
    "RandomReference",
    "Reference",
    "Rehearsal",
    "RehearsalConfig",
    "Run",
    "Trouble",
    "Wish",
    "draw",
    "factory_of",
    "identify",
    "rehearse",
    "run_event",
    "standard_events",
]
