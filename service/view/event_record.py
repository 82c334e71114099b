"""An event of the wire as a line for the log of the viewer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from service.view.feed import Event

#: Events that mark a change of the stage itself.
CHANGES = frozenset({"change", "stage_change", "stage_changed"})
_LEVELS = {"ERROR": "ERROR", "WARN": "WARN", "WARNING": "WARN", "INFO": "INFO", "DEBUG": "DEBUG"}
_FAILING = ("error", "fail")
_ALARMING = (
    "change",
    "drift",
    "drop",
    "full",
    "gap",
    "late",
    "lost",
    "malformed",
    "refus",
    "restart",
    "rolled",
    "stall",
)


def event_record(t_s: float, seq: int, fields: Mapping[str, Any]) -> Event:
    """An event of the wire as a line of text; ``event`` and ``detail`` where they are given, else all fields."""
    kind = str(fields.get("event", fields.get("kind", "")))
    detail = fields.get("detail", fields.get("message", fields.get("text")))
    if detail is None:
        detail = ", ".join(f"{k} {v}" for k, v in fields.items() if k not in ("event", "kind", "seq", "t_s", "level"))
    level = _LEVELS.get(str(fields.get("level", "")).upper())
    if level is None:
        level = "INFO"
        if any(word in kind.lower() for word in _ALARMING):
            level = "WARN"
        if any(word in kind.lower() for word in _FAILING):
            level = "ERROR"
    text = f"{kind}: {detail}" if kind and detail else kind or str(detail)
    return Event(t_s, seq, text, level, change=kind in CHANGES)
