"""The catalogue: the effects that a diagnosis may name. All that the diagnosis knows of a cause comes from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from dehyst.adaptive.errors import InputError
from dehyst.sim.effects import CAUSES, Cause, Kind
from dehyst.sim.fitting.stage_model import CauseModel


@dataclass(frozen=True)
class Catalogue:
    """The kinds of effects that may be named, in the order of the chain.

    Raises InputError for a kind that does not say how a diagnosis finds it, and for a name that appears twice.
    """

    kinds: tuple[Kind, ...]
    #: How each is found, by name.
    causes: Mapping[str, Cause] = field(init=False, repr=False)
    #: Every form that is tried, with the name of its effect. Forms of one name are variants of one cause.
    forms: tuple[CauseModel, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        causes: dict[str, Cause] = {}
        for kind in self.kinds:
            if kind.cause is None or kind.name in causes:
                raise InputError(f"catalogue: got {kind!r}, expected each effect once, and only those with a cause")
            causes[kind.name] = kind.cause
        forms = tuple(replace(form, name=name) for name, cause in causes.items() for form in cause.forms)
        object.__setattr__(self, "causes", causes)
        object.__setattr__(self, "forms", forms)

    def with_kind(self, kind: Kind) -> Catalogue:
        """The catalogue with one effect more, at the end."""
        return Catalogue((*self.kinds, kind))

    def kind(self, name: str) -> Kind:
        """The effect ``name``. Raises KeyError where there is none."""
        return {kind.name: kind for kind in self.kinds}[name]

    def same_set(self, names: set[str]) -> set[str]:
        """The names, with those that one voltage and one sensor cannot tell from one of them."""
        pairs = [{name, other} for name, cause in self.causes.items() for other in cause.same_as]
        return names.union(*(pair for pair in pairs if pair & names))


#: What a diagnosis knows unless it is given another catalogue.
CATALOGUE = Catalogue(tuple(CAUSES.values()))
