"""A frozen configuration, nested or not, from the plain tables of a file; unknown keys are refused by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from adaptive.errors import InputError
from service.protocol.errors import FieldError

T = TypeVar("T")


def build_settings(kind: type[T], settings: dict[str, Any], where: str) -> T:
    """``kind()`` with ``settings`` over its defaults; a table in ``settings`` sets the fields of a nested one.

    Raises InputError naming the key, and what ``kind`` itself has to say of its values.
    """
    defaults = kind()
    known = [entry.name for entry in fields(cast(Any, kind)) if entry.init]
    values: dict[str, Any] = {}
    for key, value in settings.items():
        if key not in known:
            raise FieldError(f"{where}.{key}", repr(value)[:80], f"one of the known keys: {', '.join(sorted(known))}")
        default = getattr(defaults, key)
        if is_dataclass(default):
            if not isinstance(value, dict):
                raise FieldError(f"{where}.{key}", repr(value)[:80], "a table")
            values[key] = build_settings(type(default), value, f"{where}.{key}")
        else:
            values[key] = _like(default, value, f"{where}.{key}")
    try:
        return kind(**values)
    except InputError as error:
        raise FieldError(where, str(error), "settings that fit together") from error


def _like(default: Any, value: Any, where: str) -> Any:
    """``value`` as the kind of thing that ``default`` is; None says nothing of what is expected."""
    if isinstance(default, bool) or isinstance(value, bool):
        fits = default is None or (isinstance(default, bool) and isinstance(value, bool))
    elif isinstance(default, float):
        fits, value = isinstance(value, int | float), float(value) if isinstance(value, int) else value
    elif isinstance(default, tuple):
        fits, value = isinstance(value, list | tuple), tuple(value) if isinstance(value, list) else value
    else:
        fits = default is None or isinstance(value, type(default))
    if not fits:
        raise FieldError(where, repr(value)[:80], f"a value like its default {default!r}")
    return value


# --- A table of a TOML file, read strictly: a key that is not known is refused, not ignored.


class Table:
    """A table of which every key must be taken; what is left at the end is not known."""

    def __init__(self, data: dict[str, Any], where: str) -> None:
        self._data = dict(data)
        self._known: list[str] = []
        self._where = where

    def take(
        self,
        key: str,
        kind: type,
        default: Any = None,
        valid: Callable[[Any], bool] = lambda _: True,
        expected: str = "",
    ) -> Any:
        self._known.append(key)
        names = {
            str: "a text",
            float: "a number",
            bool: "true or false",
            list: "a list",
            dict: "a table",
            int: "an integer",
        }
        expected = expected or names[kind]
        if key not in self._data:
            if default is None:
                raise FieldError(f"{self._where}: {key}", "nothing", expected, "this key must be given")
            return default
        value = self._data.pop(key)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)) or not valid(value):
            raise FieldError(f"{self._where}: {key}", repr(value), expected)
        if isinstance(value, float) and math.isnan(value):
            raise FieldError(f"{self._where}: {key}", "nan", expected)
        return value

    def within(self, key: str, default: int, least: int, most: int) -> int:
        return int(self.take(key, int, default, lambda v: least <= v <= most, f"an integer from {least} to {most}"))

    def path(self, key: str, folder: Path) -> Path | None:
        value = self.take(key, str, "")
        return folder / value if value else None

    def done(self) -> None:
        for key, value in self._data.items():
            raise FieldError(
                f"{self._where}: {key}", repr(value)[:80], f"one of the known keys: {', '.join(sorted(self._known))}"
            )
