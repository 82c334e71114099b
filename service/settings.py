"""A frozen configuration, nested or not, from the plain tables of a file; unknown keys are refused by name."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, cast

from adaptive.errors import InputError
from service.errors import FieldError

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
