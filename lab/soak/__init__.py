"""The soak: all processes of a service under faults from a seeded schedule, judged by invariants.

`run` runs a plan that `make_plan` draws, in real time or in one process. The names are loaded on first use: the
processes of a soak import this package and must start fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from lab.soak.fault_plan import FAULT_KINDS, SoakPlan, make_plan, select_kinds
    from lab.soak.session import run

__all__ = ["FAULT_KINDS", "SoakPlan", "make_plan", "run", "select_kinds"]

_MODULES: Final = {
    "FAULT_KINDS": "fault_plan",
    "SoakPlan": "fault_plan",
    "make_plan": "fault_plan",
    "select_kinds": "fault_plan",
    "run": "session",
}

__getattr__ = lazy_names(__name__, _MODULES)
