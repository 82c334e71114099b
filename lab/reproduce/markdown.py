"""Small pieces of Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column to the left, the others to the right."""
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def number(value: Any, digits: int = 3) -> str:
    """A number with that many decimals, a dash for none."""
    return "–" if value is None else f"{value:.{digits}f}"


def short(value: Any) -> str:
    """Four significant digits, a dash for none."""
    return "–" if value is None else f"{value + 0.0:.4g}"


def picture(pictures: dict[str, str], key: str, title: str) -> str:
    """An image line, or nothing where that picture was not drawn."""
    return f"![{title}]({pictures[key]})\n" if key in pictures else ""
