"""A table of a TOML file, read strictly: a key that is not known is refused, not ignored."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.errors import FieldError


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
