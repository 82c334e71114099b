"""The statuses of all instances as a table for a terminal, in plain ANSI."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

#: (heading, width, what it shows). One line an instance.
Cell = Callable[[dict[str, Any]], str]
_CLEAR: Final = "\x1b[H\x1b[J"
_BOLD: Final = "\x1b[1m"
_RED: Final = "\x1b[31m"
_PLAIN: Final = "\x1b[0m"


def _get(status: dict[str, Any], *path: str) -> Any:
    value: Any = status
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _number(value: Any, form: str, scale: float = 1.0) -> str:
    return format(value * scale, form) if isinstance(value, int | float) and not isinstance(value, bool) else "-"


def _age(seconds: Any) -> str:
    if not isinstance(seconds, int | float):
        return "-"
    for unit, size in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.1f} s"


def _state(status: dict[str, Any]) -> str:
    """The state of the axis in a word: the first condition that holds."""
    if status.get("trouble"):
        return str(status["trouble"])
    if status.get("stale"):
        return "stale"
    if status.get("frozen"):
        return "frozen"
    if not status.get("learning"):
        return "not learning"
    return "unsure" if _get(status, "quality", "valid") == 0.0 else "ok"


def _gates(status: dict[str, Any]) -> str:
    """The two most frequent reasons for refused samples."""
    gates = _get(status, "samples", "gates") or {}
    refused = sorted(((n, name) for name, n in gates.items() if name != "learnt"), reverse=True)
    return " ".join(f"{name}:{n}" for n, name in refused[:2]) or "-"


COLUMNS: Final[tuple[tuple[str, int, Cell], ...]] = (
    ("stage/axis", 16, lambda s: f"{s.get('stage')}/{s.get('axis')}"),
    ("instance", 18, lambda s: str(s.get("instance"))),
    ("role", 8, lambda s: str(s.get("role", "primary"))),
    ("state", 16, _state),
    ("serves", 15, lambda s: str(s.get("served"))),
    ("err %", 7, lambda s: _number(_get(s, "quality", "recent_rms_error_pct"), ".3f")),
    ("trust", 5, lambda s: _number(s.get("trust"), ".2f")),
    ("sample", 10, lambda s: str(s.get("seq"))),
    ("age", 7, lambda s: _age(s.get("sample_age_s"))),
    ("learnt", 9, lambda s: str(_get(s, "samples", "learnt"))),
    ("lost", 6, lambda s: str((_get(s, "samples", "lost") or 0) + (_get(s, "samples", "dropped") or 0))),
    ("ckpt", 7, lambda s: _age(_get(s, "checkpoints", "age_s"))),
    ("queries", 9, lambda s: str(_get(s, "queries", "count"))),
    ("p50 us", 7, lambda s: _number(_get(s, "queries", "p50_us"), ".0f")),
    ("p99 us", 7, lambda s: _number(_get(s, "queries", "p99_us"), ".0f")),
    ("MB", 5, lambda s: _number((s.get("memory") or {}).get("resident_bytes"), ".0f", 1e-6)),
    ("refused", 8, lambda s: str(sum((s.get("refused") or {}).values())) if s.get("refused") else "-"),
    ("not learnt", 24, _gates),
)


def is_healthy(status: dict[str, Any]) -> bool:
    """Whether a status needs no attention of an operator."""
    return _state(status) in ("ok", "not learning") and not _get(status, "samples", "dropped")


def table(statuses: Sequence[dict[str, Any]], width: int = 0, colour: bool = False) -> str:
    """The table as text, with lines of at most ``width`` characters (0: no limit)."""
    lines = [" ".join(f"{name:<{size}}" for name, size, _ in COLUMNS).rstrip()]
    for status in statuses:
        cells = [f"{_safe(show(status))[:size]:<{size}}" for _, size, show in COLUMNS]
        lines.append(" ".join(cells).rstrip())
    if width:
        lines = [line[:width] for line in lines]
    if colour:
        healthy = [True, *(is_healthy(status) for status in statuses)]
        lines = [
            f"{_BOLD if i == 0 else '' if fine else _RED}{line}{_PLAIN}"
            for i, (line, fine) in enumerate(zip(lines, healthy, strict=True))
        ]
    if not statuses:
        lines.append("no instance replies")
    return "\n".join(lines)


def screen(statuses: Sequence[dict[str, Any]], endpoint: str, events: Sequence[str]) -> str:
    """A whole screen: clear, a line with time and endpoint, the table, the newest events."""
    try:
        size = os.get_terminal_size()
        width, height = size.columns, size.lines
    except OSError:
        width, height = 200, 50
    head = f"{time.strftime('%H:%M:%S')}  {endpoint}  {len(statuses)} instances  (Ctrl-C ends)"
    body = table(statuses, width, colour=True).split("\n")
    room = max(0, height - len(body) - 3)
    tail = [_safe(line)[:width] for line in list(events)[-room:]] if room else []
    return _CLEAR + "\n".join([_safe(head)[:width], *body[: height - 2], *tail])


def _safe(text: str) -> str:
    """``text`` without control characters: it comes from other processes and must not move the cursor."""
    return "".join(c if c.isprintable() else "?" for c in text)
