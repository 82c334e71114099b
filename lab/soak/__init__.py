"""The soak: all processes of a service under faults from a seeded schedule, judged by invariants.

`run` runs a plan that `make_plan` draws, in real time or in one process. The names are loaded on first use: the
processes of a soak import this package and must start fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from lab.soak.fault_plan import FAULT_KINDS, SoakPlan, make_plan, select_kinds
    from lab.soak.session import run

__all__ = ["FAULT_KINDS", "SoakPlan", "make_plan", "run", "select_kinds"]

_MODULES: Final = {
    "FAULT_KINDS": "lab.soak.fault_plan",
    "SoakPlan": "lab.soak.fault_plan",
    "make_plan": "lab.soak.fault_plan",
    "select_kinds": "lab.soak.fault_plan",
    "run": "lab.soak.session",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
