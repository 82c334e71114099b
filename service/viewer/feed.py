"""The records that the viewer stream is made of: arrays and JSON values, so that they travel between processes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray

IntArray = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True)
class Tracking:
    """n samples of the unit that ``model`` steers, in order of time.

    Attributes
    ----------
    model : name of the model whose voltages move this unit; it names the curves.
    seq : (n,) sequence numbers.
    t_s : (n,) time of the stage, s.
    u_V : (n,) voltage applied, V.
    y_um : (n,) displacement measured, µm.
    reference_um : (n,) displacement wanted, µm; NaN where nobody said.
    std_V : (n,) one standard deviation of the voltage, V; NaN where unknown; None for "nowhere known".
    """

    model: str
    seq: IntArray
    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    reference_um: FloatArray
    std_V: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.seq)
        for name in ("t_s", "u_V", "y_um", "reference_um", "std_V"):
            value = getattr(self, name)
            if value is not None and np.shape(value) != (n,):
                raise InputError(
                    f"{name}: got shape {np.shape(value)}, expected ({n},), one value for each sequence number"
                )


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """What the learner says of itself, some 20 times a second; every field may be missing (docs/viewer.md)."""

    t_s: float
    seq: int
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Status:
    """The service's status, about once a second."""

    t_s: float
    seq: int
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened. ``change`` marks a change of the stage: loops are drawn before and after it."""

    t_s: float
    seq: int
    text: str
    level: str = "INFO"
    change: bool = False


@dataclass(frozen=True, slots=True)
class Health:
    """The stream's own counts since its start, by name: received, malformed, dropped on the way."""

    t_s: float
    seq: int
    counts: Mapping[str, int]


Record = Tracking | Diagnostics | Status | Event | Health


@dataclass(frozen=True, slots=True)
class SceneConfig:
    """What is known before the first record.

    Attributes
    ----------
    title : what the recording is called, for example ``demo/x``.
    models : the models whose units are shown; the first is the one that the service serves and teaches.
    range_um : motion range that percentages refer to, µm; None takes the span of the reference so far.
    u_limits_V, y_limits_um : limits of the (u, y) plane; None lets them grow with the data.
    loop_s : how much of the past one loop shows, s.
    mae_s : over how long the absolute error is averaged, s.
    history_s : how much of the past the plots show, s; None for all of it.
    """

    title: str
    models: tuple[str, ...] = ("lssvm_adaptive",)
    range_um: float | None = None
    u_limits_V: tuple[float, float] | None = None
    y_limits_um: tuple[float, float] | None = None
    loop_s: float = 2.0
    mae_s: float = 0.5
    history_s: float | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.models or len(set(self.models)) != len(self.models):
            raise InputError(f"models: got {self.models!r}, expected at least one name and none of them twice")
        for name in ("range_um", "loop_s", "mae_s", "history_s"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name}: got {value!r}, expected a positive number")
        for name in ("u_limits_V", "y_limits_um"):
            value = getattr(self, name)
            if value is not None and not (np.all(np.isfinite(value)) and value[0] < value[1]):
                raise InputError(f"{name}: got {value!r}, expected (low, high) with low < high")


# --- An event of the wire as a line for the log of the viewer.


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


# --- What the JSON of a peer holds, as numbers that can be drawn and as text: it may hold anything.


def number(value: Any) -> float | None:
    """A finite number, or None for all else: JSON of a peer may hold anything."""
    if not isinstance(value, (int, float, np.integer, np.floating)):
        return None
    try:
        value = float(value)
    except OverflowError:  # JSON knows integers of any length.
        return None
    return value if math.isfinite(value) else None


def column(value: Any) -> FloatArray | None:
    """A list of numbers as (n,) doubles, or None for all else."""
    if not isinstance(value, (list, tuple, np.ndarray)) or not len(value):
        return None
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.ndim == 1 else None


def as_markdown(title: str, fields: Mapping[str, Any], depth: int = 2) -> str:
    """A status as a table, nested names joined by dots; long lists are cut."""
    rows: list[str] = []

    def walk(prefix: str, part: Mapping[str, Any], left: int) -> None:
        for name, value in part.items():
            if isinstance(value, Mapping) and left:
                walk(f"{prefix}{name}.", value, left - 1)
            else:
                shown = f"{value:.6g}" if isinstance(value, float) else str(value)
                rows.append(f"| {prefix}{name} | {shown[:80].replace('|', '/')} |")

    walk("", fields, depth)
    return "\n".join([f"**{title}**", "", "| what | value |", "|---|---|", *rows])
