"""Tables of a report, in Markdown or aligned for a terminal, and numbers in JSON."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

Cells = Sequence[str]


def markdown(head: Cells, rows: Sequence[Cells], left: Collection[int] | None = None) -> str:
    """A Markdown table. ``left`` : the columns to the left, the others to the right; None: all to the left."""
    rule = "|".join("---" if left is None or i in left else "---:" for i in range(len(head)))
    return "\n".join([_line(head), f"|{rule}|", *map(_line, rows)])


def _line(cells: Cells) -> str:
    return f"| {' | '.join(cells)} |"


def aligned(head: Cells, rows: Sequence[Cells], left: Collection[int]) -> list[str]:
    """Lines of equal columns, a rule below the head; the columns ``left`` to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]

    def line(cells: Cells) -> str:
        pairs = enumerate(zip(cells, widths, strict=True))
        return "  ".join(cell.ljust(size) if i in left else cell.rjust(size) for i, (cell, size) in pairs).rstrip()

    first = line(head)
    return [first, "-" * len(first), *map(line, rows)]


def json_form(value: Any) -> Any:
    """JSON form: floats with seven digits, non-finite numbers as null, arrays and tuples as lists."""
    if isinstance(value, dict):
        return {str(key): json_form(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [json_form(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.7g}") if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value
