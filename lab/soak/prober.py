"""A measuring client of a soak as a process: it asks for points and for a bare echo in turns, and follows the model.

``python -m lab.soak.prober TASK.json ENDPOINT`` prints a line of JSON every second: round trips in µs, the longest
time without an answer, answers that broke a promise, and the age of the followed model at each query.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Generic, TypeVar

import numpy as np
import zenoh

from adaptive.errors import DehystError, InputError
from lab.soak.controller import AXIS, STAGE, ControlTask
from lab.testbed.processes import ECHO_KEY, run_client_process
from service.client.client import Client
from service.protocol.errors import NoReplyError
from service.protocol.query import Answer, Point, encode_query, encode_reply
from service.runtime.session import open_client
from service.runtime.stopping import StopSignal

# --- Queries that overlap

Asks = TypeVar("Asks")
Gets = TypeVar("Gets")

#: Most queries under way at a time.
MOST: Final = 12


@dataclass(frozen=True, slots=True)
class QueryOutcome(Generic[Asks, Gets]):
    """The result of a query.

    Attributes
    ----------
    asked : the query. answer : None if there was none, for the reason in ``error``. took_us : round trip, µs.
    at_s : when it ended, s of the monotonic clock.
    """

    asked: Asks
    answer: Gets | None
    error: DehystError | None
    took_us: float
    at_s: float


class OverlappingQueries(Generic[Asks, Gets]):
    """Sends queries in threads ``soak-ask`` and sends another one when an answer is late, without giving up the first.

    An answer that takes 0.12 s is an answer. A client that gave it up after 0.1 s would get no answer at all on a
    machine where each one takes so long, and would report a slow service as silent. Use as a context manager.

    Parameters
    ----------
    ways : functions that send a query and return the answer, one for each query that may be under way at a time; none
    is called while its last call runs. They raise DehystError if there is no answer, after at most about a second.
    again_s : how long `ask` waits for an answer, s.
    """

    def __init__(self, ways: Sequence[Callable[[Asks], Gets]], again_s: float) -> None:
        self._idle = list(ways)
        self._again_s = again_s
        self._pool = ThreadPoolExecutor(len(ways), thread_name_prefix="soak-ask")
        self._under_way: dict[Future[QueryOutcome[Asks, Gets]], Callable[[Asks], Gets]] = {}

    def __enter__(self) -> OverlappingQueries[Asks, Gets]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown()

    def ask(self, question: Asks) -> list[QueryOutcome[Asks, Gets]]:
        """Send a query, wait until this or an earlier one has ended, and return all that have, in the order of their
        ends.

        Empty if none ended within ``again_s``: the next call then sends another one beside it.
        """
        if self._idle:
            way = self._idle.pop()
            self._under_way[self._pool.submit(_asked, way, question)] = way
        over, _ = wait(self._under_way, self._again_s, return_when=FIRST_COMPLETED)
        self._idle += [self._under_way.pop(future) for future in over]
        return sorted((future.result() for future in over), key=lambda outcome: outcome.at_s)


def _asked(way: Callable[[Asks], Gets], question: Asks) -> QueryOutcome[Asks, Gets]:
    begin = time.perf_counter()
    answer: Gets | None = None
    failure: DehystError | None = None
    try:
        answer = way(question)
    except DehystError as error:
        failure = error
    return QueryOutcome(question, answer, failure, 1e6 * (time.perf_counter() - begin), time.monotonic())


# --- The prober

#: Pause between two rounds of one query and one echo, s; time until another query is sent beside a late one, s;
#: timeout of both, s.
PAUSE_S, AGAIN_S, TIMEOUT_S = 0.01, 0.1, 1.0

#: A silence that lasts longer is reported at once, s.
SILENCE_S: Final = 0.1

PointOutcome = QueryOutcome[Point | None, Point]


class Prober:
    """The queries, and what is counted in the present second.

    ``points`` asks for a point that continues another one; ``echoes`` sends so many bytes there and back.
    """

    def __init__(
        self,
        control: ControlTask,
        points: OverlappingQueries[Point | None, Point],
        echoes: OverlappingQueries[bytes, int],
    ) -> None:
        self._control, self._points, self._echoes = control, points, echoes
        self._last: Point | None = None
        self._answered_s = time.monotonic()
        self._clear()

    def _clear(self) -> None:
        self.counts: dict[str, Any] = {
            "service_us": [], "echo_us": [], "failed": 0, "unsafe": 0, "silent_s": 0.0, "error": "", "ages_s": [],
        }  # fmt: skip

    def ask(self) -> float:
        """Ask for a point; count what is wrong with the answers that have come. Returns how long there was none, s."""
        for outcome in self._points.ask(self._last):
            self._take(outcome)
        return time.monotonic() - self._answered_s

    def _take(self, outcome: PointOutcome) -> None:
        counts = self.counts
        if outcome.answer is None:
            # An answer that cannot be decoded is worse than none.
            counts["unsafe" if isinstance(outcome.error, InputError) else "failed"] += 1
            counts["error"] = str(outcome.error)
            # The model may have changed: ask without a memory.
            self._last = None
            return
        counts["service_us"].append(round(outcome.took_us, 1))
        counts["silent_s"] = max(counts["silent_s"], outcome.at_s - self._answered_s)
        self._answered_s = max(self._answered_s, outcome.at_s)
        counts["unsafe"] += not self._safe(outcome.asked, outcome.answer)
        self._last = outcome.answer

    def _safe(self, before: Point | None, point: Point) -> bool:
        c = self._control
        safe = math.isfinite(point.u_V) and c.u_min_V <= point.u_V <= c.u_max_V
        if before is None:
            return safe
        return safe and abs(point.u_V - before.u_V) <= c.slew_V_per_s * c.dt_s * (1.0 + 1e-9)

    def echo(self, payload: bytes) -> None:
        """Measure the bare round trip of as many bytes."""
        self.counts["echo_us"] += [round(o.took_us, 1) for o in self._echoes.ask(payload) if o.answer is not None]

    def look(self, age_s: float) -> None:
        """Record the age of the followed model, s."""
        self.counts["ages_s"].append(round(age_s, 4))

    def report(self) -> str:
        """The JSON line of the second; begins a new second."""
        # Includes a silence that has not ended.
        self.counts["silent_s"] = round(max(self.counts["silent_s"], time.monotonic() - self._answered_s), 4)
        line = json.dumps({"t_s": round(time.monotonic(), 3), **self.counts})
        self._clear()
        return line


def _echo(querier: zenoh.Querier, payload: bytes) -> int:
    """Send ``payload`` to the echo and return how many bytes came back. Raises NoReplyError."""
    for reply in querier.get(payload=payload):
        if reply.ok is not None:
            return len(reply.ok.payload.to_bytes())
    raise NoReplyError("soak: no echo")


def run(task: ControlTask, endpoint: str) -> int:
    """Query the service behind ``endpoint`` until stopped."""
    stop = StopSignal()
    y_um = 0.5 * (task.low_um + task.high_um)

    def point(client: Client, before: Point | None) -> Point:
        return client.point(y_um, after=before)

    with Client.connect(endpoint, STAGE, AXIS, timeout_s=TIMEOUT_S, retry_s=0.0, wait_s=30.0) as client:
        first = client.point(y_um)
        payload = encode_query([0.0], [0.0], [0.0], memory=first.memory, model=first.model)
        reply = Answer(np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.uint8), first.memory, 0, first.model)
        key = f"{ECHO_KEY}/{len(encode_reply(reply))}"
        with open_client(endpoint, 10.0) as session, ExitStack() as stack:
            # A client must not be used by several threads at once.
            clients = [stack.enter_context(Client(session, client.keys, TIMEOUT_S, retry_s=0.0)) for _ in range(MOST)]
            queriers = [session.declare_querier(key, timeout=TIMEOUT_S, express=True) for _ in range(MOST)]
            points = stack.enter_context(OverlappingQueries([partial(point, each) for each in clients], AGAIN_S))
            echoes = stack.enter_context(OverlappingQueries([partial(_echo, each) for each in queriers], AGAIN_S))
            prober = Prober(task, points, echoes)
            follower = client.follow()
            print("ready", flush=True)
            next_s = time.monotonic() + 1.0
            while not stop.reason:
                if (silent_s := prober.ask()) > SILENCE_S:
                    # At once: what the services do is looked at while it lasts.
                    print(json.dumps({"silence_s": round(silent_s, 3)}), flush=True)
                prober.echo(payload)
                time.sleep(PAUSE_S)
                prober.look(follower.age_s)
                if time.monotonic() >= next_s:
                    next_s += 1.0
                    print(prober.report(), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_client_process(lambda: run(ControlTask.read(Path(sys.argv[1])), sys.argv[2])))
