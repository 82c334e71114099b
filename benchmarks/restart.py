"""How long a killed service without a standby needs to serve again, and what is lost.

A stage sends samples. Service and stage are killed, the service is started again and queried, then the stage. In turns
with each start, the same interpreter imports only the libraries: compare that ratio across machines, not the times.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.latency_setup import CONNECT_S, prepare
from benchmarks.sample_feed import AXIS, STAGE
from lab.testbed.identified_stage import Rig
from service.client.client import Client
from sim.recordings import read

#: Libraries that a service needs: the lower bound of its start.
LIBRARIES = "import numpy, numba, scipy.linalg.cython_lapack, pyarrow.parquet, zenoh"
#: Time from what is told to the kill, s: the journal is milliseconds behind, more on a busy machine.
WRITTEN_S = 0.1
RATE_HZ, BATCH = 1000.0, 5


def restart(rounds: int = 10, learn_s: float = 3.0) -> dict[str, Any]:
    """Kill and start ``rounds`` times, each after ``learn_s`` seconds of samples.

    Returns
    -------
    ``ready_s``: from the start until the service is ready; ``ready_cpu_s``: the processor time that it has taken until
    then, which on a machine with idle cores is about as long; ``answered_s``: from the kill until a client that keeps
    asking has an answer; ``libraries_s``; ``ready_over_libraries``; each as a list. ``unlearnt_ms``: milliseconds of
    samples that the last status counted as handled and that the restarted learner does not know. ``records_lost``: of
    those, how many are in no recording; the kill comes ``WRITTEN_S`` after they were told.
    """
    rows: dict[str, list[float]] = {"ready_s": [], "answered_s": [], "libraries_s": [], "unlearnt_ms": []}
    rows["ready_cpu_s"] = []
    told: list[tuple[int, int]] = []
    keeps = {"recorder": "rec", "checkpoints": "kept"}
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), RATE_HZ, BATCH, False, keeps)
        service = setup.start_service()
        with Client.connect(setup.endpoint, STAGE, AXIS, wait_s=CONNECT_S, retry_s=CONNECT_S) as client:
            first = 0
            for _ in range(rounds):
                rows["libraries_s"].append(_libraries_s())
                feed = setup.start_feed(first)
                time.sleep(learn_s)
                before = int(client.status()["seq"])
                time.sleep(WRITTEN_S)
                killed = time.monotonic()
                service.kill()
                feed.kill()
                begun = time.monotonic()
                service = setup.start_service()
                rows["ready_s"].append(time.monotonic() - begun)
                rows["ready_cpu_s"].append(sum(psutil.Process(service.pid).cpu_times()[:2]))
                client.point(40.0)
                rows["answered_s"].append(time.monotonic() - killed)
                after = int(client.status()["seq"])
                rows["unlearnt_ms"].append(1e3 * max(0, before - after) / RATE_HZ)
                told.append((first, before))
                # Samples on their way have numbers too; and messages begin at a multiple of their size.
                first = (max(before, after) // BATCH + int(RATE_HZ)) * BATCH
        service.stop()
        recorded = read(Path(folder) / "rec").seq
    kept = set() if recorded is None else set(recorded.tolist())
    lost = sum(1 for begin, end in told for seq in range(begin, end + 1) if seq not in kept)
    ratio = [ready / bare for ready, bare in zip(rows["ready_s"], rows["libraries_s"], strict=True)]
    return {"rounds": rounds, **rows, "ready_over_libraries": ratio, "records_lost": lost}


def _libraries_s() -> float:
    begin = time.monotonic()
    subprocess.run([sys.executable, "-c", LIBRARIES], check=True)
    return time.monotonic() - begin


def page(report: dict[str, Any]) -> str:
    """The report as text."""
    lines = [f"A service killed and started again {report['rounds']} times, samples at {RATE_HZ:g} Hz", ""]
    for name, text in (
        ("ready_s", "from the start until it is ready, s"),
        ("ready_cpu_s", "its processor time until then, s"),
        ("libraries_s", "the libraries alone, s"),
        ("ready_over_libraries", "the first over the second"),
        ("answered_s", "from the kill until a client is answered, s"),
        ("unlearnt_ms", "learning lost, ms of samples"),
    ):
        values = np.asarray(report[name])
        lines.append(f"{text:>46}: median {np.median(values):.2f}, at most {values.max():.2f}")
    lines.append(f"{'samples told as handled that are in no recording':>46}: {report['records_lost']}")
    return "\n".join(lines)


def main() -> int:
    """``python -m benchmarks.restart``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.restart", description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=10, help="how often it is killed (10)")
    parser.add_argument("--learn", type=float, default=3.0, metavar="S", help="samples before each kill, s (3)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    args = parser.parse_args()
    if args.rounds < 1 or not 0.5 <= args.learn <= 3600.0:
        parser.error(
            f"--rounds: got {args.rounds}, expected 1 or more; --learn: got {args.learn:g}, expected 0.5 to 3600 s"
        )
    report = restart(args.rounds, args.learn)
    print(json.dumps(report) if args.json else page(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
