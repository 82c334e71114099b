"""Anyone's stage, rehearsed: identify a simulator, close the loop over it through the real axis, let things happen.

>>> from lab.rehearsal import factory_of, rehearse
>>> done = rehearse(factory_of(my_plant))
>>> done.runs[0].outcome.adaptive.settled_pct

docs/rehearse.md is the page about it.
"""

from lab.rehearsal.config import RehearsalConfig
from lab.rehearsal.events import CLASSES, INTACT, KINDS, SENSOR, STANDARD, Event, draw
from lab.rehearsal.identification import Identified, identify
from lab.rehearsal.loop import Course
from lab.rehearsal.outcome import Figures, Outcome, Trouble
from lab.rehearsal.plant import Change, Changeable, FunctionPlant, Plant, PlantFactory, factory_of
from lab.rehearsal.reference import Motion, RandomReference, Reference, Wish
from lab.rehearsal.rehearsing import Rehearsal, Run, rehearse, run_event, standard_events

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
