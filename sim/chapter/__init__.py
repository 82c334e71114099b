"""The chapter's experiments on a simulated stage: its tables and the data of its figures, as arrays without plots.

`experiments.experiments` records the `Experiments`; `characterise`, `identify_forward`, `run_control` and
`track_learning` repeat the studies on them. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from sim.chapter.control import run_control, track_learning
    from sim.chapter.experiments import Experiments, Record, Score, characterise
    from sim.chapter.modelling import identify_forward

_MODULES = {
    "Experiments": "experiments",
    "Record": "experiments",
    "Score": "experiments",
    "characterise": "experiments",
    "identify_forward": "modelling",
    "run_control": "control",
    "track_learning": "control",
}
__all__ = [
    "Experiments",
    "Record",
    "Score",
    "characterise",
    "identify_forward",
    "run_control",
    "track_learning",
]

__getattr__ = lazy_names(__name__, _MODULES)
