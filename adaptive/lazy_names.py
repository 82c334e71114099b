"""Names that a package loads on first use, so that importing one of its modules does not load all of them."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module


def lazy_names(package: str) -> Callable[[str], object]:
    """The ``__getattr__`` of ``package``, which offers what it imports as ``X as X`` under ``TYPE_CHECKING``.

    So there is one list, and type checkers read the same one. It is read from the package's source at the first use of
    a name; ``__all__`` is made of it. The returned function raises AttributeError on other names.
    """

    @cache
    def offered() -> dict[str, str]:
        blocks = (part for part in ast.parse(inspect.getsource(sys.modules[package])).body if isinstance(part, ast.If))
        imports = (line for block in blocks for line in block.body if isinstance(line, ast.ImportFrom))
        return {name.asname: str(line.module) for line in imports for name in line.names if name.asname}

    def load(name: str) -> object:
        if name == "__all__":
            return sorted(offered())
        # Python asks every package for names of its own, such as __path__, and must not wait for the list.
        if name.startswith("__") or name not in offered():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value: object = getattr(import_module(offered()[name]), name)
        return value

    return load
