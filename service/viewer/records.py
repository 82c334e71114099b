"""The records of the viewer stream: arrays and JSON values, so that they can pass between processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.config.schema import Setting, check_bounds

IntArray = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True)
class Tracking:
    """n samples of the unit that ``model`` drives, in order of time.

    Attributes
    ----------
    model : name of the model whose voltages drive this unit; it names the curves.
    seq : (n,) sequence numbers.
    t_s : (n,) time of the stage, s.
    u_V : (n,) voltage applied, V.
    y_um : (n,) displacement measured, µm.
    reference_um : (n,) reference, µm; NaN where unknown.
    std_V : (n,) one standard deviation of the voltage, V; NaN where unknown; None if it is unknown for all.

    Raises InputError if the shapes differ.
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
            shape = np.shape(getattr(self, name))
            if shape != (n,) and getattr(self, name) is not None:
                raise InputError(f"{name}: got shape {shape}, expected ({n},), one value for each sequence number")


@dataclass(frozen=True, slots=True)
class _Fields:
    t_s: float
    seq: int
    fields: Mapping[str, Any]


class Diagnostics(_Fields):
    """Diagnostics of the learner, about 20 times a second; every field may be missing (docs/viewer.md)."""


class Status(_Fields):
    """The service's status, about once a second."""


class Health(_Fields):
    """Counts of the stream itself since its start, by name: received, malformed, dropped."""


@dataclass(frozen=True, slots=True)
class Event:
    """An event. ``change`` marks a change of the stage: loops are drawn before and after it."""

    t_s: float
    seq: int
    text: str
    level: str = "INFO"
    change: bool = False


_POSITIVE = Setting(low=0, above=True)
Record = Tracking | Diagnostics | Status | Event | Health


@dataclass(frozen=True, slots=True)
class SceneConfig:
    """What is known before the first record.

    Attributes
    ----------
    title : name of the recording, for example ``demo/x``.
    models : the models whose units are shown; the first is the one that the service serves and that learns.
    range_um : motion range that percentages refer to, µm; None: the span of the reference so far.
    loop_s : length of the past that one loop shows, s.
    mae_s : time over which the absolute error is averaged, s.
    history_s : length of the past that the plots show, s; None: all of it.
    """

    title: str
    models: tuple[str, ...] = ("lssvm_adaptive",)
    range_um: Annotated[float | None, _POSITIVE] = None
    loop_s: Annotated[float, _POSITIVE] = 2.0
    mae_s: Annotated[float, _POSITIVE] = 0.5
    history_s: Annotated[float | None, _POSITIVE] = None

    def __post_init__(self) -> None:
        if not self.models or len(set(self.models)) != len(self.models):
            raise InputError(f"models: got {self.models!r}, expected at least one name and none of them twice")
        check_bounds(self)


# --- Events of the protocol


#: Events that mark a change of the stage.
CHANGES = frozenset({"change", "stage_change", "stage_changed"})
_FAILING = ("error", "fail")
_ALARMING = (
    "change", "drift", "drop", "full", "gap", "late", "lost", "malformed", "refus", "restart", "rolled", "stall",
)  # fmt: skip


def event_record(t_s: float, seq: int, fields: Mapping[str, Any]) -> Event:
    """An event of the protocol as a line of text: its ``event`` and ``detail``. Its level follows from its name."""
    kind, detail = str(fields.get("event", "")), str(fields.get("detail", ""))
    level = "WARN" if any(word in kind for word in _ALARMING) else "INFO"
    if any(word in kind for word in _FAILING):
        level = "ERROR"
    return Event(t_s, seq, ": ".join(filter(None, (kind, detail))), level, change=kind in CHANGES)
