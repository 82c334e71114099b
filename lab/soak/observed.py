"""What a soak observes: samples and voltages by second, queries by second, statuses, events, and faults.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import numpy as np
import zenoh
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.lab.soak.controller import AXIS, STAGE, STRAY, ControlTask
from dehyst.lab.soak.fault_plan import FAULT_KINDS
from dehyst.service.operating.remote import statuses
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import SURELY, open_client
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.stage_node.faults import sound_key
from dehyst.service.stage_node.node import status_key

T = TypeVar("T")

# --- Samples and voltages


class Intervals:
    """A set of integers, as disjoint intervals: memory grows with the number of gaps only."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._stops: list[int] = []

    def __len__(self) -> int:
        return sum(stop - start for start, stop in self.spans)

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The intervals in order, as (first, one past the last)."""
        return list(zip(self._starts, self._stops, strict=True))

    def add(self, start: int, stop: int) -> None:
        """Add the numbers from ``start`` to ``stop`` - 1, and join all intervals that they touch."""
        if stop > start:
            first = bisect_left(self._stops, start)
            last = bisect_right(self._starts, stop)
            if first < last:
                start, stop = min(start, self._starts[first]), max(stop, self._stops[last - 1])
            self._starts[first:last], self._stops[first:last] = [start], [stop]

    def add_all(self, numbers: NDArray[np.int64]) -> None:
        """Add numbers in any order."""
        if numbers.size:
            distinct = np.unique(numbers)
            breaks = np.flatnonzero(np.diff(distinct) != 1)
            for start, stop in zip(np.r_[0, breaks + 1], np.r_[breaks, distinct.size - 1], strict=True):
                self.add(int(distinct[start]), int(distinct[stop]) + 1)

    def minus(self, other: Intervals) -> Intervals:
        """The numbers in this set and not in ``other``."""
        missing, theirs = Intervals(), other.spans
        for start, stop in self.spans:
            at = start
            for other_start, other_stop in theirs[bisect_right(other._stops, start) :]:
                if other_start >= stop:
                    break
                missing.add(at, other_start)
                at = max(at, other_stop)
            missing.add(at, stop)
        return missing


#: Number of samples for which the reference and the voltages sent are kept.
_RING = 16_384
#: Sample numbers further apart than this belong to different starts of the stage.
RESTART_GAP = 10_000_000
#: A step that equals the slew limit up to round-off is allowed.
ROUND_OFF = 1.0 + 1e-6
#: A reference moves if it changes by more than this share of its range per second.
MOVES_PER_S: Final = 0.02


@dataclass(slots=True)
class SampleSecond:
    """One second of samples: counts, the sum and maximum of |error| in µm, and the worst voltages, sent or applied.

    ``held`` samples had no command in time: the stage held the last voltage.
    """

    t_s: float
    seq: int = 0
    samples: int = 0
    judged: int = 0
    error_sum_um: float = 0.0
    error_max_um: float = 0.0
    step_V: float = 0.0
    beyond_V: float = 0.0
    held: int = 0
    not_finite: int = 0

    @property
    def mae_um(self) -> float:
        """Mean |error|, µm; NaN if no sample could be compared with its reference."""
        return self.error_sum_um / self.judged if self.judged else math.nan


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
        self._wanted, self._error_um, self._commanded_V = np.full((3, _RING), np.nan)
        self._wanted_seq, self._commanded_seq = np.full((2, _RING), -1, dtype=np.int64)
        #: The last voltage applied, with the number of its sample.
        self._applied_V, self._applied_seq = math.nan, -2
        self.newest = -1
        self.received = 0

    def want(self, first: int, y_um: FloatArray) -> None:
        """Add the reference from sample ``first`` on, µm."""
        numbers = np.arange(first, first + y_um.size)
        self._wanted[numbers % _RING] = y_um
        self._error_um[numbers % _RING] = np.nan
        self._wanted_seq[numbers % _RING] = numbers

    def command(self, first: int, u_V: FloatArray) -> None:
        """Add voltages sent for the samples from ``first`` on, V, as they were sent, before any limit of the stage.

        The first one is compared with what was last sent for the sample before it, also if a block replaces another.
        """
        second = self._second()
        self._check(second, u_V)
        slot = (first - 1) % _RING
        before_V = float(self._commanded_V[slot]) if self._commanded_seq[slot] == first - 1 else math.nan
        with np.errstate(invalid="ignore"):
            steps = np.abs(np.diff(u_V, prepend=before_V))
        second.step_V = max(second.step_V, float(np.max(steps, initial=0.0, where=np.isfinite(steps))))
        numbers = np.arange(first, first + u_V.size)
        self._commanded_V[numbers % _RING] = u_V
        self._commanded_seq[numbers % _RING] = numbers

    def refuse_command(self) -> None:
        """Count a command that could not be decoded."""
        self._second().not_finite += 1

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
        seq = batch.seq
        second.seq = int(seq[-1])
        if abs(int(seq[0]) - self.newest) >= RESTART_GAP or (seq > self.newest).all():
            self.newest = int(seq[-1])

    def take_sound(self, batch: wire.SampleBatch) -> None:
        """Add samples as they are, with what was applied and where the stage is, whatever the service gets."""
        second, seq, u_V = self._second(), batch.seq, batch.u_V
        second.held += int(np.count_nonzero(self._held(seq, u_V)))
        self._check(second, u_V)
        # Steps only between consecutive samples; those in between were not seen.
        steps = np.abs(np.diff(u_V, prepend=self._applied_V))[np.diff(seq, prepend=self._applied_seq) == 1]
        second.step_V = float(np.fmax(second.step_V, np.max(steps, initial=0.0)))
        self._applied_V, self._applied_seq = float(u_V[-1]), int(seq[-1])
        known = (self._wanted_seq[seq % _RING] == seq) & np.isfinite(batch.y_um)
        error = np.abs(self._wanted[seq % _RING] - batch.y_um)
        second.judged += int(np.count_nonzero(known))
        second.error_sum_um += float(error[known].sum())
        second.error_max_um = max(second.error_max_um, float(np.max(error[known], initial=0.0)))
        # Where the stage had no voltage in time, the error says nothing about the model.
        says = known & ~self._held(seq, batch.u_V)
        self._error_um[seq[says] % _RING] = error[says]

    def sensor_fault(self, first: int, last: int, gain: float) -> tuple[float, float, float]:
        """(how long the reference moved, s, largest mean |error| over half a second, that of the frozen model, both
        percent of the range) between two samples; NaN where it is not known.

        ``gain`` : of the stage over that when it was identified. The frozen model is off by its change times the way
        from where the stage rests, which is no shorter than that from the low end of the reference.
        """
        control, seq = self.control, np.arange(first, last + 1)
        half = round(0.5 / control.dt_s)
        if not half <= seq.size <= _RING or (self._wanted_seq[seq % _RING] != seq).mean() > 0.1:
            return self.moved_s(first, last), math.nan, math.nan
        way = abs(gain - 1.0) * (self._wanted[seq % _RING] - control.low_um)
        means = [sliding_window_view(x, half)[:: half // 2].mean(axis=1) for x in (self._error_um[seq % _RING], way)]
        says = np.isfinite(means[0])
        worst, frozen = (100.0 / control.range_um * np.max(x[says], initial=-np.inf) for x in means)
        return self.moved_s(first, last), *((float(worst), float(frozen)) if says.any() else (math.nan, math.nan))

    def moved_s(self, first: int, last: int) -> float:
        """How long the reference moved between two samples, s: by more than `MOVES_PER_S` of its range per second."""
        seq = np.arange(first, last + 1)
        if not 0 < seq.size <= _RING or (self._wanted_seq[seq % _RING] != seq).mean() > 0.1:
            return math.nan
        control = self.control
        moves = np.abs(np.diff(self._wanted[seq % _RING])) > MOVES_PER_S * control.range_um * control.dt_s
        return control.dt_s * int(np.count_nonzero(moves))

    def _held(self, seq: NDArray[np.int64], u_V: FloatArray) -> NDArray[np.bool_]:
        """(n,) which of these samples had no command in time."""
        slots = seq % _RING
        return np.asarray((self._commanded_seq[slots] != seq) | (self._commanded_V[slots] != u_V))

    def _second(self) -> SampleSecond:
        """The present second. A second without samples keeps the last sample number of the one before."""
        now = self.clock()
        if not self.seconds or now - self.seconds[-1].t_s >= 1.0:
            self.seconds.append(SampleSecond(math.floor(now), self.seconds[-1].seq if self.seconds else 0))
        return self.seconds[-1]

    def _check(self, second: SampleSecond, u_V: FloatArray) -> None:
        finite = u_V[np.isfinite(u_V)]
        second.not_finite += u_V.size - finite.size
        if finite.size:
            beyond_V = max(float(finite.max()) - self.control.u_max_V, self.control.u_min_V - float(finite.min()))
            second.beyond_V = max(second.beyond_V, beyond_V)


# --- Faults, queries, statuses


@dataclass
class FaultRecord:
    """A fault as it happened: from ``begin_s`` to ``end_s``, and when all was well again (NaN: not, or unknown)."""

    kind: str
    begin_s: float
    end_s: float = math.nan
    value: float = 0.0
    #: Number of the stage's newest sample when it began.
    begin_seq: int = -1
    recovered_s: float = math.nan
    silent_s: float = 0.0
    told: str = ""
    #: What had to hold in this fault and did not, in words; and what could not be judged.
    breaches: list[str] = field(default_factory=list)
    unjudged: list[str] = field(default_factory=list)
    #: Of a sensor fault: the largest error, percent of the range, and the motion until it had a name, s.
    error_pct: float = math.nan
    named_s: float = math.nan

    @property
    def window_s(self) -> tuple[float, float]:
        """From its beginning until everything has to be well again."""
        end = self.end_s if math.isfinite(self.end_s) else self.begin_s
        return self.begin_s, end + FAULT_KINDS[self.kind].recover_s


@dataclass
class QuerySecond:
    """One second of the prober, which ended at ``t_s``: round trips in µs, ages of the followed model in s, counts."""

    t_s: float
    trips_us: Sequence[float]
    ages_s: Sequence[float]
    failed: int
    unsafe: int
    silent_s: float

    @classmethod
    def of(cls, line: dict[str, Any], t_s: float) -> QuerySecond:
        """The prober's JSON line. The numbers are packed, since a run may last for days."""
        trips_us, ages_s = (array("f", line[name]) for name in ("trips_us", "ages_s"))
        return cls(t_s, trips_us, ages_s, line["failed"], line["unsafe"], line["silent_s"])


#: What reports a fault: counters of the status, of which one must grow, ``event`` for any event, ``trouble`` for any
#: trouble, ``instance`` for another instance that answers.
#: A kind that is missing here need not be reported.
INDICATORS: Final[dict[str, tuple[str, ...]]] = {
    "kill_primary": ("instance", "event"),
    "stop_primary": ("instance", "event", "samples.lost"),
    "kill_standby": ("instance", "event"),
    "restart_stage": ("samples.restarts",),
    "restart_router": ("samples.lost", "event"),
    "disk_full": ("recorder.errors", "recorder.lost", "event"),
    "gap": ("samples.lost",),
    "duplicate": ("samples.late",),
    "reorder": ("samples.late",),
    "nan": ("samples.gates.not_finite",),
    "spike": ("samples.gates.glitch", "samples.gates.outlier"),
    "freeze": ("samples.gates.glitch", "samples.gates.outlier", "samples.gates.unexcited", "learner.jumps", "event"),
    # A reading that stays at its limit looks like a stage at rest.
    "saturate": ("samples.gates.glitch", "samples.gates.outlier", "samples.gates.saturated", "learner.jumps",
                 "samples.gates.unexcited", "event"),
    **dict.fromkeys(
        ("stuck_noisy", "sensor_gain", "sign", "other_stage", "units", "exchanged", "u_sign"), ("trouble",)
    ),
    "seq_jump": ("samples.gates.ahead",),
    "losses": ("samples.lost",),
    "stage_clock": ("samples.gates.timing", "samples.gates.out_of_order", "event"),
}  # fmt: skip
#: Counters that add up to the numbers handled, with their signs.
NUMBERS: Final = {
    "samples.received": 1, "samples.thinned": -1, "samples.dropped": -1,
    "samples.late": -1, "samples.lost": 1, "samples.left_out": 1,
}  # fmt: skip
#: The numbers of a status that are kept.
_KEPT: Final = tuple(
    {name: 0 for told in INDICATORS.values() for name in told if "." in name}
    | NUMBERS
    | dict.fromkeys(("samples.restarts", "seq", "memory.malloc_bytes", "memory.python_blocks", "verdicts", "serves"))
)
_COLUMN: Final = {name: i for i, name in enumerate(_KEPT)}


@dataclass(frozen=True, slots=True)
class Counted:
    """The counters of one service at ``t_s``, packed, since a run may last for days."""

    t_s: float
    instance: str
    values: array[float]

    def __getitem__(self, name: str) -> float:
        return self.values[_COLUMN[name]]

    @classmethod
    def of(cls, t_s: float, instance: str, status: dict[str, Any]) -> Counted:
        """The counters in a status; what it does not have is 0."""

        def number(name: str) -> float:
            found: Any = status
            for part in name.split("."):
                found = found.get(part) if isinstance(found, dict) else None
            return float(found or 0.0)

        gates = (status.get("samples") or {}).get("gates", {})
        told = {"verdicts": float(sum(gates.values())), "serves": float(status.get("role", "primary") == "primary")}
        return cls(t_s, instance, array("d", [told[name] if name in told else number(name) for name in _KEPT]))


@dataclass
class Observations:
    """What was observed in a run of ``duration_s`` seconds.

    Attributes
    ----------
    planned : number of faults in the plan.
    seconds, probes : of the stage's samples, and of the prober. counters : per service and second.
    ended : (t_s, process) that ended without a fault. unsafe_blocks : answers to the controller that broke a promise.
    """

    range_um: float
    step_limit_V: float
    planned: int = 0
    duration_s: float = 0.0
    faults: list[FaultRecord] = field(default_factory=list)
    seconds: list[SampleSecond] = field(default_factory=list)
    probes: list[QuerySecond] = field(default_factory=list)
    counters: list[Counted] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    ended: list[tuple[float, str]] = field(default_factory=list)
    unsafe_blocks: int = 0

    def end(self, duration_s: float, seconds: list[SampleSecond]) -> None:
        """The run is over. Its last second is not whole and is left out unless it is the only one."""
        self.duration_s, self.seconds = duration_s, seconds[:-1] or seconds

    def calm(self) -> Callable[[float], bool]:
        """Returns whether no fault and no recovery is under way in the second that begins at a time, nor around it."""
        calm = np.ones(math.ceil(self.duration_s) + 120, dtype=bool)
        for fault in self.faults:
            begin, end = fault.window_s
            calm[max(0, math.floor(begin) - 1) : math.floor(end) + 1] = False
        return lambda t_s: bool(calm[max(0, math.floor(t_s))])


def between(rows: Sequence[T], begin_s: float, end_s: float) -> Sequence[T]:
    """The seconds, counters or events from ``begin_s`` to ``end_s``, of rows that are in order."""
    return rows[bisect_left(rows, begin_s, key=_time) : bisect_right(rows, end_s, key=_time)]


def _time(row: Any) -> float:
    return float(row["t_s"] if isinstance(row, dict) else row.t_s)


def troubles_since(events: Sequence[dict[str, Any]], first: int) -> list[tuple[int, str]]:
    """(sample number, name) of the troubles in ``events`` that stand at sample ``first`` or come later."""
    told = [event for event in events if event.get("event") in ("trouble", "recovered")]
    at = sum(int(event.get("seq", -1)) < first for event in told)
    return [(int(e["seq"]), _trouble(e)) for e in told[max(at - 1, 0) :] if e["event"] == "trouble"]


def _trouble(event: dict[str, Any]) -> str:
    return str(event.get("detail")).split(":")[0].split(" ")[0]


def told_by(observed: Observations, fault: FaultRecord, until_s: float) -> str:
    """Which counter or event reported a fault until ``until_s``; "" for none, "-" if it need not be reported."""
    begin = fault.begin_s
    rows, events = between(observed.counters, begin - 30.0, until_s), between(observed.events, begin, until_s)
    for indicator in INDICATORS.get(fault.kind, ("-",)):
        found = ""
        if indicator == "-":
            found = "-"
        elif indicator == "event":
            # Liveliness counts only for services that were killed.
            alive = () if FAULT_KINDS[fault.kind].ends_service else ("came", "gone")
            found = next((f"event {e['event']}" for e in events if e["event"] not in alive), "")
        elif indicator == "trouble":
            found = next((f"trouble {_trouble(e)}" for e in events if e["event"] == "trouble"), "")
        elif indicator == "instance":
            before = {row.instance for row in rows if begin - 5.0 <= row.t_s <= begin}
            new = {row.instance for row in rows if row.t_s > begin} - before
            gone = before - {row.instance for row in rows if row.t_s > begin + 1.5}
            found = "another instance" if new or gone else ""
        else:
            for instance in {row.instance for row in rows}:
                mine = [row for row in rows if row.instance == instance]
                if _grew(mine, indicator, begin):
                    found = indicator
        if found:
            return found
    return ""


def _grew(rows: Sequence[Counted], name: str, begin_s: float) -> bool:
    """Whether a counter of one service was higher after ``begin_s`` than its last value before."""
    was = [row[name] for row in rows if row.t_s <= begin_s]
    return max((row[name] for row in rows if row.t_s > begin_s), default=0.0) > (was[-1] if was else 0.0)


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
        self.session = open_client(endpoint, 10.0)
        keys, self._by = Keys(STAGE, AXIS), own_authenticator()
        #: Keys of which only signed messages count.
        self._signed = {keys.sample, keys.command, keys.status}
        self._subscribers = [
            self.session.declare_subscriber(key, self._guarded(take))
            for key, take in (
                (keys.sample, lambda payload: self.track.take(wire.decode_samples(payload))),
                (sound_key(STAGE, AXIS), lambda payload: self.track.take_sound(wire.decode_samples(payload))),
                (keys.reference, self._reference),
                (keys.command, self._command),
                (keys.event, lambda payload: self._event(json.loads(payload))),
                (keys.status, self._status),
                (f"{keys.base}/standby/*", self._status),
                (status_key(STAGE, AXIS), lambda payload: self.stage.update(json.loads(payload))),
            )
        ]
        alive = self.session.liveliness().declare_subscriber(f"{keys.base}/**", self._alive)
        self._subscribers.append(alive)

    def _alive(self, sample: zenoh.Sample) -> None:
        """A liveliness token of this axis has appeared or gone."""
        with self._lock:
            came = sample.kind == zenoh.SampleKind.PUT
            self._event({"event": "came" if came else "gone", "detail": str(sample.key_expr)})

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
            key = str(sample.key_expr)
            if key in self._signed and self._by.heard(sample, key) is None:
                return
            try:
                with self._lock:
                    take(sample.payload.to_bytes())
            except (InputError, ValueError, KeyError):
                self.malformed += 1

        return callback

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

    def _event(self, event: dict[str, Any]) -> None:
        if len(self.events) < _MAX_EVENTS:
            self.events.append({"t_s": round(self.now(), 3), **event})

    def _status(self, payload: bytes) -> None:
        status = json.loads(payload)
        self.statuses[str(status["instance"])] = (self.now(), status)

    def ask(self) -> list[dict[str, Any]]:
        """The status of every service that answers now; the first is the one that answers queries."""
        found = statuses(self.session, STAGE, AXIS, 0.5)
        with self._lock:
            self.statuses |= {str(status["instance"]): (self.now(), status) for status in found}
        return found

    def recent(self, age_s: float) -> list[dict[str, Any]]:
        """The statuses that came within the last ``age_s``."""
        return [status for t_s, status in list(self.statuses.values()) if self.now() - t_s < age_s]

    def put(self, key: str, value: dict[str, Any]) -> None:
        """Publish JSON, for the stage or the controller."""
        self.session.put(key, json.dumps(value), congestion_control=SURELY)

    def troubles(self, first: int) -> list[tuple[int, str]]:
        """(sample number, name) of the troubles that were reported from sample ``first`` on."""
        with self._lock:
            return troubles_since(self.events[-2000:], first)

    def close(self) -> None:
        """Unsubscribe and close the session."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self.session.close()  # type: ignore[no-untyped-call]
