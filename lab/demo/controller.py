"""The controller: follows the models, sends voltages, records the readings.

``python -m dehyst.lab.demo.controller PLAN.json ENDPOINT OUT.npz``. The stage's samples are its clock: it computes a
block when the stage has published the tick that the plan gives. Progress goes to standard output as lines of JSON.
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from dehyst.adaptive.types import FloatArray
from dehyst.lab.demo.plan import AXIS, MODELS, STAGE, TEACHER, UNITS, Plan
from dehyst.lab.demo.result import empty
from dehyst.lab.testbed.processes import run_client_process
from dehyst.service.client.client import Client, PendingCommands
from dehyst.service.client.follower import Follower
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.runtime.session import SURELY, open_client, wait_followed
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.security.lease import CommandLease

# --- The voltages by followed models, in real time and in one process alike.
#
# The learning model is evaluated block by block, from the memory that the samples have left and along what is commanded
# since. Each block commands the ticks after it as well: a controller that stalls is replaced by a model that is as much
# older, not by a voltage that stands still. The other models do not change and are evaluated further ahead.

#: Ticks of a model that does not change that are evaluated at once, and how far ahead of the block.
CHUNK, FAR = 100, 1000


class FollowedModels:
    """Evaluates the followers of all models along the reference.

    Parameters
    ----------
    followers : by model; that of ``TEACHER`` follows the changes and keeps some states.

    Attributes
    ----------
    durations_s : of the evaluation of each block.
    """

    def __init__(self, plan: Plan, followers: Mapping[str, Follower]) -> None:
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
                yield name, done, follower.trajectory(y, v, a)[0]
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
        self._used.append((begin, as_of, answer.snapshot_seq))
        self._extrapolated += (fresh - block) * plan.block
        return begin, answer.u_V

    def counts(self) -> dict[str, float]:
        """Figures of the followed model.

        ``extrapolated`` : ticks whose voltage was computed with a reserve. ``late_models`` : blocks whose planned model
        came after them. ``lost`` : changes whose whole model was missing.
        ``age_p50_ms``, ``age_p99_ms`` : from the last sample that a block's model had seen to the block's first tick.
        """
        seen = np.array(sorted(self._seen | {-1}))
        late = 0
        for _, as_of, used in self._used:
            best = int(seen[np.searchsorted(seen, as_of, side="right") - 1]) if as_of >= 0 else used
            late += best > used
        learnt = np.array([begin - used for begin, _, used in self._used if used >= 0] or [0])
        p50, p99 = np.percentile(learnt * self._plan.dt_s * 1e3, (50, 99)).tolist()
        return {
            "extrapolated": self._extrapolated,
            "late_models": late,
            "lost": self._followers[TEACHER].lost,
            "age_p50_ms": p50,
            "age_p99_ms": p99,
        }


# --- The process.

#: How long to wait for the stage's next samples, s.
STALL_S = 10.0
#: How long to wait for the model that a block is planned with, s; with ``strict`` the stage's clock runs meanwhile.
MODEL_S, STRICT_MODEL_S = 0.5, 0.002
#: States of a followed model that are kept.
KEPT = 64
#: Ticks of the reference that are published at once.
TOLD = 20


class Twins:
    """The readings of the twin stages so far, filled by zenoh's thread."""

    def __init__(self, plan: Plan, session: zenoh.Session) -> None:
        self.y_um = empty(plan)
        self.seen = {name: 0 for name in MODELS}
        self._ticks = plan.ticks
        self._moved = threading.Condition()
        self._subscribers = [
            session.declare_subscriber(Keys(STAGE, UNITS[name]).sample, self._taker(name)) for name in MODELS
        ]

    def _taker(self, name: str) -> Any:
        def take(sample: zenoh.Sample) -> None:
            batch = wire.decode_samples(sample.payload.to_bytes())
            first, stop = int(batch.seq[0]), int(batch.seq[-1]) + 1
            if stop > self._ticks:
                return
            self.y_um[name][first:stop] = batch.y_um
            with self._moved:
                self.seen[name] = stop
                self._moved.notify_all()

        return take

    def wait(self, ticks: int, names: Sequence[str] = tuple(MODELS)) -> bool:
        """Wait until the twins ``names`` have published ``ticks`` samples; False if they stopped."""
        with self._moved:
            return self._moved.wait_for(lambda: min(self.seen[name] for name in names) >= ticks, STALL_S)

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]


def follow(plan: Plan, endpoint: str, out: Path) -> int:
    """Run the plan by followed models against the stage behind ``endpoint``; writes ``out``. Returns 1 if the stage
    stalled."""
    wanted = plan.reference()
    n, size = plan.ticks, plan.block
    # Two sessions, so that a model does not wait behind the samples of five twins.
    with Client.connect(endpoint, STAGE, AXIS, wait_s=20.0) as client, open_client(endpoint) as session:
        followers = {name: client.follow(name, keep=KEPT if name == TEACHER else 1) for name in MODELS}
        models = FollowedModels(plan, followers)
        twins = Twins(plan, session)
        by = own_authenticator()
        commands = {name: CommandLease(session, Keys(STAGE, UNITS[name]), by) for name in MODELS}
        event = session.declare_publisher(Keys(STAGE, AXIS).event, congestion_control=SURELY)
        try:
            _wait_for_stage(commands)
            block = 0
            while block * size < n:
                if not twins.wait(block * size - plan.lead, (TEACHER,)):
                    print(json.dumps({"stalled": block * size}), flush=True)
                    return 1
                seen = twins.seen[TEACHER]
                fresh, stop = blocks_now(plan, block, seen)
                models.wait(fresh, STRICT_MODEL_S if plan.strict else MODEL_S)
                if block == 0:  # the stage's clock starts when every twin has commands
                    for name, begin, u_V in models.constant(0):
                        commands[name].put(wire.encode_command(begin, u_V))
                begin, u_V = models.block(block, fresh, stop)
                commands[TEACHER].put(wire.encode_command(begin, u_V))
                done, block = block, stop
                if fresh * size % CHUNK == 0:
                    for name, begin, u_V in models.constant(stop * size):
                        commands[name].put(wire.encode_command(begin, u_V))
                if done * size // TOLD < block * size // TOLD:
                    part = slice(done * size // TOLD * TOLD, min(block * size // TOLD * TOLD, n))
                    client.reference(part.start, wanted[0][part])
                if done * size <= plan.change_tick < block * size:
                    # For the viewer only: the service must find out by itself.
                    told = {"seq": plan.change_tick, "event": "stage_change", "detail": plan.change_text}
                    event.put(json.dumps(told))
                if block * size // 1000 > done * size // 1000:
                    _report(plan, wanted[0], twins, max(0, min(seen, done * size - plan.lead)))
            complete = twins.wait(n)
        finally:
            twins.close()
            for lease in commands.values():
                lease.undeclare()
            event.undeclare()  # type: ignore[no-untyped-call]
        counts = models.counts()
    arrays: dict[str, Any] = {f"y_um/{name}": values for name, values in twins.y_um.items()}
    np.savez(out, query_s=np.asarray(models.durations_s), followed=json.dumps(counts), **arrays)
    print(json.dumps({"done": complete, "received": twins.seen}), flush=True)
    return 0 if complete else 1


def _wait_for_stage(commands: dict[str, CommandLease]) -> None:
    """Wait until every twin takes commands. Raises ServiceError if one does not."""
    # The subscriptions must have reached the stage before the first commands start its clock.
    time.sleep(0.3)
    for name, lease in commands.items():
        if not wait_followed(lease.publisher, STALL_S):
            raise ServiceError(f"{UNITS[name]}: no stage takes commands within {STALL_S:g} s; does it run?")


def blocks_now(plan: Plan, block: int, seen: int) -> tuple[int, int]:
    """(fresh, stop) after ``seen`` samples: command the blocks before ``stop`` instead of only ``block``.

    In time this is one block. Otherwise all blocks up to the one that would be due now, or a controller that was late
    once would stay late. What is before block ``fresh`` is past already and of no use.
    """
    size = plan.block
    if seen <= block * size:
        return block, block + 1
    last = plan.ticks // size
    return min(-(-seen // size), last - 1), min((seen + plan.lead) // size + 1, last)


def _report(plan: Plan, wanted_um: Any, twins: Twins, done: int) -> None:
    tail = slice(max(0, done - round(1.0 / plan.dt_s)), done)
    if done > 0:
        error = {name: float(np.nanmean(np.abs(wanted_um[tail] - twins.y_um[name][tail]))) for name in MODELS}
        print(json.dumps({"done_ticks": done, "error_um": error}), flush=True)


def main(argv: list[str]) -> int:
    """Entry of the process. Returns its exit status."""
    plan = Plan(**json.loads(Path(argv[0]).read_text()))
    return run_client_process(lambda: follow(plan, argv[1], Path(argv[2])))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
