"""One schema for a configuration file: a frozen dataclass is the default, the check and the documentation of a table.

A field's annotation gives the type, the docstring of its class the meaning (``name : text``), and
``Annotated[float, Setting(...)]`` unit and bounds. `build_settings`
reads a table by it, and `service.config.reference` writes the example file and the reference page from it. A key that
the schema does not have is an error. Errors name the field, what was got, what was expected, and what to do.
"""

from __future__ import annotations

import functools
import math
import re
import tomllib
import types
from collections.abc import Callable, Hashable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from dehyst.adaptive.errors import InputError
from dehyst.service.protocol.errors import FieldError

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What a field's type does not say.

    Attributes
    ----------
    unit : unit of the value, "" for none.
    low, high : bounds; ``above`` excludes the lower one. A bounded number must also be finite.
    check : ``check(field, value)`` returns the value or raises InputError; in a list, for each entry.
    example : value that the example file shows where the default is empty.
    shown : whether the example file sets the key instead of offering it in a comment.
    key : name in the file, where it differs from the field's name.
    inline : the fields of a nested dataclass are keys of this table; what their types do not say, by name.
    advice : what to do where the key is missing.
    """

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    check: Callable[[str, Any], Any] | None = None
    example: Any = None
    shown: bool = False
    key: str = ""
    inline: Mapping[str, Setting] | None = None
    advice: str = "give this key, it has no default"

    @property
    def bounded(self) -> bool:
        """Whether there is a bound on one side at least."""
        return not (self.low == -math.inf and self.high == math.inf)

    def holds(self, value: float) -> bool:
        """Whether a number lies within the bounds."""
        if not self.bounded:
            return True
        return (value > self.low if self.above else value >= self.low) and value <= self.high and math.isfinite(value)

    def range(self) -> str:
        """The bounds in words, with the unit; "" without bounds."""
        unit = f" {self.unit}" if self.unit else ""
        low = f"more than {self.low:.15g}" if self.above else f"{self.low:.15g}"
        if not self.bounded:
            return ""
        if self.high == math.inf:
            return f"{low}{unit}" if self.above else f"{low}{unit} or more"
        return f"{low}{', at most' if self.above else ' to'} {self.high:.15g}{unit}"


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a table: its name in the file, the dataclass field, the type, and what `Setting` adds."""

    name: str
    field: str
    type: Any
    setting: Setting
    default: Any

    @property
    def required(self) -> bool:
        """Whether the file must have it."""
        return self.default is MISSING


def keys_of(kind: type) -> tuple[Key, ...]:
    """The keys of the table that the dataclass ``kind`` describes, in the order of its fields."""
    return _keys_of(kind)


@functools.cache
def _keys_of(kind: Hashable) -> tuple[Key, ...]:
    hints = get_type_hints(kind, include_extras=True)
    keys = []
    for entry in fields(cast(Any, kind)):
        if not entry.init:
            continue
        hint, setting = hints[entry.name], Setting()
        if get_origin(hint) is Annotated:
            hint, setting = get_args(hint)
        default = entry.default_factory() if entry.default_factory is not MISSING else entry.default
        keys.append(Key(setting.key or entry.name, entry.name, hint, setting, default))
    return tuple(keys)


def inline_keys(key: Key) -> tuple[Key, ...]:
    """The keys in the file that one field stands for: its own, or those of an inline dataclass."""
    more = key.setting.inline
    if more is None:
        return (key,)
    return tuple(replace(inner, setting=more.get(inner.name, inner.setting)) for inner in keys_of(key.type))


def build_settings(kind: type[T], table: Mapping[str, Any], where: str, folder: Path | None = None) -> T:
    """``kind`` with the values of ``table`` over its defaults; a table in it sets a nested dataclass.

    ``where`` begins the field in every message; a colon at its end separates a file from a key ("serve.toml:").
    Relative paths are taken from ``folder``. Raises InputError naming the field.
    """
    known = [inner.name for key in keys_of(kind) for inner in inline_keys(key)]
    for name, value in table.items():
        if name not in known:
            raise FieldError(
                field_name(where, name), _text(value), f"one of the known keys: {', '.join(sorted(known))}"
            )
    values: dict[str, Any] = {}
    for key in keys_of(kind):
        field = field_name(where, key.name)
        if key.setting.inline is not None:
            inner = {entry.name: table[entry.name] for entry in inline_keys(key) if entry.name in table}
            values[key.field] = build_settings(key.type, inner, where, folder)
        elif key.name in table:
            values[key.field] = _value(key.type, table[key.name], field, key.setting, folder)
        elif key.required:
            raise FieldError(field, "nothing", _expected(key.type, key.setting), key.setting.advice)
    try:
        return kind(**values)
    except InputError as error:
        raise _placed(error, where) from error


def check_bounds(settings: Any) -> None:
    """Raise FieldError where a number of a dataclass of settings is outside its bounds: for its ``__post_init__``."""
    for key in keys_of(type(settings)):
        value = getattr(settings, key.field)
        if isinstance(value, int | float) and not key.setting.holds(value):
            raise FieldError(key.name, value, key.setting.range())


def field_name(where: str, key: str) -> str:
    """``key`` with what stands before it in a message."""
    return f"{where} {key}" if where.endswith(":") else f"{where}.{key}"


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text. Raises InputError naming the line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FieldError(where, f"no TOML ({error})", "a TOML file", "correct the line named") from error


def read_text(path: Path, advice: str = "") -> str:
    """The text of a configuration file. Raises InputError where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FieldError(str(path), str(error), "a readable TOML file", advice) from error


def _value(kind: Any, value: Any, field: str, setting: Setting, folder: Path | None) -> Any:
    """``value`` as a ``kind``. Raises InputError."""
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise FieldError(field, _text(value), "a table")
        return build_settings(cast(type[Any], kind), value, field, folder)
    if get_origin(kind) is tuple:
        return _tuple(get_args(kind), value, field, setting, folder)
    kinds = get_args(kind) if isinstance(kind, types.UnionType) or get_origin(kind) is Union else (kind,)
    table = next((one for one in kinds if is_dataclass(one)), None)
    if table is not None and isinstance(value, dict):
        return build_settings(cast(type[Any], table), value, field, folder)
    if Path in kinds and isinstance(value, str):
        return (folder or Path()) / value if value else _empty_path(kinds, field, setting)
    value = float(value) if float in kinds and isinstance(value, int) and not isinstance(value, bool) else value
    if not any(_fits(value, one) for one in kinds) or (isinstance(value, int | float) and not setting.holds(value)):
        raise FieldError(field, _text(value), _expected(kind, setting))
    return setting.check(field, value) if setting.check is not None else value


def _tuple(entries: tuple[Any, ...], value: Any, field: str, setting: Setting, folder: Path | None) -> Any:
    if not isinstance(value, list | tuple) or (entries[-1] is not Ellipsis and len(value) != len(entries)):
        raise FieldError(field, _text(value), _expected_list(entries))
    wanted = [entries[0]] * len(value) if entries[-1] is Ellipsis else list(entries)
    found = zip(wanted, value, strict=True)
    return tuple(_value(kind, each, f"{field}[{i}]", setting, folder) for i, (kind, each) in enumerate(found))


def _empty_path(kinds: tuple[Any, ...], field: str, setting: Setting) -> None:
    if type(None) not in kinds:
        raise FieldError(field, "nothing", "the name of a file", setting.advice)


def _fits(value: Any, kind: Any) -> bool:
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if kind is dict or get_origin(kind) is dict:
        return isinstance(value, dict)
    if isinstance(value, bool) or kind is bool:
        return kind is bool and isinstance(value, bool)
    return isinstance(value, kind) and value == value  # a float that is not a number is unequal to itself


_NAMES = {str: "a text", Path: "a text", float: "a number", bool: "true or false", int: "an integer", dict: "a table"}


def _expected(kind: Any, setting: Setting) -> str:
    """What a value must be, in words."""
    if is_dataclass(kind):
        return "a table"
    if get_origin(kind) is tuple:
        return _expected_list(get_args(kind))
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(repr(choice) for choice in get_args(kind))
    kinds = [one for one in (get_args(kind) or (kind,)) if one is not type(None)]
    kind = get_origin(kind) if get_origin(kind) is dict else kinds[0]
    if is_dataclass(kind):
        return "a table"
    if not setting.bounded:
        return _NAMES[kind]
    return f"{'an integer, ' if kind is int else ''}{setting.range()}"


def _expected_list(entries: tuple[Any, ...]) -> str:
    if is_dataclass(entries[0]):
        return "a list of tables"
    return "a list" if entries[-1] is Ellipsis else f"a list of {len(entries)} numbers"


_PARTS = re.compile(r"(?P<field>[\w, ]+): got (?P<got>.+), expected (?P<expected>.+)", re.DOTALL)


def _placed(error: InputError, where: str) -> FieldError:
    """The error of a dataclass' own checks, its field preceded by the table's place."""
    if isinstance(error, FieldError):
        return FieldError(field_name(where, error.field), error.got, error.expected)
    parts = _PARTS.fullmatch(str(error))
    if parts is None:
        return FieldError(where, str(error), "settings that fit together")
    return FieldError(field_name(where, parts["field"]), parts["got"], parts["expected"])


def _text(value: Any) -> str:
    return repr(value)[:80]
