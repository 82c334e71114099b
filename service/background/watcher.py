"""Watches one axis: keeps its recent samples, detects a growing error of the model, and starts a process to explain it.

The thread that learns passes the samples and never waits: it copies them into a ring buffer, and reads the figures of
the learner four times per second. A process of the lowest priority does the rest, one diagnosis at a time.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray
from dehyst.service.background.job import BackgroundJob
from dehyst.service.background.settings import RECENT, WatchConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis

# --- The newest samples of one axis in a ring buffer of fixed size. One thread writes; any thread may copy.

#: Most samples that are kept, at any sample rate.
MOST_SAMPLES: Final = 200_000
#: Old samples in a row that mean a restarted count of the stage rather than late samples.
_RESTART_AFTER: Final = 200


class SampleBuffer:
    """The newest samples as rows (seq, t_s, u_V, y_um) of a (4, n) array; new samples overwrite the oldest."""

    def __init__(self, samples: int) -> None:
        self._rows = np.full((4, max(1, min(samples, MOST_SAMPLES))), np.nan)
        self._end = 0
        self._kept = 0
        self._last = -1
        self._old = 0
        self._lock = threading.Lock()

    @property
    def last_seq(self) -> int:
        """Number of the newest sample; -1 for none."""
        return self._last

    @property
    def size(self) -> int:
        """Number of samples kept."""
        return self._kept

    def add(self, batch: SampleBatch) -> bool:
        """Append the samples newer than all earlier ones. Returns False if the stage has restarted its count."""
        new = batch.seq > self._last
        # Skip duplicates and late samples; a long run of them means a restarted stage.
        self._old = 0 if new.any() else self._old + len(batch)
        restarted = self._old >= _RESTART_AFTER
        if restarted:
            self._end = self._kept = self._old = 0
            new[:] = True
        if new.any():
            block = np.stack([batch.seq, batch.t_s, batch.u_V, batch.y_um])[:, new][:, -self._rows.shape[1] :]
            n, room = block.shape[1], self._rows.shape[1]
            with self._lock:
                self._rows[:, (self._end + np.arange(n)) % room] = block
                self._end = (self._end + n) % room
                self._kept = min(room, self._kept + n)
                self._last = int(block[0, -1])
        return not restarted

    def copy(self, samples: int = MOST_SAMPLES) -> FloatArray:
        """The newest ``samples`` (all by default) as (4, n): seq, t_s, u_V, y_um; oldest first."""
        with self._lock:
            n = min(samples, self._kept)
            where = (self._end - n + np.arange(n)) % self._rows.shape[1]
            return np.asarray(self._rows[:, where])


# --- The alarm of the diagnosis: compares the figures of the learner with those of a reference period.


class Levels(NamedTuple):
    """Figures of a learner: gain of the stage, offset in V, recent rms error in % of the voltage span, validity."""

    gain: float
    offset_V: float
    error_pct: float
    valid: bool

    @staticmethod
    def of(diagnostics: Mapping[str, Any]) -> Levels | None:
        """From the diagnostics of a learner; None if they lack a figure or one is not finite."""
        try:
            gain, offset_V, error_pct = (
                float(diagnostics[key]) for key in ("gain", "offset_V", "recent_rms_error_pct")
            )
        except (KeyError, TypeError, ValueError):
            return None
        known = all(map(math.isfinite, (gain, offset_V, error_pct)))
        return Levels(gain, offset_V, error_pct, bool(diagnostics.get("valid", 1.0))) if known else None


class Alarm:
    """Raises an alarm when a figure has been out of bounds for ``hold_s``. The caller passes the time."""

    def __init__(self, config: WatchConfig, span_V: float) -> None:
        self._config = config
        self._span_V = max(abs(span_V), 1e-12)
        self._normal: Levels | None = None
        self._since_s = math.inf

    @property
    def armed(self) -> bool:
        """Whether it has reference levels."""
        return self._normal is not None

    def arm(self, levels: Levels | None) -> None:
        """Take ``levels`` as the reference; None disarms."""
        self._normal, self._since_s = levels, math.inf

    def check(self, t_s: float, now: Levels) -> str:
        """The reason for an alarm at ``t_s``; "" for no alarm."""
        why = "" if self._normal is None else self._out_of_bounds(now, self._normal)
        self._since_s = min(self._since_s, t_s) if why else math.inf
        return why if t_s - self._since_s >= self._config.hold_s else ""

    def _out_of_bounds(self, now: Levels, normal: Levels) -> str:
        c = self._config
        gain = now.gain / normal.gain - 1.0 if normal.gain else 0.0
        offset = (now.offset_V - normal.offset_V) / self._span_V
        if abs(gain) > c.gain_alarm:
            return f"the learner's gain moved by {100.0 * gain:+.1f} %"
        if abs(offset) > c.offset_alarm:
            return f"the learner's offset moved by {100.0 * offset:+.1f} % of the span"
        if now.error_pct > max(c.error_factor * normal.error_pct, c.error_floor_pct):
            return f"the learner's error grew from {normal.error_pct:.2g} to {now.error_pct:.2g} % of the span"
        return "the learner lost its validity" if normal.valid and not now.valid else ""


# --- The watch over an axis.

#: Interval at which the figures of the learner are read, s of samples.
_LOOK_S: Final = 0.25
#: Verdicts in the status, and the fields of all but the newest, which is complete.
_KEPT: Final = 10
_TOLD: Final = ("job", "seq", "why", "text")
#: Least motion in a reference, as a share of the range of the axis.
_LEAST_MOTION: Final = 0.05
#: Module of the process.
WORKER: Final = "dehyst.service.background.diagnosis_worker"
_ARGUMENTS: Final = ("recent_s", "report")


class Watcher:
    """The background diagnosis of one axis.

    ``take`` is called from the thread that learns, ``tick`` from the one that publishes, ``request`` and ``status``
    from any. Close it before the interpreter ends.
    """

    def __init__(self, axis: Axis, config: WatchConfig) -> None:
        self.config = config
        self._axis = axis
        self._dt_s = axis.dt_s
        self._buffer = SampleBuffer(self._samples(config.history_s))
        self._alarm = Alarm(config, _span_V(axis))
        self._reference: FloatArray | None = None
        #: Whether a new reference is due, as soon as there are enough samples after the last verdict.
        self._renew = True
        self._since_reference = 0
        self._next_look_s = 0.0
        self._alarm_seq: int | None = None
        self._alarm_why = ""
        #: The diagnosis of an alarm starts when this sample has arrived.
        self._due_seq = 0
        self._not_before_s = 0.0
        self._job: BackgroundJob | None = None
        self._lock = threading.Lock()
        self._counts = {"alarms": 0, "requests": 0, "started": 0, "finished": 0, "failed": 0, "waited": 0, "skipped": 0}
        self._last: dict[str, Any] | None = None
        self._history: list[dict[str, Any]] = []
        self._closed = False

    def take(self, batch: SampleBatch) -> None:
        """Keep the samples of a message and check for an alarm. Never blocks; call it from one thread."""
        if not len(batch):
            return
        if not self._buffer.add(batch):
            self._alarm_seq, self._since_reference, self._not_before_s = None, 0, 0.0
        self._since_reference += len(batch)
        t_s = self._buffer.last_seq * self._dt_s
        if not 0.0 <= self._next_look_s - t_s <= _LOOK_S:
            self._next_look_s = t_s + _LOOK_S
            self._look(t_s)

    def tick(self, now_s: float) -> None:
        """Start a diagnosis if one is due. Call it from the publishing thread, with a monotonic time."""
        seq = self._alarm_seq
        if seq is None or self._buffer.last_seq < self._due_seq or self._busy:
            return
        self._alarm_seq = None
        self._start("alarm", self._alarm_why, seq, now_s, "")

    def request(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Diagnose the recent samples now, in the background.

        ``arguments``: ``recent_s`` (s, by default that of the configuration), ``report`` (True: also write a full
        report into the folder ``reports`` of the configuration). Returns ``{"started": True, "job": N}``, or
        ``{"started": False, "why": reason}``. Raises InputError on other arguments or values.
        """
        for key in arguments:
            if key not in _ARGUMENTS:
                raise FieldError(key, repr(arguments[key])[:80], f"some of {', '.join(_ARGUMENTS)}")
        recent_s, report = arguments.get("recent_s", self.config.recent_s), arguments.get("report", False)
        if isinstance(recent_s, bool) or not isinstance(recent_s, int | float) or not RECENT.holds(recent_s):
            raise FieldError("recent_s", repr(recent_s), RECENT.range())
        if not isinstance(report, bool):
            raise FieldError("report", repr(report), "true or false")
        if report and not self.config.reports:
            raise FieldError("report", "true", "false", "name a folder for reports in the configuration (reports)")
        with self._lock:
            self._counts["requests"] += 1
        have_s = self._buffer.size * self._dt_s
        if self._reference is None:
            return {"started": False, "why": f"no reference yet: {have_s:.0f} of {self.config.reference_s:g} s seen"}
        first = self._buffer.last_seq - self._samples(float(recent_s)) + 1
        out = f"{self.config.reports}/{self._axis.config.name}-{time.strftime('%Y%m%d-%H%M%S')}" if report else ""
        return self._start("request", "", first, time.monotonic(), out)

    def status(self) -> dict[str, Any]:
        """For the status of the axis: counts, whether a diagnosis runs, and the last verdicts, newest first."""
        with self._lock:
            known = {"reference": self._reference is not None, "armed": self._alarm.armed, **self._counts}
            return {"enabled": True, "running": self._busy, **known, "last": self._last, "history": [*self._history]}

    def close(self) -> None:
        """End a running diagnosis; it gives no verdict."""
        self._closed = True
        if self._job is not None:
            self._job.cancel()

    @property
    def _busy(self) -> bool:
        return self._job is not None and self._job.running

    def _samples(self, seconds: float) -> int:
        return max(1, round(seconds / self._dt_s))

    def _levels(self) -> Levels | None:
        learner = self._axis.learner
        return Levels.of(learner.diagnostics()) if learner is not None and self._axis.learning else None

    def _look(self, t_s: float) -> None:
        wanted = self._samples(self.config.reference_s)
        if self._renew and self._since_reference >= wanted and self._buffer.size >= wanted:
            reference = self._buffer.copy(wanted)
            if self._moves(reference):
                self._reference, self._renew = reference, False
                self._alarm.arm(self._levels())
            return
        levels = self._levels() if self._alarm.armed and self._alarm_seq is None else None
        if levels is None or t_s < self._not_before_s:
            return
        why = self._alarm.check(t_s, levels)
        if why:
            # The diagnosis uses the samples from here on: the change is at least hold_s old.
            seq = self._buffer.last_seq
            self._alarm_why, self._due_seq, self._alarm_seq = why, seq + self._samples(self.config.collect_s), seq
            self._not_before_s = t_s + self.config.cooldown_s
            with self._lock:
                self._counts["alarms"] += 1
            self._axis.note("diagnosis_alarm", f"{why}; looking for the cause in {self.config.collect_s:g} s")

    def _moves(self, samples: FloatArray) -> bool:
        """Whether there is enough motion to determine a gain."""
        low, high = np.nanquantile(samples[3], [0.02, 0.98]) if np.isfinite(samples[3]).any() else (0.0, 0.0)
        limits = self._axis.limits
        return bool(high - low > _LEAST_MOTION * (limits.y_max_um - limits.y_min_um))

    def _start(self, cause: str, why: str, from_seq: int, now_s: float, report: str) -> dict[str, Any]:
        reference = self._reference
        with self._lock:
            if self._busy or self._closed or reference is None:
                self._counts["skipped"] += 1
                return {"started": False, "why": "one is running" if self._busy else "the service is ending"}
            self._counts["started"] = number = self._counts["started"] + 1
            recent = self._buffer.copy()
            order = {
                "model": str(self._axis.config.model.resolve()),
                "name": self._axis.config.learn or self._axis.config.served,
                "from_seq": from_seq,
                "report": report,
            }
            last = int(recent[0, -1]) if recent.shape[1] else -1
            about = {"job": number, "seq": last, "from_seq": from_seq, "cause": cause, "why": why}

            def done(result: dict[str, Any]) -> None:
                self._finish(about, result, time.monotonic() - now_s)

            arrays = {"reference": reference, "recent": recent}
            self._job = BackgroundJob(WORKER, order, arrays, self.config.timeout_s, done)
            self._job.start()
        return {"started": True, "job": number}

    def _finish(self, about: dict[str, Any], result: dict[str, Any], seconds: float) -> None:
        failed = "error" in result
        if result.pop("wait", False) and about["cause"] == "alarm" and self._wait(about):
            self._axis.note("diagnosis_waits", f"{result['error']}; once more in {self.config.collect_s:g} s")
            return
        text = f"no verdict: {result['error']}" if failed else str(result.get("text", ""))
        verdict = {**about, "seconds": round(seconds, 2), "text": text, **result}
        with self._lock:
            self._counts["failed" if failed else "finished"] += 1
            self._last = verdict
            self._history = [{key: verdict[key] for key in _TOLD}, *self._history][:_KEPT]
        self._axis.note("diagnosis_failed" if failed else "diagnosis", text)
        if about["cause"] == "alarm":
            # Later changes are relative to the present stage: take a new reference.
            self._alarm.arm(None)
            self._since_reference, self._renew = 0, True

    def _wait(self, about: dict[str, Any]) -> bool:
        """Diagnose an alarm again with more samples, if earlier samples are still kept; returns whether it will."""
        more = self._samples(self.config.collect_s)
        newest, first = self._buffer.last_seq, int(about["from_seq"])
        # A restarted count of the stage, or another alarm, supersedes this one.
        over = self._closed or newest < about["seq"] or self._alarm_seq is not None
        if over or newest + 2 * more - first > self._samples(self.config.history_s):
            return False
        with self._lock:
            self._counts["waited"] += 1
        # The same change must not raise another alarm before this diagnosis ends.
        self._not_before_s = (newest + more) * self._dt_s + self.config.cooldown_s
        self._due_seq, self._alarm_seq = newest + more, first
        return True


def _span_V(axis: Axis) -> float:
    base = None if axis.learner is None else axis.learner.base
    return base.span_V if isinstance(base, LssvmInverse) else axis.limits.u_max_V - axis.limits.u_min_V
