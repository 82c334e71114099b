"""Re-tunes the learner of an axis in the background: propose, wait for fresh samples, try, announce, adopt.

A process of the lowest priority does the long work, one at a time. The thread that learns only copies the window (some
tens of µs) and lets the learner adopt at the announced sample. An adoption belongs to a definite sample,
so that a replay and a standby compute the same snapshots.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Generator, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray, OnlineModel, WindowData
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
        #: The learner that is re-tuned, and the steps of that.
        self._learner: OnlineModel | None = None
        self._steps: Iterator[None] = iter(())
        self._proposed: dict[str, Any] = {}
        self._now_s = self._since_s = math.nan
        self._taught = 0
        self._look_s = -math.inf
        self._last: dict[str, Any] | None = None
        counts = ("requests", "started", "proposed", "unchanged", "better", "worse", "timeouts", "failed", "dropped")
        self._counts = dict.fromkeys(counts, 0)

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
        self._now_s = learner.seq * axis.dt_s
        if self._state == IDLE:
            self._begin(axis, learner)
        if self._state == IDLE:
            return
        if learner is not self._learner or axis.frozen:
            self._end("dropped", "the learner was frozen or exchanged meanwhile")
        else:
            try:
                next(self._steps)
            except StopIteration as ended:
                self._end(*ended.value)

    def leave(self) -> None:
        """Release the learner: the axis becomes a standby. A running re-tuning is dropped when it serves again."""
        self._learner, self._steps = None, iter(())

    def close(self) -> None:
        """End a running process."""
        if self._job is not None:
            self._job.cancel()

    def _looks(self) -> bool:
        """Whether the window may be read again."""
        looks = not 0.0 <= self._now_s - self._look_s < _LOOK_S
        self._look_s = self._now_s if looks else self._look_s
        return looks

    def _begin(self, axis: Axis, learner: OnlineModel) -> None:
        due = self.config.period_s > 0.0 and self._now_s - self._since_s >= self.config.period_s
        if math.isnan(self._since_s) or self._now_s < self._since_s:
            self._since_s, self._taught = self._now_s, _taught(learner)
        if not (self._asked or due) or axis.frozen or not self._looks():
            return
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
        self._learner, self._steps = learner, self._retune(axis, learner, data)

    def _retune(self, axis: Axis, learner: OnlineModel, before: WindowData) -> Generator[None, None, tuple[Any, ...]]:
        """The steps of one re-tuning. Returns the arguments of `_end`."""
        config, search = self.config, asdict(self.config.search)
        proposal = yield from self._worked({"kind": "propose", "search": search}, pack("before", before))
        if "error" in proposal:
            return _failure(proposal)
        self._proposed = proposal
        self._counts["proposed"] += 1
        if not proposal["changed"]:
            return "unchanged", "nothing better was found"
        known, fresh = set(_rows(before, np.arange(before.age.size))), list[bytes]()
        since_s, told, trial = self._now_s, "", {}
        # Each trial needs twice the samples of the one before.
        for look in range(config.search.looks):
            self._state = WAITING
            while len(fresh) < config.fresh << look:
                if self._now_s - since_s > config.wait_s:
                    return "dropped", "too few fresh samples came to try it on"
                yield
                if self._looks():
                    _collect(learner, known, fresh)
            self._state = TRYING
            columns = np.frombuffer(b"".join(fresh)).reshape(len(fresh), -1)
            after = WindowData(columns[:, :-1], columns[:, -1], np.arange(len(fresh), 0, -1.0) - 1.0, before.hyper)
            order = {"kind": "compare", "search": search, "gamma": proposal["gamma"], "widths": proposal["widths"]}
            trial = yield from self._worked(order, pack("before", before) | pack("after", after))
            if "error" in trial:
                return _failure(trial)
            told = (
                f"{1e3 * trial['after_V']:.3g} mV rms on {trial['fresh']} fresh samples, "
                f"{1e3 * trial['before_V']:.3g} mV as it is"
            )
            if trial["better"]:
                return "better", told, {**trial, "retuned": self._adopt(axis, learner, told)}
            if not trial["open"]:
                break
        return "worse", told, trial

    def _worked(self, order: dict[str, Any], arrays: dict[str, FloatArray]) -> Generator[None, None, dict[str, Any]]:
        """The result of a process; waits for it from step to step."""
        self._job = start_job(order, arrays, self.config.timeout_s)
        while self._job.result is None:
            yield
        result, self._job = self._job.result, None
        return result

    def _adopt(self, axis: Axis, learner: OnlineModel, told: str) -> dict[str, Any]:
        """Announce and store the adoption of the proposal; returns it as JSON."""
        seq = learner.seq + max(1, round(self.config.lead_s / axis.dt_s))
        retuned = Retuned(seq, float(self._proposed["gamma"]), tuple(float(w) for w in self._proposed["widths"]))
        axis.adopt_at(retuned)
        axis.note("retuning_adopted", f"{told}; adopted after sample {seq}", retuned=retuned.to_json())
        if self._folder is not None:
            # A slow disk must not delay the thread that learns.
            threading.Thread(target=self._write, args=(self._folder, retuned), name="retuned", daemon=True).start()
        return retuned.to_json()

    def _write(self, folder: Path, retuned: Retuned) -> None:
        try:
            append_adoption(folder, retuned)
        except OSError as error:
            self._last = {**(self._last or {}), "not_written": str(error)}

    def _end(self, count: str, why: str, more: dict[str, Any] | None = None) -> None:
        if self._job is not None:
            job, self._job = self._job, None
            threading.Thread(target=job.cancel, name="retune-end", daemon=True).start()
        self._counts[count] += 1
        proposal = {key: self._proposed.get(key) for key in ("gamma", "widths", "J2", "J2_before")}
        self._last = {"job": self._number, "outcome": count, "detail": why, **proposal, **(more or {})}
        self._proposed, self._learner, self._steps = {}, None, iter(())
        # The period until the next re-tuning starts now.
        self._since_s = math.nan
        with self._lock:
            self._state = IDLE


def _failure(result: dict[str, Any]) -> tuple[str, str]:
    return "timeouts" if result.get("timeout") else "failed", str(result["error"])


def _collect(learner: OnlineModel, known: set[bytes], fresh: list[bytes]) -> None:
    """Keep the samples that are new in the window: in periodic motion one fresh sample replaces another."""
    data = learner.window_data()
    assert data is not None, "it was not None when the proposal was asked for"
    newest = np.flatnonzero(data.age < _NEWEST)
    for row in _rows(data, newest[np.argsort(-data.age[newest], kind="stable")]):
        if row not in known:
            known.add(row)
            fresh.append(row)


def _taught(learner: OnlineModel) -> int:
    return int(learner.counters().get("learnt", 0))


def _rows(data: WindowData, which: NDArray[np.int64]) -> list[bytes]:
    """Each sample as the bytes of its inputs, target and weight: equal samples give equal bytes."""
    columns = np.ascontiguousarray(np.column_stack([data.kernel, data.targets_V])[which])
    return [row.tobytes() for row in columns]
