"""A freeze that was answered outlives the process: killed within 20 ms of the answer, or ended cleanly."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from service.client.client import Client
from service.operating.remote import operate
from service.runtime.session import open_client
from tests.service.living import eventually, samples

Serve = Callable[..., Any]


def folders(tmp_path: Path, kept: str) -> str:
    text = f'recorder = "{tmp_path / "rec"}"\n' if "recorder" in kept else ""
    return text + (f'checkpoints = "{tmp_path / "ckpt"}"\ncheckpoint_s = 5.0\n' if "checkpoints" in kept else "")


def teach(session: zenoh.Session, client: Client, first: int, n: int) -> None:
    for start in range(first, first + n, 20):
        session.put(client.keys.sample, samples(start, 20), congestion_control=zenoh.CongestionControl.BLOCK)
    eventually(lambda: client.status()["seq"] >= first + n - 1)


@pytest.mark.e2e
@pytest.mark.parametrize("kept", ["recorder checkpoints", "recorder", "checkpoints"])
def test_killed_within_20_ms_of_the_answer_it_starts_frozen(serve: Serve, tmp_path: Path, kept: str) -> None:
    extra = folders(tmp_path, kept)
    first = 0
    for verb, frozen in (("freeze", True), ("thaw", False), ("freeze", True)):
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
        time.sleep(0.1)
    assert prints[0] == prints[1]
    with Client.connect(serve(extra=extra).endpoint, axis="x", timeout_s=5.0) as client:
        assert client.status()["frozen"] is True
