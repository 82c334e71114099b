"""Query round trips beside a bare zenoh echo of the same payloads, with learning on, and the cost of a follower.

Service, echo, stage and client are processes of their own on loopback. The client queries echo and service in turns,
so that other load on the machine affects both alike. Compare ratios across machines, not absolute times. At the end
the stage is stopped, and the learner is compared with one that learns the same samples offline
(`benchmarks.exactness`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import psutil

from benchmarks.exactness import Adopted, exactness
from benchmarks.latency_setup import CONNECT_S, RunningSetup, running_setup
from benchmarks.sample_feed import AXIS, STAGE
from dehyst.adaptive.types import FloatArray
from dehyst.lab.testbed.identified_stage import WINDOW
from dehyst.lab.testbed.processes import ECHO_KEY
from dehyst.service.client.client import Client
from dehyst.service.protocol.query import Answer, Trajectory, encode_query, encode_reply
from dehyst.service.runtime.session import open_client

TRAJECTORY = 100
#: Timeout of a query, s: on a busy machine answers are late, and that is measured.
_TIMEOUT_S = 10.0


def latency(
    rate_hz: float = 1000.0, batch: int = 1, rounds: int = 4000, warm_s: float = 5.0, every_sample: bool = True
) -> dict[str, Any]:
    """Round trips in µs with a stage at ``rate_hz``, ``batch`` samples per message.

    ``every_sample``: filter and window learn each sample; otherwise at the learner's own rates.
    """
    with (
        running_setup(rate_hz, batch, every_sample) as running,
        _connected(running) as client,
        Adopted(client._session, client.keys.event) as adopted,
    ):
        time.sleep(warm_s)
        report = {"rate_hz": rate_hz, "batch": batch, "learn_every": 1 if every_sample else 10}
        report |= {"queries": _ask(running, client, rounds), "follower": _follow(running, min(rounds, 5000))}
        report |= {"samples": _samples(running, client, 10.0 if rounds > 1000 else 2.0)}
        exact = exactness(running, client, adopted)
        return report | {"learnt_exactly": exact["learnt_exactly"], "exactness": exact}


def _connected(running: RunningSetup) -> Client:
    return Client.connect(running.setup.endpoint, STAGE, AXIS, timeout_s=_TIMEOUT_S, wait_s=CONNECT_S)


def _ask(running: RunningSetup, client: Client, rounds: int) -> dict[str, Any]:
    """Service and echo in turns: one point, and a trajectory."""
    y, v, a = running.setup.motion
    with open_client(running.echo_at, CONNECT_S) as session:
        first = client.point(float(y[0]))
        report = {}
        for name, n in (("point", 1), (f"trajectory_{TRAJECTORY}", TRAJECTORY)):
            payload = encode_query(y[:n], v[:n], a[:n], memory=first.memory, u_before_V=first.u_V)
            reply_bytes = len(encode_reply(_reply(n, first.memory.size, first.model)))
            querier = session.declare_querier(f"{ECHO_KEY}/{reply_bytes}", timeout=_TIMEOUT_S, express=True)
            raw = client._session.declare_querier(client.keys.feedforward, timeout=_TIMEOUT_S, express=True)

            def echo(querier: Any = querier, payload: bytes = payload) -> None:
                for got in querier.get(payload=payload):
                    got.ok.payload.to_bytes()

            def wire(raw: Any = raw, payload: bytes = payload) -> None:
                for got in raw.get(payload=payload):
                    got.ok.payload.to_bytes()

            def call(n: int = n) -> None:
                if n == 1:
                    client.point(float(y[0]), float(v[0]), float(a[0]), after=first)
                else:
                    client.trajectory(y[:n], v[:n], a[:n], after=first)

            taken = _in_turns({"echo": echo, "service": wire, "client": call}, rounds)
            querier.undeclare()
            raw.undeclare()
            report[name] = {"payload_bytes": len(payload), "reply_bytes": reply_bytes} | _table(taken)
        return report


def _follow(running: RunningSetup, points: int) -> dict[str, Any]:
    """Cost of a point in the client's own process, and the age of its model."""
    y, v, a = (column.tolist() for column in running.setup.motion)
    with _connected(running) as client:
        follower = client.follow()
        time.sleep(1.0)
        taken, spent, ages = np.empty(points), np.empty(points), np.empty(points)
        for i in range(points):
            k = i % len(y)
            begin_cpu, begin = time.thread_time_ns(), time.perf_counter_ns()
            follower.point(y[k], v[k], a[k])
            taken[i] = time.perf_counter_ns() - begin
            spent[i] = time.thread_time_ns() - begin_cpu
            ages[i] = follower.age_s
            if i % 10 == 9:
                time.sleep(0.005)
        return {
            "point_us": _percentiles(taken / 1e3),
            "point_cpu_us": float(np.median(spent)) / 1e3,
            "snapshot_age_ms": _percentiles(1e3 * ages),
            "snapshots": follower.received,
        }


def _samples(running: RunningSetup, client: Client, seconds: float) -> dict[str, Any]:
    """What the service did with the samples over some seconds, and its processor time."""
    process = psutil.Process(running.service.pid)
    first, before, begin = client.status(), sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    last, after, taken_s = client.status(), sum(process.cpu_times()[:2]), time.monotonic() - begin
    handled = last["seq"] - first["seq"]
    counts = last["samples"]
    return {
        "handled_hz": handled / taken_s,
        "cpu_us_per_sample": 1e6 * (after - before) / max(handled, 1),
        "learnt_share": (counts["learnt"] - first["samples"]["learnt"]) / max(handled, 1),
        **{name: counts[name] for name in ("received", "lost", "dropped", "late", "waiting")},
    }


def _reply(n: int, m: int, name: str) -> Trajectory:
    zeros = np.zeros(n)
    return Answer(zeros, zeros, np.zeros(n, dtype=np.uint8), np.zeros(m), 0, name)


def _in_turns(calls: dict[str, Callable[[], None]], rounds: int) -> dict[str, FloatArray]:
    """Wall time of each call, µs, (rounds,) each; the calls in turns."""
    taken = {name: np.empty(rounds) for name in calls}
    for i in range(-50, rounds):
        for name, call in calls.items():
            begin = time.perf_counter_ns()
            call()
            if i >= 0:
                taken[name][i] = (time.perf_counter_ns() - begin) / 1e3
    return taken


def _table(taken: dict[str, FloatArray]) -> dict[str, Any]:
    table: dict[str, Any] = {f"{name}_us": _percentiles(values) for name, values in taken.items()}
    for name in taken:
        if name != "echo":
            table[f"{name}_over_echo"] = {
                key: table[f"{name}_us"][key] / table["echo_us"][key] for key in table["echo_us"]
            }
    return table


def _percentiles(values: FloatArray) -> dict[str, float]:
    return {name: round(float(np.percentile(values, q)), 2) for name, q in (("p50", 50), ("p99", 99), ("p999", 99.9))}


def page(report: dict[str, Any]) -> str:
    """The report as tables."""
    how = "every sample is learnt" if report["learn_every"] == 1 else f"a window step every {report['learn_every']}"
    lines = [
        f"Round trips in µs beside a stage at {report['rate_hz']:g} Hz, {report['batch']} samples a message, window of "
        f"{WINDOW}; {how}",
        "",
        f"{'':>34}{'p50':>10}{'p99':>10}{'p99.9':>10}{'over the echo':>24}",
    ]
    titles = {
        "echo": "bare echo, same bytes",
        "service": "service, payload ready-made",
        "client": "client's call, numbers to numbers",
    }
    for name, row in report["queries"].items():
        lines.append(f"{name} ({row['payload_bytes']} bytes there, {row['reply_bytes']} back)")
        for which, title in titles.items():
            taken = row[f"{which}_us"]
            over = row.get(f"{which}_over_echo")
            ratio = "" if over is None else f"{over['p50']:.2f} {over['p99']:.2f} {over['p999']:.2f}"
            lines.append(f"{title:>34}{taken['p50']:>10.0f}{taken['p99']:>10.0f}{taken['p999']:>10.0f}{ratio:>24}")
    follower, samples, exact = report["follower"], report["samples"], report["exactness"]
    lines += [
        "",
        f"Followed model, in the caller's process: a point {follower['point_us']['p50']:.1f} µs (99 % within "
        f"{follower['point_us']['p99']:.1f}), {follower['point_cpu_us']:.1f} µs of processor; age of the snapshot "
        f"{follower['snapshot_age_ms']['p50']:.0f} ms (99 % within {follower['snapshot_age_ms']['p99']:.0f})",
        f"Samples: {samples['handled_hz']:.0f} a second handled at {samples['cpu_us_per_sample']:.0f} µs of processor "
        f"each; {samples['lost']} lost, {samples['dropped']} dropped, {samples['waiting']} waiting",
        f"Learnt exactly what the same samples teach off line: {_verdict(exact)} ({exact['sent']} sent, "
        f"{exact['handled']} handled, {exact['dropped']} dropped, {exact['lost']} lost)",
    ]
    return "\n".join(lines)


def _verdict(exact: dict[str, Any]) -> str:
    return "yes" if exact["learnt_exactly"] else f"NO, differing in {', '.join(exact['differs'])}"
