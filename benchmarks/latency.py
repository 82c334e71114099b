"""Query round trips beside a bare zenoh echo of the same payloads, with learning on, and the cost of a follower.

Service, echo, stage and client are processes of their own on loopback. The client queries echo and service in turns,
so that other load on the machine affects both alike. Compare ratios across machines, not absolute times.

At the end the stage is stopped, and the model of the service is compared with that of an axis that learns the same
samples offline. Learning is deterministic sample by sample, however the samples were grouped on their way: both
fingerprints are the same, unless a sample was dropped, doubled or exchanged.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
from threadpoolctl import threadpool_limits

from benchmarks.sample_feed import AXIS, STAGE, sent
from dehyst.adaptive.types import FloatArray
from dehyst.lab.testbed.identified_stage import WINDOW, Rig, identify_stage, write_service_config
from dehyst.lab.testbed.processes import ECHO_KEY, Child, free_port
from dehyst.service.client.client import Client
from dehyst.service.config.settings import read_config
from dehyst.service.protocol.model import fingerprint
from dehyst.service.protocol.query import Answer, Trajectory, encode_query, encode_reply
from dehyst.service.protocol.samples import joined
from dehyst.service.runtime.session import open_client
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

TRAJECTORY: Final = 100
#: Range of the reference, µm. Limits of the axis.
RANGE_UM: Final = (4.0, 80.0)
LIMITS: Final = {"u_min_V": -2.0, "u_max_V": 10.0, "slew_V_per_s": 40000.0}
#: How long to wait for a process, s. Timeout of a query, s: on a busy machine answers are late, and that is measured.
CONNECT_S: Final = 90.0
_TIMEOUT_S: Final = 10.0
#: Messages that the offline axis gets at a time; a live service never groups them so.
_PORTION: Final = 37
#: Longest time until the queue of the service is empty, and until nothing more arrives, s.
_DRAIN_S, _STILL_S = 60.0, 5.0


@dataclass(frozen=True, slots=True)
class Setup:
    """What runs, and from which files.

    Attributes
    ----------
    folder : with the configuration, ``serve.toml``, and what the stage sends over and over, ``samples.npz``.
    rate_hz, batch : samples a second and a message. motion : (n,) each, a reference in µm, µm/s and µm/s².
    rig : the processes; the service listens at ``rig.endpoint``. echo_at : where a bare echo listens.
    """

    folder: Path
    rate_hz: float
    batch: int
    motion: tuple[FloatArray, FloatArray, FloatArray]
    rig: Rig
    echo_at: str

    def connected(self) -> Client:
        """A client of the service."""
        return Client.connect(self.rig.endpoint, STAGE, AXIS, timeout_s=_TIMEOUT_S, wait_s=CONNECT_S)


def latency(
    rate_hz: float = 1000.0, batch: int = 1, rounds: int = 4000, warm_s: float = 5.0, every_sample: bool = True
) -> dict[str, Any]:
    """Round trips in µs with a stage at ``rate_hz``, ``batch`` samples per message.

    ``every_sample``: filter and window learn each sample; otherwise at the learner's own rates.
    """
    with running(rate_hz, batch, every_sample) as setup, setup.connected() as client:
        time.sleep(warm_s)
        report = {"rate_hz": rate_hz, "batch": batch, "learn_every": 1 if every_sample else 10}
        report |= {"queries": _ask(setup, client, rounds), "follower": _follow(setup, min(rounds, 5000))}
        report |= {"samples": _samples(setup, client, 10.0 if rounds > 1000 else 2.0)}
        return report | {"exactness": _exactness(setup, client)}


@contextmanager
def running(rate_hz: float, batch: int, every_sample: bool) -> Iterator[Setup]:
    """Identify models, start the processes, and stop them at the end of the block. The stage already sends."""
    with tempfile.TemporaryDirectory() as name, Rig(Path(name)) as rig:
        folder = Path(name)
        stage_config = replace(preset("rich", seed=3), dt_s=1.0 / rate_hz)
        model = folder / "model.npz"
        found = identify_stage(stage_config, model, STAGE, AXIS, ("linear", "lssvm_adaptive"), "lssvm_adaptive")
        motion = demo_reference(30.0, 1.0 / rate_hz, RANGE_UM, 7)
        columns = (motion.y_um, motion.v_um_per_s, motion.a_um_per_s2)
        # The samples of a stage that the linear model drives along the reference.
        linear, stage = found.models["linear"], Stage(stage_config)
        drive_V = linear.feedforward(*columns, linear.rest_memory(0.0)).u_V.clip(LIMITS["u_min_V"], LIMITS["u_max_V"])
        np.savez(folder / "samples.npz", u_V=drive_V, y_um=stage.run(stage.initial_state(), drive_V)[0])
        learner = {"window": WINDOW} | ({"learn_every": 1, "filter_every": 1} if every_sample else {})
        # A re-tuning ends at a time that depends on the machine.
        axis = {"name": AXIS, "model": model, **LIMITS, "retuning": {"period_s": 0.0}, "learner": learner}
        write_service_config(folder / "serve.toml", STAGE, axis, listen=[rig.endpoint])
        setup = Setup(folder, rate_hz, batch, columns, rig, f"tcp/127.0.0.1:{free_port()}")
        rig.start_service(folder / "serve.toml")
        rig.start_echo(setup.echo_at)
        order = [rig.endpoint, str(folder / "samples.npz"), str(rate_hz), str(batch)]
        rig.start("feed", ["-m", "benchmarks.sample_feed", *order])
        yield setup


def _ask(setup: Setup, client: Client, rounds: int) -> dict[str, Any]:
    """Service and echo in turns: one point, and a trajectory."""
    y, v, a = setup.motion
    with open_client(setup.echo_at, CONNECT_S) as session:
        first = client.point(float(y[0]))
        report = {}
        for name, n in (("point", 1), (f"trajectory_{TRAJECTORY}", TRAJECTORY)):
            payload = encode_query(y[:n], v[:n], a[:n], memory=first.memory, u_before_V=first.u_V)
            reply_bytes = len(encode_reply(_reply(n, first.memory.size, first.model)))
            queriers = {
                "echo": session.declare_querier(f"{ECHO_KEY}/{reply_bytes}", timeout=_TIMEOUT_S, express=True),
                "service": client._session.declare_querier(client.keys.feedforward, timeout=_TIMEOUT_S, express=True),
            }

            def asker(querier: Any, payload: bytes = payload) -> Callable[[], None]:
                def ask() -> None:
                    for got in querier.get(payload=payload):
                        got.ok.payload.to_bytes()

                return ask

            def call(n: int = n) -> None:
                if n == 1:
                    client.point(float(y[0]), float(v[0]), float(a[0]), after=first)
                else:
                    client.trajectory(y[:n], v[:n], a[:n], after=first)

            calls = {which: asker(querier) for which, querier in queriers.items()} | {"client": call}
            report[name] = {"payload_bytes": len(payload), "reply_bytes": reply_bytes}
            report[name] |= _table(_in_turns(calls, rounds))
            for querier in queriers.values():
                querier.undeclare()
        return report


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
    for name in ("service", "client"):
        table[f"{name}_over_echo"] = {q: table[f"{name}_us"][q] / echo for q, echo in table["echo_us"].items()}
    return table


def _percentiles(values: FloatArray) -> dict[str, float]:
    return {name: round(float(np.percentile(values, q)), 2) for name, q in (("p50", 50), ("p99", 99), ("p999", 99.9))}


def _follow(setup: Setup, points: int) -> dict[str, Any]:
    """Cost of a point in the client's own process, and the age of its model."""
    y, v, a = (column.tolist() for column in setup.motion)
    with setup.connected() as client:
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


def _samples(setup: Setup, client: Client, seconds: float) -> dict[str, Any]:
    """What the service did with the samples over some seconds, and its processor time."""
    process = psutil.Process(_child(setup, "serve").pid)
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


def _child(setup: Setup, name: str) -> Child:
    return setup.rig.children[name]


# --- Whether the service has learnt exactly what its samples teach.


def _exactness(setup: Setup, client: Client) -> dict[str, Any]:
    """Stop the stage, let the service handle its queue, and compare the models; counts and verdict for JSON."""
    feed = _child(setup, "feed")
    feed.stop()
    count = int(feed.last_json()["sent"])
    status = _drained(client, count)
    axis = taught(setup.folder, setup.rate_hz, setup.batch, count)
    offline = fingerprint(axis.newest.models[axis.config.learn])
    samples = status["samples"]
    return {
        "learnt_exactly": status["fingerprint"] == offline, "sent": count, "handled": samples["received"],
        **{name: samples[name] for name in ("learnt", "dropped", "lost", "late", "waiting")},
    }  # fmt: skip


def taught(folder: Path, rate_hz: float, batch: int, count: int, portion: int = _PORTION) -> Axis:
    """An axis of the configuration in ``folder`` that learns the first ``count`` samples of the stage offline.

    ``portion`` : messages that it gets at a time.
    """
    with np.load(folder / "samples.npz") as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    # One BLAS thread as in the service: more may sum in another order.
    with threadpool_limits(1):
        axis = load_axis(STAGE, read_config(folder / "serve.toml").axes[0])
        messages = count // batch
        for first in range(0, messages, portion):
            part = range(first, min(first + portion, messages))
            axis.handle(joined([sent(u_V, y_um, rate_hz, batch, k) for k in part]))
    return axis


def _drained(client: Client, count: int) -> dict[str, Any]:
    """The status when all ``count`` samples are handled, or when nothing changes any more."""
    until = time.monotonic() + _DRAIN_S
    seq, still_since = -2, time.monotonic()
    while True:
        status, now = client.status(), time.monotonic()
        if status["seq"] != seq or status["samples"]["waiting"]:
            seq, still_since = status["seq"], now
        done = seq >= count - 1 and not status["samples"]["waiting"]
        if done or now - still_since >= _STILL_S or now >= until:
            return status
        time.sleep(0.05)


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
        f"Learnt exactly what the same samples teach off line: {'yes' if exact['learnt_exactly'] else 'NO'} "
        f"({exact['sent']} sent, {exact['handled']} handled, {exact['dropped']} dropped, {exact['lost']} lost)",
    ]
    return "\n".join(lines)
