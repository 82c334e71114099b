"""Age of a followed model's last sample, whole snapshots and changes in turns, and what it costs the service.

``python -m benchmarks.followed [--seconds 20] [--turns 2] [--model auto] [--json]``. A service that learns, a stage
that replays samples at 1 kHz in batches of five, and a follower (this process) on loopback. At each of 1000 points a
second the age is the time since the stage had the last sample that the model in use has seen. The stage's clock is read
from the samples: the earliest arrival of all counts as one without delay. ``nobody`` follows in the third part of a
turn: the processor time of a sample is compared with it.

``--cost``: processor time alone, in one process and one thread, without the wire: learning and making the messages, for
the three ways in turns of one second of samples. Other work on the machine matters less there.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
import zenoh

from benchmarks.latency_setup import CONNECT_S, prepare
from benchmarks.sample_feed import AXIS, STAGE
from benchmarks.sample_feed import sent as sent_batch
from lab.testbed.identified_stage import Rig
from lab.testbed.processes import Child
from service.client.client import Client
from service.config.settings import read_config
from service.protocol.model import encode_model
from service.protocol.samples import decode_samples
from service.server.axis_loading import load_axis
from service.server.deltas import DeltaStreams

RATE_HZ: Final = 1000.0
BATCH: Final = 5
#: Time after a follower begins that is not counted, s.
_SETTLE_S: Final = 1.0
WAYS: Final = ("whole", "changes", "nobody")


class StageClock:
    """When the stage had each sample, by the clock of this process; filled by zenoh's thread."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._first_s = np.inf
        self.lock = threading.Lock()
        self._subscriber = session.declare_subscriber(key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        now_s = time.perf_counter()
        seq = int(decode_samples(sample.payload.to_bytes()).seq[-1])
        self._first_s = min(self._first_s, now_s - seq / RATE_HZ)

    def age_s(self, seq: int) -> float:
        """Time since sample ``seq``, s."""
        return time.perf_counter() - self._first_s - seq / RATE_HZ

    def close(self) -> None:
        """Take no more samples."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]


def followed(seconds: float, turns: int, model: str) -> dict[str, Any]:
    """The figures by way: ages in ms, counts of the follower, processor time of the service in µs a sample."""
    parts: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), RATE_HZ, BATCH, every_sample=False)
        service = setup.start_service()
        setup.start_feed()
        time.sleep(3.0)
        for _ in range(turns):
            for way in WAYS:
                parts[way].append(_part(rig.endpoint, service, way, seconds, model))
    report: dict[str, Any] = {"model": model, "seconds": seconds, "turns": turns}
    for way, found in parts.items():
        cpu = [part["cpu_us"] for part in found]
        report[way] = {"cpu_us": round(float(np.median(cpu)), 1), "cpu_us_by_turn": [round(x, 1) for x in cpu]}
        if way == "nobody":
            continue
        ages_ms = 1e3 * np.concatenate([part["ages_s"] for part in found])
        keys = ("messages", "lost", "mismatches", "repairs", "refused")
        report[way] |= {
            "age_ms": {name: round(float(np.percentile(ages_ms, q)), 2) for name, q in (("p50", 50), ("p99", 99))},
            "worst_ms": round(float(ages_ms.max()), 1),
            **{key: sum(part[key] for part in found) for key in keys},
        }
        if way == "changes":
            report[way]["bytes"] = found[-1]["bytes"]
    return report


def _part(endpoint: str, service: Child, way: str, seconds: float, model: str) -> dict[str, Any]:
    with Client.connect(endpoint, STAGE, AXIS, timeout_s=10.0, wait_s=CONNECT_S) as client:
        if way == "nobody":
            time.sleep(_SETTLE_S)
            return _cost(client, service, lambda: time.sleep(seconds))
        clock = StageClock(client._session, client.keys.sample)
        follower = client.follow(model, deltas=way == "changes")
        sizes: list[int] = []
        key = client.keys.champion_delta if model == "auto" else client.keys.model_delta
        sizer = None
        if way == "changes":
            sizer = client._session.declare_subscriber(key, lambda sample: sizes.append(len(sample.payload)))
        time.sleep(_SETTLE_S)
        ages = np.empty(round(seconds * RATE_HZ))
        before = follower.received

        def watch() -> None:
            start = time.perf_counter()
            for i in range(ages.size):
                rest = start + i / RATE_HZ - time.perf_counter()
                if rest > 0.0:
                    time.sleep(rest)
                follower.point(40.0 + 0.001 * (i % 100))
                ages[i] = clock.age_s(follower.snapshot_seq)

        part = _cost(client, service, watch)
        clock.close()
        if sizer is not None:
            sizer.undeclare()  # type: ignore[no-untyped-call]
        changes = follower.changes
        part |= {
            "ages_s": ages, "messages": follower.received - before, "refused": follower.refused,
            "lost": changes.lost if changes else 0, "mismatches": changes.mismatches if changes else 0,
            "repairs": changes.repairs if changes else 0,
        }  # fmt: skip
        if sizes:
            small, large = [s for s in sizes if s <= 2048], [s for s in sizes if s > 2048]
            part["bytes"] = {
                "small": len(small), "small_median": int(np.median(small or [0])), "small_most": max(small, default=0),
                "large": len(large), "large_median": int(np.median(large or [0])), "large_most": max(large, default=0),
            }  # fmt: skip
        return part


def _cost(client: Client, service: Child, work: Any) -> dict[str, Any]:
    process = psutil.Process(service.pid)
    first, before = client.status()["seq"], sum(process.cpu_times()[:2])
    work()
    last, after = client.status()["seq"], sum(process.cpu_times()[:2])
    return {"cpu_us": 1e6 * (after - before) / max(1, last - first)}


def cost(seconds: float, model: str) -> dict[str, Any]:
    """Processor time by way in µs a sample: median over turns of a second of samples, and ratios turn by turn."""
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), RATE_HZ, BATCH, every_sample=False)
        config = read_config(setup.config).axes[0]
        axes = {way: load_axis(STAGE, config) for way in WAYS}
        with np.load(setup.samples) as kept:
            u_V, y_um = kept["u_V"], kept["y_um"]
    sent: list[bytes] = []
    streams = DeltaStreams(axes["changes"])
    streams.publish(model, sent.append, lambda: True)
    second = round(RATE_HZ)
    taken: dict[str, list[float]] = {way: [] for way in WAYS}
    for turn in range(round(seconds)):
        for way in WAYS:
            axis, begin = axes[way], time.thread_time()
            for first in range(turn * second, (turn + 1) * second, BATCH):
                before = axis.newest
                axis.handle(sent_batch(u_V, y_um, RATE_HZ, BATCH, first // BATCH))
                if way == "changes":
                    streams.tick(first / RATE_HZ)
                elif way == "whole" and axis.newest is not before:
                    found, seq, memory = axis.model(model)
                    sent.append(encode_model(model, found, seq, memory, axis.safety(model)))
            sent.clear()
            taken[way].append(1e6 * (time.thread_time() - begin) / second)
    columns = {way: np.array(values[2:]) for way, values in taken.items()}  # the first seconds load and compile
    ratios = {way: float(np.median(columns["changes"] / columns[way])) for way in ("whole", "nobody")}
    us = {way: round(float(np.median(values)), 1) for way, values in columns.items()}
    return {"model": model, "cpu_us": us, "changes_over": {way: round(ratio, 3) for way, ratio in ratios.items()}}


def page(report: dict[str, Any]) -> str:
    """The report as a table."""
    nobody_us = report["nobody"]["cpu_us"]
    lines = [
        f"Model {report['model']!r}, {report['turns']} turns of {report['seconds']:g} s, 1 kHz in batches of {BATCH}",
        f"{'':10}{'age of the last sample, ms':>32}{'messages/s':>12}{'µs a sample':>13}{'x nobody':>10}",
        f"{'':10}{'p50':>10}{'p99':>10}{'worst':>12}",
    ]
    for way in WAYS:
        row = report[way]
        cost = f"{row['cpu_us']:>13.0f}{row['cpu_us'] / nobody_us:>10.2f}"
        if way == "nobody":
            lines.append(f"{way:10}{'':44}{cost}")
            continue
        rate = row["messages"] / report["seconds"] / report["turns"]
        lines.append(
            f"{way:10}{row['age_ms']['p50']:>10.1f}{row['age_ms']['p99']:>10.1f}{row['worst_ms']:>12.1f}{rate:>12.0f}"
            f"{cost}   lost {row['lost']}, mismatches {row['mismatches']}, repairs {row['repairs']}"
        )
    sizes = report["changes"]["bytes"]
    lines.append(
        f"bytes: {sizes['small']} of at most 2048 (median {sizes['small_median']}, most {sizes['small_most']}), "
        f"{sizes['large']} with the kernel part (median {sizes['large_median']}, most {sizes['large_most']})"
    )
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each part, s (%(default)s)")
    parser.add_argument("--turns", type=int, default=2, help="turns of the three parts (%(default)s)")
    parser.add_argument("--model", default="lssvm_adaptive", help="lssvm_adaptive or auto (%(default)s)")
    parser.add_argument("--cost", action="store_true", help="processor time alone, in one process")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    if args.cost:
        print(json.dumps(cost(args.seconds, args.model)))
        return
    report = followed(args.seconds, args.turns, args.model)
    print(json.dumps(report) if args.json else page(report))


if __name__ == "__main__":
    main()
