"""What the schema of the configuration says, for people: the example file and the reference page.

``python -m dehyst.service.config.reference`` prints the page, which is ``docs/configuration.md``.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import MISSING, is_dataclass
from itertools import groupby
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin

from dehyst.baselines.competition.config import CompetitionConfig
from dehyst.service.background.settings import RetuningConfig, WatchConfig
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.config.schema import Key, inline_keys, keys_of
from dehyst.service.config.settings import AxisConfig, ServeConfig
from dehyst.service.fleet.settings import FleetSettings

_HEAD = """\
# Configuration of 'dehyst serve --config FILE'. Displacement in µm, voltage in V, time in s. Paths are relative to it.
"""
_WIDTH = 36
_TITLE = """\
# Configuration of `dehyst serve`

One TOML file. `dehyst serve --example` prints one with every key of the first two tables. A key that is not listed here
is an error. Paths are relative to the file; units are part of names. What the tables are for: [learner, competition,
re-tuning](learner.md), [correction, repetition](correction.md), [diagnosis](diagnosis.md), [fleet](fleet.md).

Generated from the schema: `python -m dehyst.service.config.reference > docs/configuration.md`.
"""


def example() -> str:
    """An example file: the keys without a default, and every other key with its default in a comment."""
    lines = [_HEAD, *_example_of(ServeConfig), "", "[[axis]]", *_example_of(AxisConfig), ""]
    described = _described(AxisConfig)
    tables = (key.name for key in _flat(AxisConfig) if _is_table(key))
    lines += [f"{f'# [axis.{name}]':<{_WIDTH}}# {described[name]}" for name in tables]
    return "\n".join(lines) + "\n"


def tables() -> tuple[tuple[str, type], ...]:
    """The tables of the file: title on the page, and schema."""
    from dehyst.adaptive.online.config import LearnerConfig  # imports scipy, which the example does not need

    return (
        ("The file", ServeConfig),
        ("`[[axis]]`: one table for each axis", AxisConfig),
        ("`[axis.learner]`, `[fleet.learner]`: the model that learns", LearnerConfig),
        ("`[axis.competition]`: comparison and exchange of models", CompetitionConfig),
        ("`[axis.retuning]`: background tuning of hyper-parameters", RetuningConfig),
        ("`[axis.correction]`: correction by fresh readings", CorrectionConfig),
        ("`[axis.repetition]`: correction of motion that repeats", RepetitionConfig),
        ("`[axis.diagnosis]`: background diagnosis", WatchConfig),
        ("`[fleet]`: many axes as one batch", FleetSettings),
    )


def page() -> str:
    """The reference page: a table of keys for each table of the file, in Markdown."""
    parts = [_TITLE]
    for title, kind in tables():
        parts += [f"## {title}\n", *_rows(kind, "")]
    return "\n".join(parts)


def _example_of(kind: type) -> list[str]:
    lines, described = [], _described(kind)
    for key in _flat(kind):
        if _is_table(key) or key.name in ("axis", "fleet"):
            continue
        shown = key.required or key.setting.shown
        left = f"{'' if shown else '# '}{key.name} = {_toml(key)}"
        unit = f", {key.setting.unit}" if key.setting.unit else ""
        lines.append(f"{left:<{_WIDTH - 1}} # {described[key.name]}{unit}")
    return lines


def _rows(kind: type, prefix: str) -> list[str]:
    """The rows of one table; nested tables follow with dotted names."""
    described = _described(kind)
    head = ["| key | default, range | meaning |", "|---|---|---|"] if not prefix else []
    rows, nested = list[tuple[str, ...]](), list[str]()
    for key in _flat(kind):
        if not _is_table(key):
            rows.append((f"`{prefix}{key.name}`", _values(key), described.get(key.name, "")))
        elif isinstance(key.type, type) and key.type not in dict(tables()).values():
            nested += _rows(key.type, f"{prefix}{key.name}.")
    return [*head, *_lines(rows), *nested, *([] if prefix else [""])]


def _lines(rows: list[tuple[str, ...]]) -> Iterator[str]:
    """The rows as lines; neighbours that are described together are one."""
    for _, group in groupby(rows, key=lambda row: row[-1] or row[0]):
        columns = list(zip(*group, strict=True))
        same = [column[:1] if len(set(column)) == 1 else column for column in columns]
        cells = [", ".join(cell or "none" for cell in column) if len(column) > 1 else column[0] for column in same]
        yield f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _flat(kind: type) -> list[Key]:
    return [inner for key in keys_of(kind) for inner in inline_keys(key)]


def _is_table(key: Key) -> bool:
    return is_dataclass(key.type) or get_origin(key.type) is dict


def _plain(value: Any) -> bool:
    """Whether a default can be written down: neither empty nor infinite."""
    return value not in (MISSING, None, "") and not (isinstance(value, float) and math.isinf(value))


def _toml(key: Key) -> str:
    value = key.default if _plain(key.default) else key.setting.example
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


def _values(key: Key) -> str:
    """The default and the range of a key; its type where no default shows it."""
    kind = get_args(key.type)[0] if isinstance(key.type, UnionType) else key.type
    names = {str: "text", Path: "path", float: "number", int: "integer", tuple: "list"}
    bounds = key.setting.range()
    if get_origin(kind) is Literal:
        bounds = " ".join(f"`{json.dumps(choice)}`" for choice in get_args(kind))
    if _plain(key.default):
        return f"`{_toml(key)}`{bounds and f'; {bounds}'}"
    return f"{'required; ' if key.required else ''}{bounds or names.get(get_origin(kind) or kind, 'table')}"


def _described(kind: type) -> dict[str, str]:
    """What the docstring of a dataclass says of its fields, as ``name : text`` or ``name, name : text``."""
    names = [inner.name for key in keys_of(kind) for inner in (key, *inline_keys(key))]
    text = " ".join((kind.__doc__ or "").split())
    one = "|".join(map(re.escape, names))
    marks = list(re.finditer(rf"(?<!\S)((?:{one})(?:, (?:{one}))*) : ", text))
    found: dict[str, str] = {}
    ends = [mark.start() for mark in marks[1:]] + [len(text)]
    for mark, end in zip(marks, ends, strict=False):
        meaning = text[mark.end() : end].partition(" Raises ")[0].strip().rstrip(".;")
        found |= dict.fromkeys(mark[1].split(", "), meaning)
    return found


if __name__ == "__main__":
    sys.stdout.write(page())
