"""Re-tunes the learner of an axis in the background: propose, wait for fresh samples, try, announce, adopt.

A process of the lowest priority does the long work, one at a time. The thread that learns only copies the window (some
tens of µs) and lets the learner adopt at the announced sample. An adoption belongs to a definite sample,
so that a replay and a standby compute the same snapshots.
"""

from __future__ import annotations

import math
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import Hyperparameters, OnlineModel, WindowData
from dehyst.service.background.adoptions import Retuned, append_adoption
from dehyst.service.background.job import BackgroundJob
from dehyst.service.background.retuning_worker import pack, start_job
from dehyst.service.background.settings import RetuningConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.server.axis import Axis

#: Interval at which the window is read while fresh samples are awaited, s of samples, and samples read each time.
_LOOK_S: Final = 0.25
_NEWEST: Final = 200
IDLE, PROPOSING, WAITING, TRYING = "idle", "proposing", "waiting for fresh samples", "trying"


class Retuner:
    """The re-tuning of one axis. Call `step` and `leave` in the thread that handles samples, the rest in any thread.

    Parameters
    ----------
    config : when and how to re-tune.
    folder : of the recording, where adoptions are stored; None: they are not stored.
    """

    def __init__(self, config: RetuningConfig, folder: Path | None = None) -> None:
        self.config = config
        self._folder = folder
        self._lock = threading.Lock()
        self._state = IDLE
        self._asked = False
        self._number = 0
        self._job: BackgroundJob | None = None
        self._learner: OnlineModel | None = None
        self._before: WindowData | None = None
        self._proposed: dict[str, Any] = {}
        self._since_s, self._taught = math.nan, 0
        self._known: set[bytes] = set()
        self._fresh: list[bytes] = []
        # Trials of this proposal so far; each needs twice the samples of the previous one.
        self._looks = 0
        self._look_s = -math.inf
        self._last: dict[str, Any] | None = None
        self._counts = dict.fromkeys(
            ("requests", "started", "proposed", "unchanged", "better", "worse", "timeouts", "failed", "dropped"), 0
        )

    def request(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Request a re-tuning, which begins with the next samples. Raises InputError on any argument."""
        for name in arguments:
            raise FieldError(name, repr(arguments[name])[:80], "no arguments")
        with self._lock:
            self._counts["requests"] += 1
            if self._state != IDLE or self._asked:
                return {"started": False, "why": "one is running"}
            self._asked = True
            return {"started": True, "job": self._number + 1}

    def status(self) -> dict[str, Any]:
        """For the status: the state, counts, and how the last re-tuning ended."""
        return {"state": self._state, "period_s": self.config.period_s, **self._counts, "last": self._last}

    def step(self, axis: Axis) -> None:
        """Continue a running re-tuning, or begin a due one. Never blocks; call it after each message of samples."""
        learner = axis.learner
        if learner is None or not axis.learning or learner.seq < 0:
            return
        now_s = learner.seq * axis.dt_s
        if self._state == IDLE:
            self._begin(axis, learner, now_s)
            return
        if learner is not self._learner or axis.frozen:
            self._end(now_s, "dropped", "the learner was frozen or exchanged meanwhile")
        elif self._state == WAITING:
            self._try(axis, learner, now_s)
        elif self._job is not None and self._job.result is not None:
            result, self._job = self._job.result, None
            if "error" in result:
                self._end(now_s, "timeouts" if result.get("timeout") else "failed", str(result["error"]))
            elif self._state == PROPOSING:
                self._take_proposal(result, now_s)
            else:
                self._take_trial(axis, learner, result, now_s)

    def leave(self) -> None:
        """Release the learner: the axis becomes a standby. A running re-tuning is dropped when it serves again."""
        self._learner = self._before = None

    def close(self) -> None:
        """End a running process."""
        if self._job is not None:
            self._job.cancel()

    def _begin(self, axis: Axis, learner: OnlineModel, now_s: float) -> None:
        due = self.config.period_s > 0.0 and now_s - self._since_s >= self.config.period_s
        if math.isnan(self._since_s) or now_s < self._since_s:
            self._since_s, self._taught = now_s, _taught(learner)
        if not (self._asked or due) or axis.frozen or 0.0 <= now_s - self._look_s < _LOOK_S:
            return
        self._look_s = now_s
        # A stage at rest has given no new samples to tune on or to try a proposal on.
        if not self._asked and _taught(learner) - self._taught < self.config.fresh:
            return
        data = learner.window_data()
        if data is None:
            return
        with self._lock:
            self._asked, self._state = False, PROPOSING
            self._number += 1
        self._counts["started"] += 1
        self._learner, self._before = learner, data
        self._known = set(_rows(data, np.arange(data.age.size)))
        self._fresh, self._looks = [], 0
        order = {"kind": "propose", "search": asdict(self.config.search)}
        self._job = start_job(order, pack("before", data), self.config.timeout_s)

    def _take_proposal(self, result: dict[str, Any], now_s: float) -> None:
        self._proposed = result
        self._counts["proposed"] += 1
        if result["changed"]:
            self._state, self._since_s = WAITING, now_s
        else:
            self._end(now_s, "unchanged", "nothing better was found")

    def _try(self, axis: Axis, learner: OnlineModel, now_s: float) -> None:
        if 0.0 <= now_s - self._look_s < _LOOK_S:
            return
        self._look_s = now_s
        before = self._before
        assert before is not None
        data = learner.window_data()
        assert data is not None, "it was not None when the proposal was asked for"
        self._collect(data)
        if len(self._fresh) < self.config.fresh << self._looks:
            if now_s - self._since_s > self.config.wait_s:
                self._end(now_s, "dropped", "too few fresh samples came to try it on")
            return
        order = {
            "kind": "compare",
            "search": asdict(self.config.search),
            "gamma": self._proposed["gamma"],
            "widths": self._proposed["widths"],
        }
        self._state = TRYING
        columns = np.frombuffer(b"".join(self._fresh)).reshape(len(self._fresh), -1)
        kernel, targets_V = columns[:, :-1], columns[:, -1]
        after = WindowData(kernel, targets_V, np.arange(len(columns), 0, -1.0) - 1.0, before.hyper)
        self._job = start_job(order, pack("before", before) | pack("after", after), self.config.timeout_s)

    def _collect(self, data: WindowData) -> None:
        """Keep the samples that are new in the window: in periodic motion one fresh sample replaces another."""
        newest = np.flatnonzero(data.age < _NEWEST)
        for row in _rows(data, newest[np.argsort(-data.age[newest], kind="stable")]):
            if row not in self._known:
                self._known.add(row)
                self._fresh.append(row)

    def _take_trial(self, axis: Axis, learner: OnlineModel, result: dict[str, Any], now_s: float) -> None:
        told = (
            f"{1e3 * result['after_V']:.3g} mV rms on {result['fresh']} fresh samples, "
            f"{1e3 * result['before_V']:.3g} mV as it is"
        )
        if not result["better"]:
            self._looks += 1
            if result["open"] and self._looks < self.config.search.looks:
                self._state = WAITING
            else:
                self._end(now_s, "worse", told, result)
            return
        seq = learner.seq + max(1, round(self.config.lead_s / axis.dt_s))
        hyper = Hyperparameters(float(self._proposed["gamma"]), tuple(float(w) for w in self._proposed["widths"]))
        retuned = Retuned(seq, hyper.gamma, hyper.widths)
        axis.adopt_at(retuned)
        axis.note("retuning_adopted", f"{told}; adopted after sample {seq}", retuned=retuned.to_json())
        if self._folder is not None:
            # A slow disk must not delay the thread that learns.
            threading.Thread(target=self._write, args=(self._folder, retuned), name="retuned", daemon=True).start()
        self._end(now_s, "better", told, {**result, "retuned": retuned.to_json()})

    def _write(self, folder: Path, retuned: Retuned) -> None:
        try:
            append_adoption(folder, retuned)
        except OSError as error:
            self._last = {**(self._last or {}), "not_written": str(error)}

    def _end(self, now_s: float, count: str, why: str, more: dict[str, Any] | None = None) -> None:
        if self._job is not None:
            job, self._job = self._job, None
            threading.Thread(target=job.cancel, name="retune-end", daemon=True).start()
        self._counts[count] += 1
        proposal = {key: self._proposed.get(key) for key in ("gamma", "widths", "J2", "J2_before")}
        self._last = {"job": self._number, "outcome": count, "detail": why, **proposal, **(more or {})}
        self._proposed, self._before, self._learner = {}, None, None
        self._known, self._fresh = set(), []
        # The period until the next re-tuning starts now.
        self._since_s = math.nan
        with self._lock:
            self._state = IDLE


def _taught(learner: OnlineModel) -> int:
    return int(learner.counters().get("learnt", 0))


def _rows(data: WindowData, which: NDArray[np.int64]) -> list[bytes]:
    """Each sample as the bytes of its inputs, target and weight: equal samples give equal bytes."""
    columns = np.ascontiguousarray(np.column_stack([data.kernel, data.targets_V])[which])
    return [row.tobytes() for row in columns]
