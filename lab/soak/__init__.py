"""The soak: all processes of a service under faults from a seeded schedule, judged by invariants.

`run` runs a plan that `make_plan` draws, in real time. The names are loaded on first use: the
processes of a soak import this package and must start fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.lab.soak.fault_plan import FAULT_KINDS as FAULT_KINDS
    from dehyst.lab.soak.fault_plan import SoakPlan as SoakPlan
    from dehyst.lab.soak.fault_plan import make_plan as make_plan
    from dehyst.lab.soak.fault_plan import select_kinds as select_kinds
    from dehyst.lab.soak.session import run as run

__getattr__ = lazy_names(__name__)
