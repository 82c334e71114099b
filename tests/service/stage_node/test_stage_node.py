"""The stage as a process: no sample lost, commands honoured in order, twins equal, ticks counted honestly."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import SURELY, open_client, wait_followed
from dehyst.service.stage_node.exchange import MAX_MESSAGE, RING_SIZE, SampleRing, Sender
from dehyst.service.stage_node.faults import fault_key
from dehyst.service.stage_node.node import status_key
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.service.conftest import unused_port
from tests.service.living import Process, eventually

ROOT = Path(__file__).resolve().parents[3]


@contextmanager
def stage_process(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    stage = Process("stage", "--listen", endpoint, "--name", "t", *options)
    try:
        yield stage.process, endpoint
    finally:
        stage.kill()


def summary_of(process: subprocess.Popen[str]) -> dict[str, object]:
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    loaded: dict[str, object] = json.loads(said.splitlines()[-1])
    return loaded


class Collector:
    """Every sample that arrives under an axis, in the order of arrival."""

    def __init__(self, session: object, axis: str) -> None:
        self.batches: list[wire.SampleBatch] = []
        self.subscriber = session.declare_subscriber(  # type: ignore[attr-defined]
            Keys("t", axis).sample, lambda sample: self.batches.append(wire.decode_samples(sample.payload.to_bytes()))
        )

    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        batches = list(self.batches)
        names = ("seq", "t_s", "u_V", "y_um")
        return tuple(np.concatenate([getattr(b, name) for b in batches]) for name in names)  # type: ignore[return-value]


@pytest.mark.e2e
def test_no_sample_is_lost_and_commands_are_honoured_in_order() -> None:
    n, block = 2500, 20
    t_s = np.arange(n) * 0.001
    voltages = {"x": 4.0 - 4.0 * np.cos(12.0 * t_s), "a": 4.0 - 4.0 * np.cos(12.0 * t_s), "b": 12.0 * t_s - 3.0}
    options = ("--twins", "a,b", "--duration", "2.5", "--seed", "5", "--batch", "7")
    with stage_process(*options) as (process, endpoint):
        session = open_client(endpoint, wait_s=5.0)
        try:
            collectors = {axis: Collector(session, axis) for axis in voltages}
            started = threading.Event()
            watch = session.declare_subscriber(Keys("t", "x").sample, lambda _: started.set())
            time.sleep(0.1)
            assert not started.is_set(), "the clock starts with the first commands, not before"
            # The first blocks are ahead by two seconds, so that no slow machine can make a command late.
            sent = 0
            while sent < n:
                for axis, values in voltages.items():
                    session.put(
                        Keys("t", axis).command,
                        wire.encode_command(sent, values[sent : sent + block]),
                        congestion_control=SURELY,
                    )
                sent += block
                if sent >= 2000:
                    assert started.wait(30.0)
                    time.sleep(0.9 * block * 0.001)
            summary = summary_of(process)
            eventually(lambda: all(sum(map(len, c.batches)) == n for c in collectors.values()))
            watch.undeclare()
            received = {axis: collector.columns() for axis, collector in collectors.items()}
        finally:
            session.close()
    units = summary["units"]
    assert isinstance(units, dict)
    for axis, (seq, t, u_V, _) in received.items():
        np.testing.assert_array_equal(seq, np.arange(n))
        np.testing.assert_array_equal(t, np.arange(n) * 0.001)
        counts = units[axis]["commands"]
        assert units[axis]["published"] == n
        assert counts["voltages"] == n
        assert (counts["late"], counts["missing"], counts["refused"]) == (0, 0, 0)
        np.testing.assert_array_equal(u_V, np.clip(voltages[axis], -2.0, 10.0))
    # The samples are those of the library, noise included, and twins with equal commands are equal.
    stage = Stage(preset("rich", seed=5))
    for axis in voltages:
        expected, _ = stage.run(stage.initial_state(), np.asarray(voltages[axis], dtype=np.float64))
        np.testing.assert_array_equal(received[axis][3], expected)
    assert not np.array_equal(received["x"][3], received["b"][3])


@pytest.mark.e2e
def test_free_run_holds_missing_commands_and_stops_cleanly_on_interrupt() -> None:
    with stage_process("--free-run", "--batch", "10", "--change", "0.2:gain_drift.gain=-0.06") as (process, endpoint):
        session = open_client(endpoint, wait_s=5.0)
        try:
            collector = Collector(session, "x")
            states: list[dict[str, object]] = []
            status = session.declare_subscriber(
                status_key("t", "x"), lambda sample: states.append(json.loads(sample.payload.to_bytes()))
            )
            eventually(lambda: collector.batches)
            now = int(collector.batches[-1].seq[-1])
            session.put(Keys("t", "x").command, wire.encode_command(0, np.full(10, 9.0)), congestion_control=SURELY)
            session.put(
                Keys("t", "x").command, wire.encode_command(now + 1500, np.full(5, 3.0)), congestion_control=SURELY
            )
            session.put(Keys("t", "x").command, b"nonsense", congestion_control=SURELY)
            session.put(Keys("t", "x").command, wire.encode_command(now + 10_000_000, [1.0]), congestion_control=SURELY)
            eventually(lambda: states and collector.batches[-1].seq[-1] >= now + 1700)
            process.send_signal(signal.SIGINT)
            summary = summary_of(process)
            status.undeclare()
            seq, _, u_V, _ = collector.columns()
        finally:
            session.close()
    assert states[0]["state"] == "running"
    assert np.all(np.diff(seq) == 1)
    expected = np.where(seq < now + 1500, 0.0, 3.0)
    np.testing.assert_array_equal(u_V, expected)
    units = summary["units"]
    assert isinstance(units, dict)
    counts = units["x"]["commands"]
    assert (counts["late"], counts["refused"]) == (10, 2)
    assert counts["missing"] > 100
    assert "seq" in units["x"]["error"]
    assert summary["state"] == "stopped"


@pytest.mark.e2e
def test_both_axes_are_driven_hurt_on_command_and_count_from_where_they_are_told() -> None:
    first, n, limit_V = 5_000_000, 1500, 0.02
    voltages = {"x": np.full(n, 3.0), "y": 1.5 - 1.5 * np.cos(0.012 * np.arange(n))}
    options = ("--axis2", "y", "--first", str(first), "--slew", str(limit_V / 1e-3), "--inject", "--duration", "1.5")
    with stage_process(*options, "--seed", "5", "--batch", "5") as (process, endpoint):
        session = open_client(endpoint, wait_s=5.0)
        try:
            collectors = {axis: Collector(session, axis) for axis in voltages}
            faults = session.declare_publisher(fault_key("t", "y"), congestion_control=SURELY)
            assert wait_followed(faults, 20.0)
            faults.put(b'{"fault": "gap", "duration_s": 0.1}')
            faults.put(b'{"fault": "fire"}')
            for axis, values in voltages.items():
                session.put(Keys("t", axis).command, wire.encode_command(first, values), congestion_control=SURELY)
            summary = summary_of(process)
            eventually(lambda: sum(map(len, collectors["y"].batches)) == n - 100)
            received = {axis: collector.columns() for axis, collector in collectors.items()}
        finally:
            session.close()
    numbers = np.arange(first, first + n)
    np.testing.assert_array_equal(received["x"][0], numbers)
    # The fault may begin a few samples after the first voltage has come.
    kept = np.isin(numbers, received["y"][0])
    gap = np.flatnonzero(~kept)
    assert (gap.size, gap[-1] - gap[0]) == (100, 99)
    assert gap[0] < 100
    # 3 V are reached in steps of the slew limit; the second axis stays below it.
    expected = np.minimum(3.0, limit_V * np.arange(1, n + 1))
    np.testing.assert_allclose(received["x"][2], expected, rtol=1e-6)
    np.testing.assert_array_equal(received["y"][2], voltages["y"][kept])
    stage = Stage(preset("rich", seed=5))
    y_um, y2_um = stage.run(stage.initial_state(), received["x"][2], voltages["y"])
    np.testing.assert_array_equal(received["x"][3], y_um)
    np.testing.assert_array_equal(received["y"][3], y2_um[kept])
    units = summary["units"]
    assert isinstance(units, dict)
    assert units["x"]["slew_limited"] == 149
    assert units["y"]["slew_limited"] == 0
    assert units["y"]["published"] == n - 100
    assert (units["y"]["faults"]["gap"], units["y"]["faults"]["refused"]) == (100, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--preset", "poor"), "preset: got 'poor'"),
        (("--rate", "0"), "--rate: got 0"),
        (("--batch", "0"), "batch: got 0"),
        (("--twins", "x"), "units: got x, x"),
        (("--axis", "X/y"), "axis: got 'X/y'"),
        (("--change", "soon"), "--change: got 'soon'"),
        (("--change", "1:gain_drift.nothing=1"), "nothing"),
        (("--duration", "-1"), "--duration: got -1"),
        (("--axis2", "x"), "second: got x"),
        (("--preset", "bouc_wen", "--axis2", "y"), "has one axis"),
        (("--slew", "0"), "slew_V_per_s: got 0"),
        (("--first", "-4"), "first: got -4"),
        (("--endpoint", "tcp/127.0.0.1:1", "--wait", "0"), "no answer at"),
    ],
)
def test_bad_options_get_a_message_and_status_2(
    options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from dehyst.lab.cli import main

    assert main(["stage", *options]) == 2
    assert message in capsys.readouterr().err


def test_a_wire_that_stands_still_holds_up_nobody_and_its_losses_are_counted() -> None:
    sent: list[wire.SampleBatch] = []
    flowing = threading.Event()

    def put(*columns: np.ndarray) -> None:
        flowing.wait(10.0)
        sent.append(wire.SampleBatch(*columns))

    ring = SampleRing(put)
    sender = Sender([ring])
    ring.write(0, 0.0, 0.0, 0.0)
    sender.wake()
    start = time.monotonic()
    n = RING_SIZE + 5000
    for k in range(1, n):
        ring.write(k, 1e-3 * k, float(k), -float(k))
        sender.wake()
    assert time.monotonic() - start < 5.0
    flowing.set()
    assert sender.close()
    seq = np.concatenate([batch.seq for batch in sent])
    u_V = np.concatenate([batch.u_V for batch in sent])
    np.testing.assert_array_equal(u_V, seq.astype(np.float64))
    assert np.all(np.diff(seq) >= 1)
    assert seq[-1] == n - 1
    assert ring.published == len(seq)
    assert ring.lost == n - len(seq)
    assert 5000 <= ring.lost <= 5000 + 2 * MAX_MESSAGE
    assert max(len(batch) for batch in sent) <= MAX_MESSAGE


def test_a_simulated_stage_loads_no_diagnosis_and_no_large_part_of_scipy() -> None:
    """The files of effects hold their forms and direct tests as well; a stage must not wait for what those call."""
    code = (
        "import sys; import dehyst.service.stage_node.node, dehyst.sim.stage.presets; "
        "heavy = [f'scipy.{part}' for part in ('optimize', 'stats', 'signal', 'interpolate')]; "
        "heavy += [f'dehyst.sim.{part}' for part in ('diagnosis', 'recordings', 'readings.readings')]; "
        "found = set(heavy) & sys.modules.keys(); "
        "assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
