"""All that a soak has seen, by second and by fault: what the invariants are judged from and the pictures drawn of."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np

from adaptive.types import FloatArray
from lab.soak.faults.catalogue import KINDS
from lab.soak.verdict.track import Second

#: The mode of a run in one process, and of one in real time.
FAST: Final = "fast"
REAL_TIME: Final = "real_time"
#: Longest time that anything may take to be well again, s.
_LONGEST_S: Final = max(kind.recover_s for kind in KINDS.values())


@dataclass
class Happened:
    """A fault as it really was: from ``begin_s`` to ``end_s``, and when all was well again (NaN: not, or unknown)."""

    kind: str
    begin_s: float
    end_s: float = float("nan")
    recovered_s: float = float("nan")
    silent_s: float = 0.0
    #: Seconds from its end until all was well in which the machine was too busy to tell.
    busy_s: float = 0.0
    told: str = ""
    #: Until when somebody might have told of it.
    look_until_s: float = 0.0
    value: float = 0.0

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return math.isfinite(self.end_s)

    @property
    def window_s(self) -> tuple[float, float]:
        """From its beginning until everything has to be well again."""
        end = self.end_s if self.ended else self.begin_s
        return self.begin_s, end + KINDS[self.kind].recover_s


@dataclass
class Probe:
    """A second of the prober: round trips in µs, ages of the followed model in s, and what else it counted."""

    t_s: float
    service_us: Sequence[float]
    echo_us: Sequence[float]
    ages_s: Sequence[float]
    failed: int
    unsafe: int
    silent_s: float
    error: str = ""


def probe_of(told: dict[str, Any], t_s: float) -> Probe:
    """The prober's line as a probe at ``t_s``."""
    # Packed: a run may last for days.
    service_us, echo_us, ages_s = (array("f", told[name]) for name in ("service_us", "echo_us", "ages_s"))
    names = ("failed", "unsafe", "silent_s", "error")
    return Probe(t_s, service_us, echo_us, ages_s, **{name: told[name] for name in names})


@dataclass
class Ledger:
    """What happened in a run of ``duration_s`` seconds.

    Attributes
    ----------
    seconds, probes : of the stage's samples and of the prober. memory : by process, (t_s, kB, its number).
    cpu : by process, (t_s, seconds of processor time so far, its number).
    planned : faults of the plan.
    ended : processes that ended by themselves. unsafe_blocks : answers to the controller that broke a promise.
    bare : by second, (t_s, the most that a bare loop was late, s). others : by second, (t_s, share of all cores
    that other processes than the soak's had).
    counters : per service and second, what its status said: (t_s, instance, flat counters).
    """

    duration_s: float
    range_um: float
    step_limit_V: float
    mode: str
    faults: list[Happened] = field(default_factory=list)
    seconds: list[Second] = field(default_factory=list)
    probes: list[Probe] = field(default_factory=list)
    memory: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    cpu: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    counters: list[tuple[float, str, Mapping[str, float]]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    ended: list[tuple[float, str]] = field(default_factory=list)
    unsafe_blocks: int = 0
    planned: int = 0
    bare: list[tuple[float, float]] = field(default_factory=list)
    others: list[tuple[float, float]] = field(default_factory=list)

    def quiet(self, t_s: float) -> bool:
        """Whether no fault, and no recovery from one, is under way at ``t_s``.

        Faults are in order, and none begins before the one before it has ended.
        """
        at = bisect_right(self.faults, t_s + 1.0, key=lambda fault: fault.begin_s)
        for i in range(at - 1, -1, -1):
            if t_s <= self.faults[i].window_s[1]:
                return False
            if self.faults[i].begin_s + _LONGEST_S < t_s:
                return True
        return True

    def seconds_between(self, begin_s: float, end_s: float) -> list[Second]:
        """Those that begin from ``begin_s`` to ``end_s``."""
        first = bisect_left(self.seconds, begin_s, key=lambda second: second.t_s)
        return self.seconds[first : bisect_right(self.seconds, end_s, key=lambda second: second.t_s)]

    def probes_between(self, begin_s: float, end_s: float) -> list[Probe]:
        """Those that were told from ``begin_s`` to ``end_s``."""
        first = bisect_left(self.probes, begin_s, key=lambda probe: probe.t_s)
        return self.probes[first : bisect_right(self.probes, end_s, key=lambda probe: probe.t_s)]

    def events_between(self, begin_s: float, end_s: float) -> list[dict[str, Any]]:
        """Those that came from ``begin_s`` to ``end_s``."""
        first = bisect_left(self.events, begin_s, key=lambda event: event["t_s"])
        return self.events[first : bisect_right(self.events, end_s, key=lambda event: event["t_s"])]

    def counters_between(self, begin_s: float, end_s: float) -> list[tuple[float, str, Mapping[str, float]]]:
        """The counters from ``begin_s`` to ``end_s``. They come in order but for a second or two."""
        first = bisect_left(self.counters, begin_s - 5.0, key=lambda row: row[0])
        last = bisect_left(self.counters, end_s + 5.0, key=lambda row: row[0])
        return [row for row in self.counters[first:last] if begin_s <= row[0] <= end_s]

    def latency_us(self, which: str) -> FloatArray:
        """Round trips outside the fault windows, µs: of the ``service`` or of the ``echo``."""
        found = [np.asarray(getattr(p, f"{which}_us")) for p in self.probes if self.quiet(p.t_s)]
        return np.concatenate(found) if found else np.zeros(0)


class Row(Mapping[str, float]):
    """Named numbers, packed: rows of the same names share them."""

    _shared: ClassVar[dict[tuple[str, ...], dict[str, int]]] = {}
    __slots__ = ("_at", "_values")

    def __init__(self, values: Mapping[str, float]) -> None:
        names = tuple(values)
        self._at = self._shared.setdefault(names, {name: i for i, name in enumerate(names)})
        self._values = array("d", values.values())

    def __getitem__(self, name: str) -> float:
        return self._values[self._at[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._at)

    def __len__(self) -> int:
        return len(self._at)


def flat(status: dict[str, Any]) -> dict[str, float]:
    """The numbers in a status under dotted names."""
    found: dict[str, float] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                walk(f"{prefix}.{name}" if prefix else str(name), inner)
        elif isinstance(value, (bool, int, float)):
            found[prefix] = float(value)

    for part in ("samples", "learner", "recorder", "queries", "seq", "checkpoints", "fallback", "memory"):
        walk(part, status.get(part))
    found["serves"] = float(status.get("role", "primary") == "primary")
    return found
