"""A freeze that was answered outlives the process: killed within 20 ms of the answer, or ended cleanly."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from dehyst.service.client.client import Client
from dehyst.service.operating.remote import operate
from dehyst.service.runtime.session import open_client, wait_followed
from tests.service.conftest import unused_port, write_config
from tests.service.living import Process, Stage, eventually, samples

Serve = Callable[..., Any]


def folders(tmp_path: Path, kept: str) -> str:
    text = f'recorder = "{tmp_path / "rec"}"\n' if "recorder" in kept else ""
    return text + (f'checkpoints = "{tmp_path / "ckpt"}"\ncheckpoint_s = 5.0\n' if "checkpoints" in kept else "")


def teach(session: zenoh.Session, client: Client, first: int, n: int) -> None:
    publisher = session.declare_publisher(client.keys.sample, congestion_control=zenoh.CongestionControl.BLOCK)
    # A new session sends nothing to a subscriber that it has not heard of yet.
    assert wait_followed(publisher, 5.0)
    for start in range(first, first + n, 20):
        publisher.put(samples(start, 20))
    eventually(lambda: client.status()["seq"] >= first + n - 1)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("kept", "verbs"),
    [("recorder checkpoints", ("freeze", "thaw", "freeze")), ("recorder", ("freeze",)), ("checkpoints", ("freeze",))],
)
def test_killed_within_20_ms_of_the_answer_it_starts_frozen(
    serve: Serve, tmp_path: Path, kept: str, verbs: tuple[str, ...]
) -> None:
    extra = folders(tmp_path, kept)
    first = 0
    for verb in verbs:
        frozen = verb == "freeze"
        process = serve(extra=extra)
        with (
            Client.connect(process.endpoint, axis="x", timeout_s=5.0) as client,
            open_client(process.endpoint) as stage,
        ):
            teach(stage, client, first, 600)
            first += 600
            answer = operate(stage, client.keys, verb, "alice")
            process.kill()
            assert answer["durable"] is True
        again = serve(extra=extra)
        with Client.connect(again.endpoint, axis="x", timeout_s=5.0) as client, open_client(again.endpoint) as stage:
            status = client.status()
            assert status["frozen"] is frozen
            teach(stage, client, first, 200)
            first += 200
            assert client.status()["frozen"] is frozen
            if frozen:
                assert client.status()["fingerprint"] == status["fingerprint"]
        again.kill()


@pytest.mark.e2e
def test_with_both_it_starts_with_the_same_model_to_the_last_bit(serve: Serve, tmp_path: Path) -> None:
    extra = folders(tmp_path, "recorder checkpoints")
    process = serve(extra=extra)
    with Client.connect(process.endpoint, axis="x", timeout_s=5.0) as client, open_client(process.endpoint) as stage:
        teach(stage, client, 0, 1000)
        operate(stage, client.keys, "freeze", "alice")
        process.kill()
        first = client
        del first
    before = json.loads((tmp_path / "rec" / "operations.jsonl").read_text().splitlines()[-1])
    assert (before["verb"], before["samples"]) == ("freeze", 1000)
    prints = []
    for _ in range(2):
        again = serve(extra=extra)
        with Client.connect(again.endpoint, axis="x", timeout_s=5.0) as client:
            prints.append(client.status()["fingerprint"])
        assert again.stop(signal.SIGTERM)[0] == 0
    assert prints[0] == prints[1]
    with Client.connect(serve(extra=extra).endpoint, axis="x", timeout_s=5.0) as client:
        assert client.status()["frozen"] is True


@pytest.mark.e2e
def test_a_standby_that_takes_over_within_20_ms_of_the_answer_is_frozen(tmp_path: Path) -> None:
    """It has not fetched the state that includes the freeze, and its own files are elsewhere, as on another host."""
    ports = [unused_port(), unused_port()]
    endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
    first_config, second_config = tmp_path / "one", tmp_path / "two"
    processes: list[Process] = []
    try:
        for folder, options in ((first_config, ()), (second_config, ("--standby",))):
            folder.mkdir()
            config = write_config(folder, ports[0], extra='recorder = "rec"\nserved = "lssvm_adaptive"\n')
            config.write_text(f'standby_listen = ["{endpoints[1]}"]\nlease_s = 0.6\n' + config.read_text())
            processes.append(Process("serve", "--config", str(config), *options))
        with (
            open_client(endpoints, 20.0) as session,
            Client.connect(endpoints, axis="x", timeout_s=0.5, wait_s=20.0, retry_s=10.0) as client,
            Stage(endpoints),
        ):
            eventually(lambda: client.status()["samples"]["learnt"] > 300)
            answer = operate(session, client.keys, "freeze", "alice")
            processes[0].kill()
            assert answer["standbys"] == 1
            status = eventually(lambda: (s := client.status())["instance"] == processes[1].ready["instance"] and s)
            assert status["frozen"] is True
            eventually(lambda: client.status()["seq"] > status["seq"] + 300)
            assert client.status()["fingerprint"] == status["fingerprint"]
            operate(session, client.keys, "thaw", "alice")
            assert client.status()["frozen"] is False
    finally:
        for process in processes:
            process.kill()
