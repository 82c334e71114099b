"""Processes that measure the machine beside an experiment: a bare zenoh echo and a bare paced loop.

``python -m lab.testbed.side_processes echo listen|connect ENDPOINT`` answers queries with as many bytes as asked for:
the round trip without a service. ``... paced_loop STEP_S [TICKS]`` only sleeps from tick to tick: how late this machine
runs a process that asks for nothing else. Both print ``ready`` and run until stopped (the loop: or for TICKS ticks).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator

import zenoh

from service.runtime.session import open_client, open_service
from service.runtime.stopping import StopSignal

#: Key of the echo; ``echo/BYTES`` asks for a reply of so many bytes.
ECHO_KEY = "echo"


def echo(how: str, endpoint: str) -> int:
    """Answer every query on ``echo/BYTES`` with as many bytes. The payload is read as the service reads it.

    ``how``: ``listen`` opens ``endpoint``, ``connect`` connects to the router there.
    """
    from service.server.process import tune_process

    tune_process()
    stop = StopSignal()

    def answer(query: zenoh.Query) -> None:
        with query:
            if query.payload is not None:
                query.payload.to_bytes()
            key = str(query.key_expr)
            query.reply(key, bytes(int(key.rpartition("/")[2])))

    with open_service([endpoint]) if how == "listen" else open_client(endpoint, 20.0) as session:
        queryable = session.declare_queryable(f"{ECHO_KEY}/*", answer)
        print("ready", flush=True)
        stop.wait()
        queryable.undeclare()  # type: ignore[no-untyped-call]
    return 0


def delays(step_s: float, *, catch_up: bool) -> Iterator[tuple[float, float]]:
    """Sleep from tick to tick and yield (monotonic time, how late the tick came), both s.

    ``catch_up``: ticks that were missed come one after the other without a pause, as the stage's ticks do. Otherwise a
    delay moves all later ticks, so that each tick is measured by itself.
    """
    start = time.monotonic()
    tick = 0
    while True:
        tick += 1
        # From the number of the tick, not summed: no drift.
        due = start + tick * step_s
        wait_s = due - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        now = time.monotonic()
        if not catch_up and now - due > step_s:
            start += now - due - step_s
        yield now, now - due


def paced_loop(step_s: float, ticks: int | None = None) -> int:
    """Without ``ticks``: print JSON once a second, the time and the largest delay of a tick in it, both s. With them:
    print at the end how many ticks came late by more than a period."""
    stop = StopSignal()
    print("ready", flush=True)
    second, worst_s, late = time.monotonic(), 0.0, 0
    for tick, (now, late_s) in enumerate(delays(step_s, catch_up=ticks is not None), 1):
        late += late_s > step_s
        worst_s = max(worst_s, late_s)
        if ticks is None and now - second >= 1.0:
            print(json.dumps({"t_s": round(now, 3), "late_s": round(worst_s, 5)}), flush=True)
            second, worst_s = now, 0.0
        if stop.reason or tick == ticks:
            break
    if ticks is not None:
        print(json.dumps({"late": late}), flush=True)
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        sys.exit(echo(sys.argv[2], sys.argv[3]))
    sys.exit(paced_loop(float(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else None))
