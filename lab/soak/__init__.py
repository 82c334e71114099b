"""The soak: all processes of a service under faults from a seeded schedule, judged by invariants.

`lab.soak.session.run` runs a plan that `make_plan` draws, in real time or in one process (``fast``). Everything else is
imported from its own module: the processes of a soak start with this package and must start fast.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lab.soak.fault_plan import FAULT_KINDS, SoakPlan, make_plan, select_kinds

__all__ = ["FAULT_KINDS", "SoakPlan", "make_plan", "select_kinds"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from lab.soak import fault_plan

        return vars(fault_plan)[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
