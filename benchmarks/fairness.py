"""What the longest queries of others cost a client that asks for single points, and what the others get.

    python -m benchmarks.fairness                      # one and eight others, 65,536 points each; two minutes

Service, stage and each of the others are processes of their own on loopback; the stage sends 1 kHz, five samples a
message. The point is asked for in blocks, alone and beside the others in turns, so that other load on the machine
affects both alike. Compare the ratios, not the times.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.latency_setup import CONNECT_S, RunningSetup, running_setup
from benchmarks.sample_feed import AXIS, STAGE
from lab.testbed.processes import Child, run_client_process
from service.client.client import Client
from service.protocol.errors import BusyError
from service.protocol.samples import MAX_COUNT

_TIMEOUT_S: Final = 10.0
#: Pause of the client between two points, s, and of the others while they do not ask.
_PAUSE_S: Final = 0.002
_IDLE_S: Final = 0.01
_WARM_S: Final = 3.0


# --- One of the others: asks for as much as it gets while a file is there.


def ask_long(endpoint: str, go: Path, end: Path, points: int) -> int:
    """Ask for ``points`` points over and over while ``go`` exists, until ``end`` does; prints what it got as JSON."""
    y = 40.0 + 20.0 * np.sin(np.arange(points) * 2e-3)
    v, a = 4e4 * 1e-3 * np.cos(np.arange(points) * 2e-3), np.zeros(points)
    got = {"answers": 0, "busy": 0, "asking_s": 0.0, "longest_s": 0.0}
    with Client.connect(endpoint, STAGE, AXIS, timeout_s=_TIMEOUT_S, wait_s=CONNECT_S, retry_s=_TIMEOUT_S) as client:
        client.trajectory(y[:1000], v[:1000], a[:1000])
        print(json.dumps({"ready": True}), flush=True)
        # Also where the measurement was killed and cannot say so.
        parent = os.getppid()
        while not end.exists() and os.getppid() == parent:
            if not go.exists():
                time.sleep(_IDLE_S)
                continue
            begin = time.monotonic()
            try:
                client.trajectory(y, v, a)
                got["answers"] += 1
            except BusyError:
                got["busy"] += 1
            taken = time.monotonic() - begin
            got["asking_s"] += taken
            got["longest_s"] = max(got["longest_s"], taken)
        print(json.dumps({**got, "repeated": client.retries}), flush=True)
    return 0


# --- The measurement.


def fairness(others: int, blocks: int = 6, points: int = 1500, asked: int = MAX_COUNT) -> dict[str, Any]:
    """Round trips of a point, µs, alone and beside ``others`` that ask for ``asked`` points each; what these got."""
    with (
        running_setup(1000.0, 5, False) as running,
        Client.connect(running.setup.endpoint, STAGE, AXIS, timeout_s=_TIMEOUT_S, wait_s=CONNECT_S) as client,
    ):
        folder = Path(running.setup.config).parent
        go, end = folder / "go", folder / "end"
        arguments = ["-m", "benchmarks.fairness", "--other", running.setup.endpoint, str(go), str(end), str(asked)]
        rig = running.setup.rig
        children = [rig.start(f"other-{i}", arguments, ready="{") for i in range(others)]
        time.sleep(_WARM_S)
        alone, beside = [], []
        for _ in range(blocks):
            alone.append(_points(running, client, points))
            go.touch()
            time.sleep(0.3)
            beside.append(_points(running, client, points))
            go.unlink()
            time.sleep(1.0)
        status = client.status()
        end.touch()
        got = [_last(child) for child in children]
    report: dict[str, Any] = {"others": others, "asked": asked}
    for name, taken in (("alone", alone), ("beside", beside)):
        all_us = np.concatenate(taken)
        report[name] = {f"p{q:g}": round(float(np.percentile(all_us, q)), 1) for q in (50, 99, 99.9)}
    report["over"] = {q: round(report["beside"][q] / report["alone"][q], 2) for q in report["alone"]}
    asking_s = sum(one["asking_s"] for one in got) / max(others, 1)
    report["long"] = {
        "points_per_s": round(sum(one["answers"] for one in got) * asked / max(asking_s, 1e-9)),
        "answers": [one["answers"] for one in got],
        "given_up": sum(one["busy"] for one in got),
        "longest_s": round(max(one["longest_s"] for one in got), 3),
        "refused": status["queries"]["busy"],
    }
    report["samples"] = {name: status["samples"][name] for name in ("received", "lost", "dropped")}
    return report


def _points(running: RunningSetup, client: Client, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Round trip of each of ``count`` points along the reference, µs."""
    y, v, a = (column.tolist() for column in running.setup.motion)
    after, taken = client.point(y[0]), np.empty(count)
    for i in range(count):
        begin = time.perf_counter_ns()
        after = client.point(y[i], v[i], a[i], after=after)
        taken[i] = (time.perf_counter_ns() - begin) / 1e3
        time.sleep(_PAUSE_S)
    return taken


def _last(child: Child) -> dict[str, Any]:
    """What one of the others printed at its end."""
    until = time.monotonic() + 3 * _TIMEOUT_S
    while time.monotonic() < until:
        lines = [line for line in child.lines if '"answers"' in line]
        if lines:
            return dict(json.loads(lines[-1]))
        time.sleep(_IDLE_S)
    raise TimeoutError(f"{child.name} printed nothing at its end")


def page(report: dict[str, Any]) -> str:
    """The report as lines."""
    lines = [f"A point beside {report['others']} that ask for {report['asked']} points at once, µs:"]
    for name in ("alone", "beside", "over"):
        lines.append(f"{name:>10}  " + "  ".join(f"{q} {value:g}" for q, value in report[name].items()))
    long = report["long"]
    lines.append(
        f"The others: {long['points_per_s']} points a second together, answers {long['answers']}, "
        f"{long['refused']} times refused as busy, {long['given_up']} times given up, "
        f"longest wait {long['longest_s']} s; samples {report['samples']}"
    )
    return "\n".join(lines)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--others", type=int, nargs="+", default=[1, 8], help="number of the others")
    parser.add_argument("--blocks", type=int, default=6, help="pairs of blocks, alone and beside")
    parser.add_argument("--points", type=int, default=1500, help="points of a block")
    parser.add_argument("--json", type=Path, help="append the reports to this file")
    parser.add_argument("--other", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.other:
        endpoint, go, end, points = arguments.other
        return run_client_process(lambda: ask_long(endpoint, Path(go), Path(end), int(points)))
    for others in arguments.others:
        report = fairness(others, arguments.blocks, arguments.points)
        print(page(report), flush=True)
        if arguments.json:
            with arguments.json.open("a", encoding="utf-8") as file:
                file.write(json.dumps(report) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
