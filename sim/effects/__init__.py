"""Library of the effects that a simulated stage is composed of and that a diagnosis may name, one file each.

``effect("creep", gain_per_decade=0.012)`` makes an effect with parameter values, ``a + b`` makes a chain, and
``simulate`` runs it over voltages. ``EFFECTS`` holds all kinds by name, ``CAUSES`` those that a diagnosis may name. To
add one, define a `Kind` in a new file; see ``docs/effects.md``.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import MappingProxyType

from dehyst.adaptive.errors import InputError
from dehyst.sim.effects.base import Block, Cause, Chain, Context, Effect, Kind, Parameter, Place, block
from dehyst.sim.effects.simulation import Plan, plan, simulate


def _find() -> dict[str, Kind]:
    """Every kind that a module of this package defines."""
    modules = (importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__))
    kinds = {value.name: value for module in modules for value in vars(module).values() if isinstance(value, Kind)}
    return dict(sorted(kinds.items(), key=lambda item: (item[1].place, item[0])))


#: All kinds by name, in the order of the chain.
EFFECTS = MappingProxyType(_find())
#: The kinds that a diagnosis may name as a cause.
CAUSES = MappingProxyType({name: kind for name, kind in EFFECTS.items() if kind.cause})


def effect(name: str, *, label: str = "", **values: float) -> Effect:
    """The effect ``name`` with these parameter values; the others have their defaults.

    Raises InputError on an unknown effect or parameter, and on a value outside its physical range.
    """
    if name not in EFFECTS:
        raise InputError(f"effect: got {name!r}, expected one of: {', '.join(EFFECTS)}")
    return EFFECTS[name](label=label, **values)


__all__ = [
    "CAUSES",
    "EFFECTS",
    "Block",
    "Cause",
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
