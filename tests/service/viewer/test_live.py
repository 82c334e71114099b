"""``dehyst view`` as a process: real zenoh on loopback in, an .rrd out."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.lab.cli import main
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_service
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.viewer.consumer import Consumer, ConsumerConfig
from dehyst.service.viewer.records import Diagnostics, Event, Health, Record, Status, Tracking
from tests.service.conftest import unused_port
from tests.service.living import eventually
from tests.service.viewer.test_sink import read_back

DT_S = 1e-3
BATCH = 20


class Basket:
    """An output that keeps what it is offered, or refuses all of it."""

    def __init__(self, full: bool = False) -> None:
        self.full, self.dropped, self.records = full, 0, list[Record]()

    def offer(self, batch: Sequence[Record]) -> bool:
        if self.full:
            self.dropped += 1
            return False
        self.records += batch
        return True

    def of(self, kind: type[Any]) -> list[Any]:
        return [record for record in self.records if isinstance(record, kind)]


def motion(k: Any) -> Any:
    return 40.0 + 30.0 * np.sin(2 * np.pi * k * DT_S)


class Feed:
    """Stage, controller and service in one: publishes what they would, with the wire's own formats."""

    def __init__(self, session: Any, stage: str, errors_um: dict[str, float]) -> None:
        self._put, self._by = session.put, own_authenticator()
        self.stage, self.errors_um = stage, errors_um
        self.sent = 0

    def wait_until_heard(self, session: Any) -> None:
        """What is published before another process's subscription has made its way here goes to nobody."""
        for unit in self.errors_um:
            publisher = session.declare_publisher(Keys(self.stage, unit).sample)
            eventually(lambda publisher=publisher: publisher.matching_status.matching)
            publisher.undeclare()

    def send(self, n: int, axis: str = "x") -> None:
        """``n`` samples of every unit, references ahead of them, diagnostics and status with them."""
        k = np.arange(self.sent, self.sent + n)
        self._put(Keys(self.stage, axis).reference, wire.encode_reference(int(k[0]), motion(k)))
        for unit, error_um in self.errors_um.items():
            payload = wire.encode_samples(k, k * DT_S, motion(k) / 11.0, motion(k) - error_um)
            self._put(Keys(self.stage, unit).sample, payload)
        self.say("diagnostics", {"seq": int(k[-1]), "t_s": float(k[-1] * DT_S), "gain": 0.94, "std_V": 0.02}, axis)
        self.sent += n

    def say(self, what: str, fields: Any, axis: str = "x") -> None:
        payload, key = fields if isinstance(fields, bytes) else json.dumps(fields).encode(), Keys(self.stage, axis)
        signed = self._by.published(key.status, payload) if what == "status" else None
        self._put(getattr(key, what), payload, attachment=signed)


def test_the_consumer_joins_units_and_counts_what_it_cannot_read() -> None:
    basket = Basket()
    config = ConsumerConfig("demo", "x", twins=(("x_linear", "linear"),), batch_s=0.05)
    with open_service([f"tcp/127.0.0.1:{unused_port()}"]) as session:
        feed = Feed(session, "demo", {"x": 0.05, "x_linear": -2.0})
        consumer = Consumer(session, config, [basket])
        try:
            for _ in range(50):
                feed.send(BATCH)
            # An event is placed by the times of the samples that have come.
            eventually(lambda: len(basket.of(Diagnostics)) == 50)
            feed.say("event", {"seq": 500, "event": "drift", "detail": "gain 0.94"})
            feed.say("status", {"stage": "demo"})
            session.put(Keys("demo", "x").status, b'{"stage": "a stranger"}', attachment=bytes(32))
            feed.say("sample", b"nonsense")
            feed.say("reference", b"")
            feed.say("diagnostics", b"\xff{")
            feed.say("diagnostics", [1, 2])
            feed.say("status", b"[" * 100_000)
            eventually(lambda: consumer.counts["malformed"] == 5)
            feed.send(BATCH)
            # Its last message is the diagnostics; what is under way at the close is not promised.
            eventually(lambda: len(basket.of(Diagnostics)) == 51)
            # Of a sample that has not come yet, and of one that comes in another life of the stage if at all.
            feed.say("event", {"seq": 51 * BATCH + 100, "event": "gap", "detail": "ahead"})
            feed.say("event", {"seq": 10**9, "event": "gap", "detail": "far"})
            eventually(lambda: len(basket.of(Event)) == 3)
        finally:
            consumer.close()
            consumer.close()
    for model, error_um in (("lssvm_adaptive", 0.05), ("linear", -2.0)):
        parts = [t for t in basket.of(Tracking) if t.model == model]
        seq = np.concatenate([t.seq for t in parts])
        assert seq.tolist() == list(range(51 * BATCH)), "nothing lost, nothing twice, in order"
        error = np.concatenate([t.reference_um - t.y_um for t in parts])
        assert error == pytest.approx(np.full(51 * BATCH, error_um))
    assert len(basket.of(Diagnostics)) == 51
    assert [s.fields for s in basket.of(Status)] == [{"stage": "demo"}]
    assert consumer.counts["unsigned"] == 1
    event, ahead, far = basket.of(Event)
    assert (event.seq, event.text, event.level) == (500, "drift: gain 0.94", "WARN")
    assert event.t_s == pytest.approx(0.5), "told by its sequence number"
    assert ahead.t_s == pytest.approx((51 * BATCH + 100) * DT_S)
    assert far.t_s == pytest.approx((51 * BATCH - 1) * DT_S)
    last = basket.of(Health)[-1].fields
    assert (last["samples"], last["malformed"], last.get("inbox_full", 0)) == (2 * 51 * BATCH, 5, 0)


def test_a_change_that_is_announced_comes_before_its_samples() -> None:
    basket = Basket()
    with open_service([f"tcp/127.0.0.1:{unused_port()}"]) as session:
        feed = Feed(session, "demo", {"x": 0.05})
        consumer = Consumer(session, ConsumerConfig("demo", "x", changes_s=(0.3, 99.0), batch_s=0.05), [basket])
        for _ in range(25):
            feed.send(BATCH)
            time.sleep(0.01)
        eventually(lambda: basket.of(Event))
        consumer.close()
    (event,) = basket.of(Event)
    assert (event.t_s, event.seq, event.change) == (0.3, 300, True)
    before = basket.records[: basket.records.index(event)]
    assert max((t.t_s[-1] for t in before if isinstance(t, Tracking)), default=0.0) < 0.3


def test_a_full_inbox_drops_and_counts() -> None:
    basket = Basket()
    with open_service([f"tcp/127.0.0.1:{unused_port()}"]) as session:
        feed = Feed(session, "demo", {"x": 0.05})
        consumer = Consumer(session, ConsumerConfig("demo", "x", batch_s=5.0, inbox=10), [basket])
        for _ in range(20):
            feed.send(BATCH)
        eventually(lambda: consumer.counts["messages"] == 60)
        consumer.close()
    assert consumer.counts["inbox_full"] == 50
    assert consumer.counts["messages"] == 60


def drawn(path: Path) -> int:
    """Samples in a file that is still being written, whose last chunk may be a part of one."""
    try:
        return len(read_back(path)[0]["error_um/linear"])
    except (KeyError, OSError, RuntimeError, ValueError):
        return 0


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_the_process_writes_a_recording_that_reads_back(tmp_path: Path) -> None:
    endpoint, path = f"tcp/127.0.0.1:{unused_port()}", tmp_path / "live.rrd"
    with open_service([endpoint]) as session:
        command = [
            sys.executable, "-m", "dehyst.lab.cli", "view", "--endpoint", endpoint, "--stage", "demo", "--axis", "x",
            "--twin", "x_linear=linear", "--rrd", str(path), "--range-um", "60", "--json",
        ]  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            ready = process.stdout.readline()
            assert ready.startswith(f"viewing demo/x at {endpoint} into"), process.communicate(timeout=10)
            feed = Feed(session, "demo", {"x": 0.06, "x_linear": -3.0})
            feed.wait_until_heard(session)
            for k in range(60):
                feed.send(BATCH)
                if k == 30:
                    feed.say("event", {"event": "change", "detail": "gain −6 %", "t_s": 0.6, "seq": 600})
                time.sleep(0.01)
            try:
                eventually(lambda: drawn(path) == 60 * BATCH)
            finally:
                process.send_signal(signal.SIGINT)
                out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    told = json.loads(out.strip().splitlines()[-1])
    assert told["complete"] is True
    assert told["counts"]["samples"] == 2 * 60 * BATCH
    curves, others, reader = read_back(path)
    assert len(reader.blueprints()) == 1
    k = np.arange(60 * BATCH)
    for model, error_um in (("lssvm_adaptive", 0.06), ("linear", -3.0)):
        got = curves[f"error_um/{model}"]
        assert got[:, 1].tolist() == k.tolist()
        assert got[:, 0] == pytest.approx(k * DT_S, abs=1e-8)
        assert got[:, 2] == pytest.approx(np.full(len(k), error_um))
        assert curves[f"mean_error_pct/{model}"][:, 2] == pytest.approx(abs(error_um) / 0.6)
    assert curves["displacement/reference_um"][:, 2] == pytest.approx(motion(k))
    assert curves["drift/gain"][:, 2].tolist() == [0.94] * 60
    assert others["events:TextLog:text"] == [["0.600 s  change: gain −6 %"]]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "got none of them"),
        (["--rrd", "x.rrd", "--twin", "x_linear"], "twin: got 'x_linear', expected NAME=MODEL"),
        (["--rrd", "x.rrd", "--axis", "X"], "axis"),
        (["--connect", "--spawn"], "connect, spawn: got 2 of them"),
        (["--spawn", "--web"], "spawn, web: got 2 of them"),
        (["--rrd", "x.rrd", "--batch", "60"], "batch_s: got 60.0, expected 0.05 to 5 s"),
        (["--rrd", "x.rrd", "--endpoint", "tcp/127.0.0.1:1", "--wait", "0.1"], "no answer at"),
    ],
)
def test_what_cannot_be_done_is_said_and_ends_with_a_status(
    options: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["view", *options]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
