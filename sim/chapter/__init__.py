"""The chapter's experiments on a simulated stage: its tables and the data of its figures, as arrays without plots.

`experiments.experiments` records the `Experiments`; `characterise`, `identify_forward`, `run_control` and
`track_learning` repeat the studies on them. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.sim.chapter.control import run_control as run_control
    from dehyst.sim.chapter.control import track_learning as track_learning
    from dehyst.sim.chapter.experiments import Experiments as Experiments
    from dehyst.sim.chapter.experiments import Record as Record
    from dehyst.sim.chapter.experiments import Score as Score
    from dehyst.sim.chapter.experiments import characterise as characterise
    from dehyst.sim.chapter.modelling import identify_forward as identify_forward

__getattr__ = lazy_names(__name__)
