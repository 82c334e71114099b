"""Query round trips beside a bare zenoh echo of the same payloads, with learning on; and what a follower costs.

Service, echo, stage and asker are processes of their own over loopback. The asker takes echo and service in turns, so
that whatever else the machine does meets both alike: the ratios travel, the times do not.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from adaptive.types import FloatArray
from benchmarks.latency_processes import AXIS, ECHO_KEY, STAGE
from service.client import Client
from service.demo.processes import Child, Children, free_port
from service.identifying import identify_one
from service.modelfile import BundleMeta, write_bundle
from service.session import open_client
from service.wire_query import FeedforwardReply, encode_query, encode_reply
from sim.presets import preset
from sim.reference import demo_reference
from sim.signals import training_input
from sim.stage import Stage

LOW_UM, HIGH_UM = 4.0, 80.0
WINDOW = 500
TRAJECTORY = 100
_READY_S = 60.0


def latency(
    rate_hz: float = 1000.0, batch: int = 1, rounds: int = 4000, warm_s: float = 5.0, every_sample: bool = True
) -> dict[str, Any]:
    """Round trips in µs with a stage at ``rate_hz``, ``batch`` samples a message.

    ``every_sample``: each sample is learnt by filter and window; otherwise with the learner's own steps.
    """
    with _world(rate_hz, batch, every_sample) as world:
        time.sleep(warm_s)
        report = {"rate_hz": rate_hz, "batch": batch, "learn_every": 1 if every_sample else 10}
        report |= {"queries": world.ask(rounds), "follower": world.follow(min(rounds, 5000))}
        return report | {"samples": world.samples(10.0 if rounds > 1000 else 2.0)}


class _World:
    def __init__(self, service: Child, echo_at: str, serve_at: str, motion: tuple[FloatArray, ...]) -> None:
        self.service, self.echo_at, self.serve_at, self.motion = service, echo_at, serve_at, motion

    def ask(self, rounds: int) -> dict[str, Any]:
        """Service and echo in turns: one point, and a trajectory."""
        y, v, a = self.motion
        with (
            Client.connect(self.serve_at, STAGE, AXIS, wait_s=_READY_S) as client,
            open_client(self.echo_at, _READY_S) as session,
        ):
            first = client.point(float(y[0]))
            report = {}
            for name, n in (("point", 1), (f"trajectory_{TRAJECTORY}", TRAJECTORY)):
                payload = encode_query(y[:n], v[:n], a[:n], memory=first.memory, u_before_V=first.u_V)
                reply_bytes = len(encode_reply(_reply(n, first.memory.size, first.model)))
                querier = session.declare_querier(f"{ECHO_KEY}/{reply_bytes}", timeout=1.0, express=True)
                raw = client._session.declare_querier(client.keys.feedforward, timeout=1.0, express=True)

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

    def follow(self, points: int) -> dict[str, Any]:
        """What a point costs in the caller's own process, and how old its model is."""
        y, v, a = (column.tolist() for column in self.motion)
        with Client.connect(self.serve_at, STAGE, AXIS, wait_s=_READY_S) as client:
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

    def samples(self, seconds: float) -> dict[str, Any]:
        """What the service made of the samples over some seconds, and what it cost it."""
        process = psutil.Process(self.service.pid)
        with Client.connect(self.serve_at, STAGE, AXIS, wait_s=_READY_S) as client:
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


def _reply(n: int, m: int, name: str) -> FeedforwardReply:
    zeros = np.zeros(n)
    return FeedforwardReply(zeros, zeros, np.zeros(n, dtype=np.uint8), np.zeros(m), 0, name)


def _in_turns(calls: dict[str, Callable[[], None]], rounds: int) -> dict[str, FloatArray]:
    """Wall time of each call, µs, (rounds,) each; one of each in turn."""
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


@contextmanager
def _world(rate_hz: float, batch: int, every_sample: bool) -> Iterator[_World]:
    dt_s = 1.0 / rate_hz
    stage = Stage(replace(preset("rich", seed=3), dt_s=dt_s))
    u_V = training_input(dt_s, 10.0)[1]
    y_um, _ = stage.run(stage.initial_state(), u_V)
    # Beyond 1 kHz the identification sees every sample too: some tens of thousands, of which it picks its support.
    names = ("linear", "lssvm_adaptive")
    models = {name: identify_one(name, u_V, y_um, dt_s, WINDOW) for name in names}
    meta = BundleMeta(STAGE, AXIS, dt_s, y_min_um=float(y_um.min()), y_max_um=float(y_um.max()))
    motion = demo_reference(30.0, dt_s, (LOW_UM, HIGH_UM), 7)
    with tempfile.TemporaryDirectory() as folder, Children(Path(folder)) as children:
        path = Path(folder)
        write_bundle(path / "model.npz", models, meta)
        # The samples of a stage that is driven by what the linear model makes of the reference.
        line = models["linear"]
        drive = line.feedforward(motion.y_um, motion.v_um_per_s, motion.a_um_per_s2, line.rest_memory(0.0)).u_V.clip(
            -2.0, 10.0
        )
        read_um, _ = stage.run(stage.initial_state(), drive)
        np.savez(path / "samples.npz", u_V=drive, y_um=read_um)
        serve_at, echo_at = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        text = (
            f'stage = "{STAGE}"\nlisten = ["{serve_at}"]\n[[axis]]\nname = "{AXIS}"\nmodel = "model.npz"\n'
            "u_min_V = -2.0\nu_max_V = 10.0\nslew_V_per_s = 40000.0\n[axis.learner]\n"
            f"window = {WINDOW}\n" + ("learn_every = 1\nfilter_every = 1\n" if every_sample else "")
        )
        (path / "serve.toml").write_text(text, encoding="utf-8")
        service = children.start(
            "serve", ["-m", "service.cli", "serve", "--config", str(path / "serve.toml"), "--json"]
        )
        service.wait_line("{", _READY_S)
        processes = "benchmarks.latency_processes"
        children.start("echo", ["-m", processes, "echo", echo_at]).wait_line("ready", _READY_S)
        feed = ["-m", processes, "feed", serve_at, str(path / "samples.npz"), str(rate_hz), str(batch)]
        children.start("feed", feed).wait_line("ready", _READY_S)
        columns = (motion.y_um, motion.v_um_per_s, motion.a_um_per_s2)
        yield _World(service, echo_at, serve_at, columns)


def page(report: dict[str, Any]) -> str:
    """The report as tables to read."""
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
    follower, samples = report["follower"], report["samples"]
    lines += [
        "",
        f"Followed model, in the caller's process: a point {follower['point_us']['p50']:.1f} µs (99 % within "
        f"{follower['point_us']['p99']:.1f}), {follower['point_cpu_us']:.1f} µs of processor; age of the snapshot "
        f"{follower['snapshot_age_ms']['p50']:.0f} ms (99 % within {follower['snapshot_age_ms']['p99']:.0f})",
        f"Samples: {samples['handled_hz']:.0f} a second handled at {samples['cpu_us_per_sample']:.0f} µs of processor "
        f"each; {samples['lost']} lost, {samples['dropped']} dropped, {samples['waiting']} waiting",
    ]
    return "\n".join(lines)
