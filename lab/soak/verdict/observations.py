"""What a soak observes: samples and voltages by second, queries by second, faults, and when the service recovered.

Seconds are kept, not samples, so that a run of days fits into memory. The stage limits the voltages that it receives,
so both the voltages sent and those applied are checked.
"""

from __future__ import annotations

import json
import math
import threading
import time
from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise
from typing import Any, ClassVar, Final, Literal

import numpy as np
import zenoh
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.online.sensor_trust import SENSOR_FAULTS
from adaptive.types import FloatArray
from lab.soak.controller import AXIS, STAGE, STRAY, ControlTask
from lab.soak.fault_plan import FAULT_KINDS
from lab.soak.machine_load import MachineLoad
from service.answers.which_model import SAMPLES_POISONED, SENSOR_FROZEN
from service.operating.remote import statuses
from service.protocol import samples as wire
from service.protocol.keys import Keys
from service.runtime.session import SURELY, open_client
from service.stage_node.faults import sound_key
from service.stage_node.node import status_key

# --- Samples and voltages


class Intervals:
    """A set of integers, as disjoint intervals: memory grows with the number of gaps only."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._stops: list[int] = []

    def __len__(self) -> int:
        return sum(stop - start for start, stop in zip(self._starts, self._stops, strict=True))

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The intervals in order, as (first, one past the last)."""
        return list(zip(self._starts, self._stops, strict=True))

    def add(self, start: int, stop: int) -> None:
        """Add the numbers from ``start`` to ``stop`` - 1."""
        if stop <= start:
            return
        i = bisect_right(self._starts, start)
        # Join all intervals that touch the new one.
        first = i - 1 if i and self._stops[i - 1] >= start else i
        last = first
        while last < len(self._starts) and self._starts[last] <= stop:
            start, stop = min(start, self._starts[last]), max(stop, self._stops[last])
            last += 1
        self._starts[first:last] = [start]
        self._stops[first:last] = [stop]

    def add_all(self, numbers: NDArray[np.int64]) -> None:
        """Add numbers in any order."""
        if not numbers.size:
            return
        if numbers[-1] - numbers[0] + 1 == numbers.size and (np.diff(numbers) == 1).all():
            self.add(int(numbers[0]), int(numbers[-1]) + 1)
            return
        distinct = np.unique(numbers)
        breaks = np.flatnonzero(np.diff(distinct) != 1)
        for start, stop in zip(np.r_[0, breaks + 1], np.r_[breaks, distinct.size - 1], strict=True):
            self.add(int(distinct[start]), int(distinct[stop]) + 1)

    def minus(self, other: Intervals) -> list[tuple[int, int]]:
        """The numbers in this set and not in ``other``, as intervals (first, one past the last)."""
        missing = []
        for start, stop in self.spans:
            at = start
            for other_start, other_stop in other.spans:
                if other_stop <= at or other_start >= stop:
                    continue
                if other_start > at:
                    missing.append((at, other_start))
                at = max(at, other_stop)
            if at < stop:
                missing.append((at, stop))
        return missing


#: Number of samples for which the reference and the voltages sent are kept.
_RING = 16_384
#: Sample numbers further apart than this belong to different starts of the stage.
RESTART_GAP = 10_000_000
#: A step that equals the slew limit up to round-off is allowed.
ROUND_OFF = 1.0 + 1e-6
#: Blocks that wait for their first sample, at most.
_MAX_WAITING = 64


@dataclass(slots=True)
class SampleSecond:
    """One second of samples: counts, the sum and maximum of |error| in µm, and the worst voltages.

    ``held`` samples had no command in time: the stage held the last voltage. ``step_max_V``, ``beyond_V`` and
    ``not_finite`` are of the voltages that the stage applied; ``sent_``... of those that it was sent. ``resumed_V`` is
    the step at the beginning of a block whose predecessor was not seen.
    """

    t_s: float
    seq: int = 0
    samples: int = 0
    judged: int = 0
    error_sum_um: float = 0.0
    error_max_um: float = 0.0
    step_max_V: float = 0.0
    beyond_V: float = 0.0
    held: int = 0
    not_finite: int = 0
    sent_step_V: float = 0.0
    sent_beyond_V: float = 0.0
    sent_not_finite: int = 0
    resumed_V: float = 0.0

    @property
    def mae_um(self) -> float:
        """Mean |error|, µm; NaN if no sample could be compared with its reference."""
        return self.error_sum_um / self.judged if self.judged else math.nan


#: Length of the parts in which the error is kept, s, and how many are kept: a few minutes.
PART_S: Final = 0.25
_MOST_PARTS: Final = 1200
#: A reference moves if it changes by more than this share of its range per second.
MOVES_PER_S: Final = 0.02


@dataclass(slots=True)
class ErrorPart:
    """The error of a short time: when it began, the sums of |error| and of the way wanted from the low end, µm, over so
    many samples, and held voltages."""

    t_s: float
    sum_um: float = 0.0
    way_um: float = 0.0
    judged: int = 0
    held: int = 0


@dataclass
class SampleTracker:
    """Collects references, commands and samples in the order of their arrival, second by second.

    ``clock`` returns the time of the run, s.
    """

    control: ControlTask
    clock: Callable[[], float]
    seconds: list[SampleSecond] = field(default_factory=list)
    seen: Intervals = field(default_factory=Intervals)

    def __post_init__(self) -> None:
        self._wanted = np.full(_RING, np.nan)
        self._wanted_seq = np.full(_RING, -1, dtype=np.int64)
        self._commanded_V = np.full(_RING, np.nan)
        self._commanded_seq = np.full(_RING, -1, dtype=np.int64)
        self._u_V, self._seq = math.nan, -2
        #: The voltage sent for the last sample so far, and the number of that sample.
        self._sent_V, self._sent_seq = math.nan, -2
        #: By first sample: a block that begins too far from the last voltage sent, its first voltage and that step, V.
        self._resumed: dict[int, tuple[float, float]] = {}
        self.newest = -1
        self.received = 0
        self.repeated = 0
        #: |error| of the last minutes in parts of `PART_S`.
        self.parts: deque[ErrorPart] = deque(maxlen=_MOST_PARTS)

    def want(self, first: int, y_um: FloatArray) -> None:
        """Add the reference from sample ``first`` on, µm."""
        numbers = np.arange(first, first + y_um.size)
        self._wanted[numbers % _RING] = y_um
        self._wanted_seq[numbers % _RING] = numbers

    def command(self, first: int, u_V: FloatArray) -> None:
        """Add voltages sent for the samples from ``first`` on, V, as they were sent, before any limit of the stage.

        The first one is compared with what was last sent for the sample before it, also if a block replaces another.
        """
        second = self._second()
        finite = np.isfinite(u_V)
        second.sent_not_finite += int(np.count_nonzero(~finite))
        if finite.any():
            second.sent_beyond_V = max(second.sent_beyond_V, self._beyond_V(u_V[finite]))
        slot = (first - 1) % _RING
        before_V = float(self._commanded_V[slot]) if self._commanded_seq[slot] == first - 1 else math.nan
        with np.errstate(invalid="ignore"):
            steps = np.abs(np.diff(u_V, prepend=before_V))
        known = steps[np.isfinite(steps)]
        if known.size:
            second.sent_step_V = max(second.sent_step_V, float(known.max()))
        if math.isnan(before_V) and finite[0]:
            self._resume(first, float(u_V[0]))
        numbers = np.arange(first, first + u_V.size)
        self._commanded_V[numbers % _RING] = u_V
        self._commanded_seq[numbers % _RING] = numbers
        if not 0 < self._sent_seq - int(numbers[-1]) < RESTART_GAP:
            self._sent_V, self._sent_seq = float(u_V[-1]), int(numbers[-1])

    def refuse_command(self) -> None:
        """Count a command that could not be decoded."""
        self._second().sent_not_finite += 1

    def take(self, batch: wire.SampleBatch) -> None:
        """Add samples as they arrived."""
        second = self._second()
        self.received += len(batch)
        self.seen.add_all(batch.seq)
        second.samples += len(batch)
        if self.newest >= 0:
            batch = batch.where(batch.seq <= self.newest + STRAY)
            if not len(batch):
                return
        seq, u_V = batch.seq, batch.u_V
        fresh = seq > self.newest if abs(int(seq[0]) - self.newest) < RESTART_GAP else np.ones(len(batch), dtype=bool)
        self.repeated += len(batch) - int(np.count_nonzero(fresh))
        second.seq = int(seq[-1])
        second.held += self._held(seq, u_V)
        finite = np.isfinite(u_V)
        second.not_finite += int(np.count_nonzero(~finite))
        if finite.any():
            second.beyond_V = max(second.beyond_V, self._beyond_V(u_V[finite]))
        if fresh.all():
            # Steps only between consecutive samples; those in between were not seen.
            before = np.concatenate(([self._u_V], u_V[:-1]))
            follows = np.diff(seq, prepend=self._seq) == 1
            if follows.any():
                second.step_max_V = max(second.step_max_V, float(np.max(np.abs(u_V - before)[follows])))
            if self._resumed:
                self._judge_resumed(second, seq, np.where(follows, before, np.nan))
            self._u_V, self._seq = float(u_V[-1]), int(seq[-1])
            self.newest = int(seq[-1])

    def take_sound(self, batch: wire.SampleBatch) -> None:
        """Add samples as a sound sensor reads them: these show where the stage is, whatever the service gets."""
        second, seq = self._second(), batch.seq
        known = (self._wanted_seq[seq % _RING] == seq) & np.isfinite(batch.y_um)
        if not known.any():
            return
        error = np.abs(self._wanted[seq % _RING] - batch.y_um)[known]
        second.judged += error.size
        second.error_sum_um += float(error.sum())
        second.error_max_um = max(second.error_max_um, float(error.max()))
        now = self.clock()
        if not self.parts or now - self.parts[-1].t_s >= PART_S:
            self.parts.append(ErrorPart(now))
        part = self.parts[-1]
        part.judged += error.size
        part.sum_um += float(error.sum())
        part.way_um += float((self._wanted[seq % _RING] - self.control.low_um)[known].sum())
        part.held += self._held(seq, batch.u_V)

    def _held(self, seq: NDArray[np.int64], u_V: FloatArray) -> int:
        """How many of these samples had no command in time."""
        slots = seq % _RING
        return int(np.count_nonzero((self._commanded_seq[slots] != seq) | (self._commanded_V[slots] != u_V)))

    def moved_s(self, first: int, last: int) -> float:
        """How long the reference moved between two samples, s: by more than `MOVES_PER_S` of its range per second.

        NaN if it is no longer known.
        """
        seq = np.arange(first, last + 1)
        if not 0 < seq.size <= _RING or (self._wanted_seq[seq % _RING] != seq).mean() > 0.1:
            return math.nan
        steps = np.abs(np.diff(self._wanted[seq % _RING]))
        return self.control.dt_s * int(
            np.count_nonzero(steps > MOVES_PER_S * self.control.range_um * self.control.dt_s)
        )

    def worst_half_second_pct(self, begin_s: float, end_s: float, gain: float = 1.0) -> tuple[float, float]:
        """(largest mean |error| over half a second in that time, that of the frozen model), percent of the range.

        ``gain`` : of the stage over that when it was identified. The frozen model is off by its change times the way
        from where the stage rests, which is no shorter than that from the low end of the reference. Parts in which the
        stage had no voltage in time say nothing about the model. NaN if there are no others.
        """
        parts = [part for part in self.parts if begin_s <= part.t_s and part.t_s + PART_S <= end_s]
        worst = frozen = math.nan
        for one, other in pairwise(parts):
            judged = one.judged + other.judged
            if judged and not (one.held or other.held):
                share = 100.0 / judged / self.control.range_um
                worst = np.fmax(worst, share * (one.sum_um + other.sum_um))
                frozen = np.fmax(frozen, share * abs(gain - 1.0) * (one.way_um + other.way_um))
        return float(worst), float(frozen)

    def _second(self) -> SampleSecond:
        """The present second. A second without samples keeps the last sample number of the one before."""
        now = self.clock()
        if not self.seconds or now - self.seconds[-1].t_s >= 1.0:
            self.seconds.append(SampleSecond(math.floor(now), self.seconds[-1].seq if self.seconds else 0))
        return self.seconds[-1]

    def _beyond_V(self, u_V: FloatArray) -> float:
        return max(float(u_V.max()) - self.control.u_max_V, self.control.u_min_V - float(u_V.min()))

    def _resume(self, first: int, u_V: float) -> None:
        """Note a block whose predecessor was not seen: the controller gave one up, or it was lost.

        A stage without a command holds its last voltage, so the block must begin there. If it does not, the voltage
        that the stage applies until then decides. At the start of a stage neither is known, and nothing is judged.
        """
        control = self.control
        follows = 0 < first - self._sent_seq < RESTART_GAP and math.isfinite(self._sent_V)
        step_V = abs(u_V - self._sent_V) if follows else math.inf
        if step_V > control.slew_V_per_s * control.dt_s * ROUND_OFF:
            self._resumed[first] = u_V, step_V
            if len(self._resumed) > _MAX_WAITING:
                self._resumed.pop(next(iter(self._resumed)))

    def _judge_resumed(self, second: SampleSecond, seq: NDArray[np.int64], before_V: FloatArray) -> None:
        """Judge the blocks that begin within these samples. ``before_V``: voltage applied before each sample; NaN if
        unknown."""
        for first in [first for first in self._resumed if seq[0] <= first <= seq[-1] or first < seq[0] < first + _RING]:
            u_V, step_V = self._resumed.pop(first)
            at = np.flatnonzero((seq == first) & np.isfinite(before_V))
            if at.size:
                step_V = min(step_V, abs(u_V - float(before_V[at[0]])))
            if math.isfinite(step_V):
                second.resumed_V = max(second.resumed_V, step_V)


# --- All observations

#: Mode of a run: in one process, or in real time.
FAST: Final = "fast"
REAL_TIME: Final = "real_time"
#: What the prober queries in turns.
Target = Literal["service", "echo"]
#: Longest recovery time of all kinds, s.
_LONGEST_S: Final = max(kind.recover_s for kind in FAULT_KINDS.values())


@dataclass
class FaultRecord:
    """A fault as it happened: from ``begin_s`` to ``end_s``, and when all was well again (NaN: not, or unknown)."""

    kind: str
    begin_s: float
    end_s: float = float("nan")
    recovered_s: float = float("nan")
    silent_s: float = 0.0
    #: Seconds from its end to the recovery in which the machine was too busy.
    busy_s: float = 0.0
    reported_by: str = ""
    #: What may have reported it was looked for until then, s.
    look_until_s: float = 0.0
    value: float = 0.0
    #: Number of the stage's newest sample when it began.
    begin_seq: int = -1
    #: What had to hold in this fault and did not, in words; and what could not be judged.
    breaches: list[str] = field(default_factory=list)
    unjudged: list[str] = field(default_factory=list)
    #: Of a sensor fault: the largest error, percent of the range, and the motion until it had a name, s.
    error_pct: float = math.nan
    named_s: float = math.nan

    def end(self, now_s: float) -> None:
        """It ends now."""
        self.end_s = now_s

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return math.isfinite(self.end_s)

    @property
    def window_s(self) -> tuple[float, float]:
        """From its beginning until everything has to be well again."""
        end = self.end_s if self.ended else self.begin_s
        return self.begin_s, end + FAULT_KINDS[self.kind].recover_s


@dataclass
class QuerySecond:
    """One second of the prober: round trips in µs, ages of the followed model in s, and its counts."""

    t_s: float
    service_us: Sequence[float]
    echo_us: Sequence[float]
    ages_s: Sequence[float]
    failed: int
    unsafe: int
    silent_s: float
    error: str = ""

    def round_trips_us(self, which: Target) -> Sequence[float]:
        """Round trips to the service or to the echo, µs."""
        return self.service_us if which == "service" else self.echo_us


def query_second(line: dict[str, Any], t_s: float) -> QuerySecond:
    """The prober's JSON line as a second that ends at ``t_s``."""
    # Packed, since a run may last for days.
    service_us, echo_us, ages_s = (array("f", line[name]) for name in ("service_us", "echo_us", "ages_s"))
    names = ("failed", "unsafe", "silent_s", "error")
    return QuerySecond(t_s, service_us, echo_us, ages_s, **{name: line[name] for name in names})


@dataclass
class Observations:
    """What was observed in a run of ``duration_s`` seconds.

    Attributes
    ----------
    seconds, query_seconds : of the stage's samples, and of the prober.
    memory : by process, (t_s, kB, process id). cpu : by process, (t_s, processor time so far in s, process id).
    planned : number of faults in the plan.
    ended : processes that ended without a fault. unsafe_blocks : answers to the controller that broke a promise.
    loop_delays : by second, (t_s, largest delay of the bare loop in s). other_load : by second, (t_s, share of all
    cores that other processes had).
    counters : per service and second, from its status: (t_s, instance, counters).
    """

    duration_s: float
    range_um: float
    step_limit_V: float
    mode: str
    faults: list[FaultRecord] = field(default_factory=list)
    seconds: list[SampleSecond] = field(default_factory=list)
    query_seconds: list[QuerySecond] = field(default_factory=list)
    memory: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    cpu: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    counters: list[tuple[float, str, Mapping[str, float]]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    ended: list[tuple[float, str]] = field(default_factory=list)
    unsafe_blocks: int = 0
    planned: int = 0
    loop_delays: list[tuple[float, float]] = field(default_factory=list)
    other_load: list[tuple[float, float]] = field(default_factory=list)

    def follow(self, seconds: list[SampleSecond], events: list[dict[str, Any]] | None = None) -> None:
        """Take the seconds, and the events if given, from these lists, which another object continues to fill."""
        self.seconds = seconds
        self.events = self.events if events is None else events

    def end(self, duration_s: float, seconds: list[SampleSecond]) -> None:
        """The run is over. Its last second is not whole and is left out unless it is the only one."""
        self.duration_s, self.seconds = duration_s, seconds[:-1] or seconds

    def note_unsafe_blocks(self, count: int) -> None:
        """Take the controller's count so far; a controller that was started again counts from zero."""
        self.unsafe_blocks = max(self.unsafe_blocks, count)

    def quiet(self, t_s: float) -> bool:
        """Whether no fault and no recovery is under way at ``t_s``.

        Faults are in order, and none begins before the previous one has ended.
        """
        at = bisect_right(self.faults, t_s + 1.0, key=lambda fault: fault.begin_s)
        for i in range(at - 1, -1, -1):
            if t_s <= self.faults[i].window_s[1]:
                return False
            if self.faults[i].begin_s + _LONGEST_S < t_s:
                return True
        return True

    def seconds_between(self, begin_s: float, end_s: float) -> list[SampleSecond]:
        """The seconds that begin from ``begin_s`` to ``end_s``."""
        first = bisect_left(self.seconds, begin_s, key=lambda second: second.t_s)
        return self.seconds[first : bisect_right(self.seconds, end_s, key=lambda second: second.t_s)]

    def query_seconds_between(self, begin_s: float, end_s: float) -> list[QuerySecond]:
        """The seconds of the prober that end from ``begin_s`` to ``end_s``."""
        first = bisect_left(self.query_seconds, begin_s, key=lambda probe: probe.t_s)
        return self.query_seconds[first : bisect_right(self.query_seconds, end_s, key=lambda probe: probe.t_s)]

    def events_between(self, begin_s: float, end_s: float) -> list[dict[str, Any]]:
        """The events from ``begin_s`` to ``end_s``."""
        first = bisect_left(self.events, begin_s, key=lambda event: event["t_s"])
        return self.events[first : bisect_right(self.events, end_s, key=lambda event: event["t_s"])]

    def counters_between(self, begin_s: float, end_s: float) -> list[tuple[float, str, Mapping[str, float]]]:
        """The counters from ``begin_s`` to ``end_s``. They are in order, except for a second or two."""
        first = bisect_left(self.counters, begin_s - 5.0, key=lambda row: row[0])
        last = bisect_left(self.counters, end_s + 5.0, key=lambda row: row[0])
        return [row for row in self.counters[first:last] if begin_s <= row[0] <= end_s]

    def latency_us(self, which: Target) -> FloatArray:
        """Round trips outside the fault windows, µs: of the ``service`` or of the ``echo``."""
        found = [np.asarray(p.round_trips_us(which)) for p in self.query_seconds if self.quiet(p.t_s)]
        return np.concatenate(found) if found else np.zeros(0)


class Counters(Mapping[str, float]):
    """Named numbers, packed: rows with the same names share them."""

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


def flatten_status(status: dict[str, Any]) -> dict[str, float]:
    """The numbers in a status, under dotted names."""
    found: dict[str, float] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                walk(f"{prefix}.{name}" if prefix else str(name), inner)
        elif isinstance(value, (bool, int, float)):
            found[prefix] = float(value)

    for part in ("samples", "learner", "recorder", "queries", "seq", "checkpoints", "fallback", "memory", "peers"):
        walk(part, status.get(part))
    found["serves"] = float(status.get("role", "primary") == "primary")
    return found


# --- Recovery from faults

#: Mean |error| of a second that counts as recovered, in percent of the commanded range.
WELL_PCT: Final = 0.3

#: What reports a fault: counters of the status, of which one must grow (with a "+": all of them in one service),
#: ``event`` for any event, ``instance`` for another instance that answers. A kind that is missing here need not be
#: reported.
INDICATORS: Final[dict[str, tuple[str, ...]]] = {
    "kill_primary": ("instance", "event"),
    "stop_primary": ("instance", "event", "samples.lost"),
    "kill_standby": ("instance", "event"),
    "restart_stage": ("samples.restarts",),
    "restart_router": ("samples.lost", "event"),
    "disk_full": ("recorder.errors", "recorder.lost", "event"),
    "bad_queries": ("queries.errors+samples.malformed",),
    "gap": ("samples.lost",),
    "duplicate": ("samples.late",),
    "reorder": ("samples.late",),
    "nan": ("samples.gates.not_finite",),
    "spike": ("samples.gates.glitch", "samples.gates.outlier"),
    "freeze": ("samples.gates.glitch", "samples.gates.outlier", "samples.gates.unexcited", "learner.jumps", "event"),
    # A reading that stays at its limit looks like a stage at rest.
    "saturate": (
        "samples.gates.glitch",
        "samples.gates.outlier",
        "samples.gates.saturated",
        "learner.jumps",
        "samples.gates.unexcited",
        "event",
    ),
    **dict.fromkeys(("stuck_noisy", "sensor_gain", "sign", "other_stage"), ("trouble",)),
    "seq_jump": ("samples.gates.ahead",),
    "losses": ("samples.lost",),
    "forged_state": ("peers.states_refused",),
    "rogue_claim": ("peers.claims_refused",),
    "folder_removed": ("recorder.errors",),
    "freeze_restart": ("frozen event",),
    "stage_clock": ("samples.gates.timing", "samples.gates.out_of_order", "event"),
    "dwell": ("samples.gates.unexcited",),
}


def assess_recovery(observed: Observations, count: int | None = None) -> None:
    """Fill in for every fault, or the first ``count``: when all was well again, how long no query was answered, and
    what reported it."""
    mae = {round(s.t_s): 100.0 * s.mae_um / observed.range_um for s in observed.seconds if s.judged}
    machine = MachineLoad(observed.loop_delays, observed.other_load)
    begins = [fault.begin_s for fault in observed.faults[1:]]
    for fault, next_s in islice(zip(observed.faults, [*begins, math.inf], strict=False), count):
        end = fault.end_s if math.isfinite(fault.end_s) else fault.begin_s
        last = fault.window_s[1] + 2.0
        # On a busy machine everything takes longer: look at as many more seconds as it was busy.
        last += machine.busy_s(end, last)
        within = observed.query_seconds_between(fault.begin_s, last + 1.0)
        fault.silent_s = max((p.silent_s for p in within if p.t_s <= next_s), default=0.0)
        for p in within:
            second = round(math.floor(p.t_s))
            good = [mae.get(second + i, math.inf) <= WELL_PCT for i in (0, 1)]
            if p.t_s - 1.0 >= end and not p.failed and len(p.service_us) and all(good):
                fault.recovered_s = p.t_s - 1.0
                break
        fault.busy_s = machine.busy_s(end, min(fault.recovered_s, last) if math.isfinite(fault.recovered_s) else last)
        if observed.mode == "fast":
            for second in range(math.ceil(end), math.floor(last) + 1):
                if mae.get(second, math.inf) <= WELL_PCT:
                    fault.recovered_s = float(second)
                    break
        fault.reported_by, fault.look_until_s = _reported_by(observed, fault, last), last


def _reported_by(observed: Observations, fault: FaultRecord, end: float) -> str:
    """Which counter or event reported a fault until ``end``, s; "" for none, "-" if it need not be reported."""
    indicators = INDICATORS.get(fault.kind)
    if indicators is None:
        return "-"
    begin = fault.begin_s
    counters = observed.counters_between(begin - 30.0, end)
    for indicator in indicators:
        if indicator == "event":
            # Liveliness counts only for services that were killed.
            alive = ("came", "gone") if not FAULT_KINDS[fault.kind].ends_service else ()
            events = [e for e in observed.events_between(begin, end) if e.get("event") not in alive]
            if events:
                return f"event {events[0].get('event')}"
        elif indicator == "trouble":
            troubles = [e for e in observed.events_between(begin, end) if e.get("event") == "trouble"]
            if troubles:
                return f"trouble {str(troubles[0].get('detail')).split(':')[0].split(' ')[0]}"
        elif indicator == "frozen event":
            if any(e.get("event") == "frozen" for e in observed.events_between(begin, end)):
                return "event frozen"
        elif indicator == "instance":
            before = {name for t, name, _ in counters if begin - 5.0 <= t <= begin}
            new = {name for t, name, _ in counters if begin < t <= end} - before
            gone = before - {name for t, name, _ in counters if begin + 1.5 < t <= end}
            if new or gone:
                return "another instance"
        else:
            names = indicator.split("+")
            for who in {who for _, who, _ in counters}:
                if all(_grew([row for row in counters if row[1] == who], name, begin) for name in names):
                    return indicator
    return ""


def _grew(rows: list[tuple[float, str, Mapping[str, float]]], name: str, begin_s: float) -> bool:
    """Whether a counter of one service was higher after ``begin_s`` than its last value before."""
    was = [row.get(name, 0.0) for t_s, _, row in rows if t_s <= begin_s]
    now = [row.get(name, 0.0) for t_s, _, row in rows if t_s > begin_s]
    return bool(now) and max(now) > (was[-1] if was else 0.0)


def troubles_since(events: Sequence[Mapping[str, Any]], first: int) -> list[tuple[int, str]]:
    """(sample number, name) of the troubles in ``events`` from sample ``first`` on, oldest first."""
    found: list[tuple[int, str]] = []
    for event in reversed(events):
        if event.get("event") == "trouble":
            if int(event.get("seq", -1)) < first:
                break
            found.append((int(event["seq"]), str(event.get("detail")).split(":")[0].split(" ")[0]))
    return found[::-1]


#: A sensor fault must have its name after so much motion, s. The mean error over any half second must stay below this,
#: percent of the range, or this multiple of the worst of the frozen model.
NAMED_S: Final = 0.5
SENSOR_PCT: Final = 1.0
OF_FROZEN: Final = 1.5
#: Troubles that name a sensor or its samples.
_NAMES: Final = SENSOR_FAULTS | {SENSOR_FROZEN, SAMPLES_POISONED}


def stage_gain(faults: Sequence[FaultRecord], at_s: float) -> float:
    """Gain of the stage at ``at_s`` over that when it was identified, by the faults that changed it."""
    return 1.0 + next((f.value for f in reversed(faults) if f.kind == "gain" and f.begin_s < at_s), 0.0)


def judge_sensor_fault(
    fault: FaultRecord, track: SampleTracker, troubles: Sequence[tuple[int, str]], last_seq: int, gain: float = 1.0
) -> None:
    """Note in ``fault``, whose readings were wrong up to sample ``last_seq``, whether it was named in time and how
    large the error became. ``troubles``: (sample number, name) since it began. ``gain``: see `stage_gain`."""
    dt_s = track.control.dt_s
    moved_s = track.moved_s(fault.begin_seq, last_seq)
    named = next((seq for seq, name in troubles if name in _NAMES and seq <= last_seq), None)
    if named is not None:
        fault.named_s = track.moved_s(fault.begin_seq, named) if named > fault.begin_seq else 0.0
    if named is None and not moved_s >= NAMED_S:
        fault.unjudged.append(f"named in time: the reference moved for {moved_s:.2f} s only")
    elif named is None:
        fault.breaches.append(f"not named within {moved_s:.2f} s of motion")
    elif fault.named_s > NAMED_S + track.control.block * dt_s:
        fault.breaches.append(f"named after {fault.named_s:.2f} s of motion, allowed {NAMED_S:g} s")
    fault.error_pct, frozen_pct = track.worst_half_second_pct(fault.begin_s, fault.end_s, gain)
    allowed_pct = max(SENSOR_PCT, OF_FROZEN * frozen_pct)
    if math.isnan(fault.error_pct):
        fault.unjudged.append("error: no half second in which every voltage came in time")
    elif fault.error_pct > allowed_pct:
        fault.breaches.append(f"error {fault.error_pct:.2f} % of range over half a second, allowed {allowed_pct:.3g} %")


# --- Observes a soak from outside the service: samples, references, commands, events and statuses.

#: Events are kept up to this number, which lasts for months.
_MAX_EVENTS = 500_000


class Monitor:
    """Subscribes through the router, and asks all services for their status. Times are s from ``start_s``."""

    def __init__(self, endpoint: str, control: ControlTask, start_s: float) -> None:
        self.start_s = start_s
        self.track = SampleTracker(control, self.now)
        self.events: list[dict[str, Any]] = []
        #: By instance, when its newest status came, and the status.
        self.statuses: dict[str, tuple[float, dict[str, Any]]] = {}
        self.stage: dict[str, Any] = {}
        self.malformed = 0
        self._lock = threading.Lock()
        self._session = open_client(endpoint, 10.0)
        keys = Keys(STAGE, AXIS)
        self._subscribers = [
            self._session.declare_subscriber(key, self._guarded(take))
            for key, take in (
                (keys.sample, self._sample),
                (sound_key(STAGE, AXIS), self._sound),
                (keys.reference, self._reference),
                (keys.command, self._command),
                (keys.event, self._event),
                (keys.status, self._status),
                (f"{keys.base}/standby/*", self._status),
                (status_key(STAGE, AXIS), self._stage),
            )
        ]
        tokens = self._session.liveliness().declare_subscriber(f"{keys.base}/**", self._alive)
        self._subscribers.append(tokens)

    def _alive(self, sample: zenoh.Sample) -> None:
        """A liveliness token of this axis has appeared or gone."""
        event = "came" if sample.kind == zenoh.SampleKind.PUT else "gone"
        with self._lock:
            if len(self.events) < _MAX_EVENTS:
                self.events.append({"t_s": round(self.now(), 3), "event": event, "detail": str(sample.key_expr)})

    def begin(self) -> None:
        """Set the time to zero, and forget what was seen before."""
        with self._lock:
            self.start_s = time.monotonic()
            self.track.seconds.clear()
            self.events.clear()
            self.statuses.clear()

    def now(self) -> float:
        """Seconds since `begin`."""
        return time.monotonic() - self.start_s

    def _guarded(self, take: Callable[[bytes], None]) -> Callable[[zenoh.Sample], None]:
        def callback(sample: zenoh.Sample) -> None:
            try:
                with self._lock:
                    take(sample.payload.to_bytes())
            except (InputError, ValueError, KeyError):
                self.malformed += 1

        return callback

    def _sample(self, payload: bytes) -> None:
        self.track.take(wire.decode_samples(payload))

    def _sound(self, payload: bytes) -> None:
        self.track.take_sound(wire.decode_samples(payload))

    def _reference(self, payload: bytes) -> None:
        block = wire.decode_reference(payload)
        self.track.want(block.seq, block.values)

    def _command(self, payload: bytes) -> None:
        try:
            block = wire.decode_command(payload)
        except InputError:
            # Its receiver refuses it, but the controller has sent it.
            self.track.refuse_command()
            raise
        self.track.command(block.seq, block.values)

    def _event(self, payload: bytes) -> None:
        if len(self.events) < _MAX_EVENTS:
            self.events.append({"t_s": round(self.now(), 3), **json.loads(payload)})

    def _status(self, payload: bytes) -> None:
        status = json.loads(payload)
        self.statuses[str(status["instance"])] = (self.now(), status)

    def _stage(self, payload: bytes) -> None:
        self.stage = json.loads(payload)

    def ask(self) -> list[dict[str, Any]]:
        """The status of every service that answers now; the first is the one that answers queries."""
        found = statuses(self._session, STAGE, AXIS, 0.5)
        for status in found:
            with self._lock:
                self.statuses[str(status["instance"])] = (self.now(), status)
        return found

    def put(self, key: str, value: dict[str, Any]) -> None:
        """Publish JSON, for the stage or the controller."""
        self._session.put(key, json.dumps(value), congestion_control=SURELY)

    @property
    def session(self) -> zenoh.Session:
        """The session of the monitor, for queries."""
        return self._session

    def named(self, first: int) -> list[tuple[int, str]]:
        """(sample number, name) of the troubles that were reported from sample ``first`` on."""
        with self._lock:
            return troubles_since(self.events, first)

    def samples(self) -> dict[str, int]:
        """Number of distinct samples seen so far, and of samples received."""
        with self._lock:
            return {"seen": len(self.track.seen), "received_by_monitor": self.track.received}

    def latest(self) -> tuple[SampleSecond | None, int]:
        """The last complete second, and the newest sample number."""
        with self._lock:
            seconds = self.track.seconds
            return (seconds[-2] if len(seconds) > 1 else None), self.track.newest

    def close(self) -> None:
        """Unsubscribe and close the session."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
