"""Names that a package loads on first use, so that importing one of its modules does not load all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module


def lazy_names(package: str, modules: Mapping[str, str]) -> Callable[[str], object]:
    """The ``__getattr__`` of ``package``: ``modules`` gives the module that defines each name.

    A module is relative to the package; ``.other.module`` is beside it. The returned function raises AttributeError
    on other names.
    """

    def load(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value: object = getattr(import_module(f".{modules[name]}", package), name)
        return value

    return load
