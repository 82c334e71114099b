"""The cost of background tuning for queries: round trips with and without its process at work.

``python -m benchmarks.retuning [--seconds S] [--pairs N] [--json]``. Service, stage and client are processes of their
own on loopback; the service learns. Phases without and with tuning alternate, each pair in the opposite order of the
one before. In a phase with tuning one proposal on a full window follows another without a pause: far more than in a
service. The report gives ratios within a pair, so that other load on the machine affects both alike.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import asdict
from typing import Any

import numpy as np

from adaptive.tuning.config import RetuneConfig
from adaptive.types import FloatArray, Hyperparameters, WindowData
from benchmarks.latency_setup import LatencySetup, running_setup
from benchmarks.measuring import DIMENSION, stream
from benchmarks.sample_feed import AXIS, STAGE
from lab.testbed.identified_stage import WINDOW
from service.background.job import BackgroundJob
from service.background.retuning_worker import pack, start_job
from service.background.settings import RetuningConfig
from service.client.client import Client

QUANTILES = {"p50": 50.0, "p99": 99.0}
#: Pause between two queries, s: a controller asks block by block and does not keep a core busy.
PAUSE_S = 0.002
#: Time in which the tuning process loads its libraries, s; not measured.
WARM_S = 3.0


class Tuning:
    """One proposal after the other, each in a process of its own, as in the service."""

    def __init__(self) -> None:
        X, y = stream(WINDOW)
        hyper = Hyperparameters(100.0, (1.0,) * DIMENSION)
        data = WindowData(X, y, np.ones(WINDOW), np.arange(WINDOW, 0, -1.0) - 1.0, hyper)
        self._arrays = pack("before", data)
        self._job: BackgroundJob | None = None
        self.done = 0

    def step(self) -> None:
        """Start the next proposal if none runs. Raises RuntimeError if one failed."""
        if self._job is not None and self._job.result is not None:
            if "error" in self._job.result:
                raise RuntimeError(f"the working process failed: {self._job.result['error']}")
            self._job, self.done = None, self.done + 1
        if self._job is None:
            order = {"kind": "propose", "search": asdict(RetuneConfig()), "torch": RetuningConfig().torch}
            self._job = start_job(order, self._arrays, 60.0)

    def stop(self) -> None:
        """Cancel the running proposal."""
        if self._job is not None:
            self._job.cancel()
            self._job = None


def retuning(seconds: float = 30.0, pairs: int = 4) -> dict[str, Any]:
    """Round trips of one point in µs, ``pairs`` times ``seconds`` without and with tuning, and their ratios in each
    pair."""
    load_before, rows = os.getloadavg()[0], []
    tuning = Tuning()
    with (
        running_setup(1000.0, 1, False) as running,
        Client.connect(running.setup.endpoint, STAGE, AXIS, wait_s=60.0) as client,
    ):
        _phase(running.setup, client, WARM_S, None)
        for pair in range(pairs):
            row: dict[str, dict[str, float]] = {}
            for busy in (False, True) if pair % 2 == 0 else (True, False):
                try:
                    if busy:
                        _phase(running.setup, client, WARM_S, tuning)
                    taken = _phase(running.setup, client, seconds, tuning if busy else None)
                finally:
                    tuning.stop()
                name = "with" if busy else "without"
                row[name] = {key: round(float(np.percentile(taken, q)), 1) for key, q in QUANTILES.items()}
                row[name]["queries"] = float(taken.size)
            rows.append(row)
    ratios = {key: [row["with"][key] / row["without"][key] for row in rows] for key in QUANTILES}
    return {
        "seconds": seconds,
        "pairs": rows,
        "proposals": tuning.done,
        "cores": os.cpu_count(),
        "load": [round(load_before, 1), round(os.getloadavg()[0], 1)],
        **{
            f"{key}_ratio": {"median": float(np.median(r)), "least": min(r), "most": max(r)}
            for key, r in ratios.items()
        },
    }


def _phase(setup: LatencySetup, client: Client, seconds: float, tuning: Tuning | None) -> FloatArray:
    """Wall time of each query in a phase, µs."""
    y, v, a = (column.tolist() for column in setup.motion)
    taken: list[float] = []
    point = client.point(y[0])
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if tuning is not None:
            tuning.step()
        k = len(taken) % len(y)
        begin = time.perf_counter_ns()
        point = client.point(y[k], v[k], a[k], after=point)
        taken.append((time.perf_counter_ns() - begin) / 1e3)
        time.sleep(PAUSE_S)
    return np.array(taken)


def page(report: dict[str, Any]) -> str:
    """The report as a table."""
    lines = [
        f"Round trips of one point, µs, {report['seconds']:g} s a phase, re-tuning without a pause in every second one",
        f"({report['proposals']} proposals; {report['cores']} cores, load {report['load'][0]} to {report['load'][1]})",
        "",
        f"{'pair':>6}{'without p50':>14}{'p99':>10}{'with p50':>14}{'p99':>10}",
    ]
    for i, row in enumerate(report["pairs"]):
        cells = [row[name][key] for name in ("without", "with") for key in QUANTILES]
        lines.append(f"{i + 1:>6}{cells[0]:>14.0f}{cells[1]:>10.0f}{cells[2]:>14.0f}{cells[3]:>10.0f}")
    for key in QUANTILES:
        r = report[f"{key}_ratio"]
        lines.append(f"{key} with over without: median {r['median']:.2f} ({r['least']:.2f} to {r['most']:.2f})")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="query latency with and without re-tuning in the background")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each phase (30)")
    parser.add_argument("--pairs", type=int, default=4, help="of phases without and with (4)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    args = parser.parse_args()
    report = retuning(args.seconds, args.pairs)
    print(json.dumps(report) if args.json else page(report))


if __name__ == "__main__":
    main()
