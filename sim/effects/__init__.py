"""The effects library: one file is one cause, and adding an effect is adding a file.

``KINDS`` holds every kind by name; ``effect("creep", gain_per_decade=0.012)`` makes one with values; ``a + b`` makes a
chain; `simulate` runs it over a recording's voltages. `docs/effects.md` walks through one.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import MappingProxyType

from adaptive.errors import InputError
from sim.effects.base import Block, Context, Effect, Kind, Parameter, Place, block
from sim.effects.chain import Chain, Plan, plan, simulate


def _find() -> dict[str, Kind]:
    """Every module of this package that holds a ``KIND``."""
    found: dict[str, Kind] = {}
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        kind = getattr(importlib.import_module(f"{__name__}.{module}"), "KIND", None)
        if isinstance(kind, Kind):
            found[kind.name] = kind
    return dict(sorted(found.items(), key=lambda item: item[1].place))


#: All effects by name, in the order of the chain.
KINDS = MappingProxyType(_find())
#: Those that are causes of the catalogue, which a diagnosis may name.
CAUSES = MappingProxyType({name: kind for name, kind in KINDS.items() if kind.cause})


def effect(name: str, *, label: str = "", **values: float) -> Effect:
    """The effect ``name`` with these parameter values, the others at their defaults.

    Raises InputError for a name or a parameter that does not exist, and for a value outside its physical range.
    """
    if name not in KINDS:
        raise InputError(f"effect: got {name!r}, expected one of: {', '.join(KINDS)}")
    return KINDS[name](label=label, **values)


__all__ = [
    "CAUSES",
    "KINDS",
    "Block",
    "Chain",
    "Context",
    "Effect",
    "Kind",
    "Parameter",
    "Place",
    "Plan",
    "block",
    "effect",
    "plan",
    "simulate",
]
