"""The controller's part of the demonstration by followed models, in real time and in one process alike.

The learning model is evaluated block by block, from the memory that the samples have left and along what is commanded
since. Each block commands the ticks after it as well: a controller that stalls is replaced by a model that is as much
older, not by a voltage that stands still. The other models do not change and are evaluated further ahead.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping

import numpy as np

from adaptive.types import FloatArray
from lab.demo.plan import MODELS, TEACHER, Plan
from lab.demo.result import empty
from service.client.client import PendingCommands
from service.client.follower import Follower
from service.protocol.query import FeedforwardQuery

#: Ticks of a model that does not change that are evaluated at once, and how far ahead of the block.
CHUNK, FAR = 100, 1000


class FollowedModels:
    """Evaluates the followers of all models along the reference.

    Parameters
    ----------
    followers : by model; that of ``TEACHER`` follows the changes and keeps some states.

    Attributes
    ----------
    std_V : (ticks,) by model, V. durations_s : of the evaluation of each block.
    """

    def __init__(self, plan: Plan, followers: Mapping[str, Follower]) -> None:
        self.std_V = empty(plan)
        self.durations_s: list[float] = []
        self._plan, self._followers = plan, followers
        self._wanted = plan.reference()
        self._commanded = PendingCommands()
        self._done = dict.fromkeys((name for name in MODELS if name != TEACHER), 0)
        self._seen: set[int] = set()
        self._used: list[tuple[int, int, int]] = []  # (first tick, as_of, last sample that the model had seen)
        self._extrapolated = 0

    def constant(self, due: int) -> Iterator[tuple[str, int, FloatArray]]:
        """(model, first tick, (n,) voltages) of the models that do not change, up to ``FAR`` ticks after ``due``."""
        for name, done in self._done.items():
            while done < min(due + FAR, self._plan.ticks):
                stop = min(done + CHUNK, self._plan.ticks)
                y, v, a = (column[done:stop] for column in self._wanted)
                follower = self._followers[name]
                u_V, _ = follower.trajectory(y, v, a)
                got = follower.last_trajectory
                assert got is not None
                self.std_V[name][done:stop] = got.std_V
                yield name, done, u_V
                self._done[name] = done = stop

    def wait(self, fresh: int, timeout_s: float) -> None:
        """Wait until the model that block ``fresh`` is planned with has come."""
        # The last sample of a block that the model may have learnt; the service sends a change after each.
        planned = (self._plan.as_of(fresh) + 1) // self._plan.block * self._plan.block - 1
        if planned >= 0:
            self._followers[TEACHER].wait(planned, timeout_s)

    def block(self, block: int, fresh: int, stop: int) -> tuple[int, FloatArray]:
        """(first tick, voltages) of the learning model for the blocks from ``fresh`` to ``stop``, and the reserve.

        ``block`` : the one that was due; the ticks from there to ``fresh`` got the voltages of an earlier reserve.
        """
        plan, follower = self._plan, self._followers[TEACHER]
        begin, end = fresh * plan.block, min(stop * plan.block, plan.ticks)
        reach = min(end + plan.reserve, plan.ticks)
        before = self._commanded.before(begin)
        u_before_V = math.nan if before is None else float(before.u_V[-1])
        y, v, a = (column[begin:reach] for column in self._wanted)
        as_of = plan.as_of(fresh)
        started = time.perf_counter()
        self._seen.update(follower.kept)
        answer = follower.answer(FeedforwardQuery(y, v, a, None, TEACHER, as_of, u_before_V, before))
        self.durations_s.append(time.perf_counter() - started)
        self._commanded.take(begin, y, answer)
        self.std_V[TEACHER][begin:end] = answer.std_V[: end - begin]
        self._used.append((begin, as_of, answer.snapshot_seq))
        self._extrapolated += (fresh - block) * plan.block
        return begin, answer.u_V

    def counts(self) -> dict[str, float]:
        """Figures of the followed model.

        ``extrapolated`` : ticks whose voltage was computed with a reserve. ``late_models`` : blocks whose planned model
        came after them. ``lost``, ``repairs`` : changes that were missing, and whole models fetched for them.
        ``age_p50_ms``, ``age_p99_ms`` : from the last sample that a block's model had seen to the block's first tick.
        """
        seen = np.array(sorted(self._seen | {-1}))
        late = 0
        for _, as_of, used in self._used:
            best = int(seen[np.searchsorted(seen, as_of, side="right") - 1]) if as_of >= 0 else used
            late += best > used
        learnt = np.array([begin - used for begin, _, used in self._used if used >= 0] or [0])
        p50, p99 = np.percentile(learnt * self._plan.dt_s * 1e3, (50, 99)).tolist()
        changes = self._followers[TEACHER].changes
        return {
            "extrapolated": self._extrapolated,
            "late_models": late,
            "lost": 0 if changes is None else changes.lost,
            "repairs": 0 if changes is None else changes.repairs,
            "age_p50_ms": p50,
            "age_p99_ms": p99,
        }
