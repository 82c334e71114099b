"""One controller at a time: real processes and sessions around a real service and a real stage."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from dehyst.service.client.client import Client
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import CommandHeldError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import SURELY, open_client, open_service, wait_followed
from dehyst.service.security.authenticator import NO_KEY, Authenticator, own_authenticator
from dehyst.service.security.lease import CommandGate, CommandLease
from dehyst.service.security.tokens import Holder
from dehyst.service.stage_node.node import status_key
from tests.service.conftest import ServeProcess
from tests.service.living import Process, eventually

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).resolve().parents[3]
KEYS = Keys("demo", "x")
#: A controller that commands a voltage for the 200 samples after the newest, again and again.
CONTROLLER = """
import json, sys, time
from dehyst.service.client.client import Client
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import CommandHeldError
newest = [-1]
with Client.connect(sys.argv[1], timeout_s=5.0, wait_s=10.0) as client:
    client._session.declare_subscriber(
        client.keys.sample, lambda s: newest.__setitem__(0, int(wire.decode_samples(s.payload.to_bytes()).seq[-1]))
    )
    try:
        said = False
        while True:
            client.command(newest[0] + 20, [float(sys.argv[2])] * 200)
            if not said:
                print("commands", flush=True)
            said = True
            time.sleep(0.01)
    except CommandHeldError as error:
        print(error, flush=True)
"""


class Stage:
    """A stage that runs free beside the service, what it applied, and what it says."""

    def __init__(self, endpoint: str) -> None:
        self.process = Process("stage", "--endpoint", endpoint, "--free-run", "--batch", "5")
        self.session = open_client(endpoint, 10.0)
        self.u_V: list[float] = []
        self.seq = -1
        self.said: dict[str, Any] = {}
        self.session.declare_subscriber(KEYS.sample, self._take)
        self.session.declare_subscriber(status_key("demo", "x"), self._hear)

    def _take(self, sample: zenoh.Sample) -> None:
        batch = wire.decode_samples(sample.payload.to_bytes())
        self.u_V += batch.u_V.tolist()
        self.seq = int(batch.seq[-1])

    def _hear(self, sample: zenoh.Sample) -> None:
        self.said = json.loads(sample.payload.to_bytes())["command"]

    def applies(self, u_V: float) -> bool:
        """Whether the last 50 samples had this voltage."""
        return self.u_V[-50:] == [u_V] * 50

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]
        self.process.kill()


@pytest.fixture(scope="module")
def running(shared_service: ServeProcess) -> Iterator[Stage]:
    found = Stage(shared_service.endpoint)
    yield found
    found.close()


@pytest.fixture
def stage(shared_service: ServeProcess, running: Stage) -> tuple[Stage, str]:
    """A stage that nobody commands, and where it is found."""
    running.said.clear()  # it says so once a second
    eventually(lambda: running.said.get("owner", "unknown") is None)
    return running, shared_service.endpoint


@pytest.fixture
def start() -> Iterator[Callable[[str, float], subprocess.Popen[str]]]:
    """Starts controllers as processes that command one voltage."""
    started: list[subprocess.Popen[str]] = []

    def begin(endpoint: str, u_V: float) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", CONTROLLER, endpoint, str(u_V)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate(timeout=20)


def said_by(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.fixture
def first(stage: tuple[Stage, str], start: Callable[[str, float], subprocess.Popen[str]]) -> subprocess.Popen[str]:
    """A controller that commands 2 V, which the stage applies."""
    found, endpoint = stage
    process = start(endpoint, 2.0)
    assert said_by(process) == "commands\n"
    eventually(lambda: found.applies(2.0))
    return process


def test_the_second_controller_is_refused_and_the_first_one_named(
    stage: tuple[Stage, str],
    first: subprocess.Popen[str],
    start: Callable[[str, float], subprocess.Popen[str]],
) -> None:
    """Before, the stage got the voltages of both, in steps of 4 V."""
    found, endpoint = stage
    before, foreign = len(found.u_V), found.said["foreign"]
    error = said_by(start(endpoint, 6.0))
    assert f"process {first.pid} on {socket.gethostname()} since 2" in error
    assert "End that one" in error
    assert "force=True" in error
    eventually(lambda: len(found.u_V) > before + 500)
    assert set(found.u_V[before:]) == {2.0}
    with Client.connect(endpoint, timeout_s=5.0) as client:
        owner = client.status()["command"]["owner"]
        assert (owner["process"], owner["host"]) == (first.pid, socket.gethostname())
        assert abs(owner["since_unix_s"] - time.time()) < 60.0
        with pytest.raises(CommandHeldError) as held:
            client.take_command()
        assert held.value.holder.startswith(f"process {first.pid} on ")
    eventually(lambda: found.said.get("owner") == owner)
    assert found.said["foreign"] == foreign


def test_after_kill_9_the_next_one_gets_through(
    stage: tuple[Stage, str],
    first: subprocess.Popen[str],
) -> None:
    found, endpoint = stage
    with Client.connect(endpoint, timeout_s=5.0) as client:
        first.kill()
        client.take_command(wait_s=10.0)
        client.command(found.seq + 100, np.full(5000, 3.0))
        eventually(lambda: found.applies(3.0))
        assert client.status()["command"]["owner"]["process"] == os.getpid()
    with Client.connect(endpoint, timeout_s=5.0) as client:
        eventually(lambda: client.status()["command"]["owner"] is None)
        client.take_command()


def test_one_that_hangs_loses_the_lease_and_is_told_so_when_it_returns(
    stage: tuple[Stage, str],
    first: subprocess.Popen[str],
) -> None:
    found, endpoint = stage
    with Client.connect(endpoint, timeout_s=5.0) as client:
        first.send_signal(signal.SIGSTOP)
        client.take_command(wait_s=10.0)
        client.command(found.seq + 100, np.full(5000, 3.0))
        eventually(lambda: found.applies(3.0))
        before = len(found.u_V)
        first.send_signal(signal.SIGCONT)
        assert f"process {os.getpid()} on " in said_by(first)
        eventually(lambda: len(found.u_V) > before + 500)
        assert set(found.u_V[before:]) == {3.0}, "what the first one still sent is left out"
        client.command(found.seq + 100, [3.0])


def test_one_can_be_taken_over_by_force_and_is_told_so(
    stage: tuple[Stage, str],
    first: subprocess.Popen[str],
) -> None:
    found, endpoint = stage
    with Client.connect(endpoint, timeout_s=5.0) as client:
        client.take_command(force=True)
        assert f"process {os.getpid()} on " in said_by(first)
        client.command(found.seq + 100, np.full(5000, 3.0))
        eventually(lambda: found.applies(3.0))


def test_a_stranger_without_the_key_is_no_owner_and_his_commands_are_counted_and_named(
    stage: tuple[Stage, str],
) -> None:
    found, endpoint = stage
    foreign, refused = found.said["foreign"], found.said["refused"]
    recorded: list[tuple[bytes, Any]] = []
    with open_client(endpoint, 5.0) as stranger, Client.connect(endpoint, timeout_s=5.0) as client:
        stranger.declare_subscriber(KEYS.command, lambda s: recorded.append((s.payload.to_bytes(), s.attachment)))
        later = Holder(9_999_999_999_999, "ab" * 8, 1, "elsewhere", 0)
        tokens = [
            stranger.liveliness().declare_token(KEYS.token("owner", later.name, tag))
            for tag in ("", "00" * 16, "nonsense")
        ]
        lease = CommandLease(stranger, KEYS, Authenticator(os.urandom(16)))
        lease.take()
        client.command(found.seq + 200, np.full(5000, 2.0))
        eventually(lambda: found.applies(2.0))
        before = len(found.u_V)

        def lie(attached: Any) -> None:
            payload = wire.encode_command(found.seq + 10, np.full(20, 7.0))
            stranger.put(KEYS.command, payload, attachment=attached, congestion_control=SURELY)

        for _ in range(50):
            lie(None)
            lie(os.urandom(32))
            lie(recorded[0][1])
            lease.put(wire.encode_command(found.seq + 10, np.full(20, 7.0)))
            stranger.put(KEYS.command, recorded[0][0], attachment=recorded[0][1], congestion_control=SURELY)
            time.sleep(0.01)
        eventually(lambda: len(found.u_V) > before + 500)
        assert set(found.u_V[before:]) == {2.0}
        eventually(lambda: found.said["foreign"] == foreign + 250)
        assert found.said["stranger"] == "somebody who repeats the owner's"
        assert found.said["owner"]["process"] == os.getpid()
        assert (found.said["others"], found.said["refused"]) == ([], refused + 4)
        command = client.status()["command"]
        assert (command["owner"]["host"], command["refused"]) == (socket.gethostname(), refused + 4)
        lease.undeclare()
        del tokens


def test_what_an_owner_said_before_it_lost_the_lease_is_not_repeated(free_port: int) -> None:
    endpoint, key = f"tcp/127.0.0.1:{free_port}", os.urandom(16)
    got: list[bytes] = []
    sent: list[tuple[bytes, Any]] = []
    with open_service([endpoint]) as stage, open_client(endpoint) as session, open_client(endpoint) as stranger:
        gate = CommandGate(stage, KEYS, Authenticator(key), got.append)
        stranger.declare_subscriber(KEYS.command, lambda s: sent.append((s.payload.to_bytes(), s.attachment)))
        first, second = (CommandLease(session, KEYS, Authenticator(key)) for _ in range(2))
        assert wait_followed(first.publisher, 5.0)
        first.put(b"first")
        eventually(lambda: sent and got == [b"first"])
        second.take(force=True)
        second.put(b"second")
        eventually(lambda: got == [b"first", b"second"])
        with pytest.raises(CommandHeldError):
            first.put(b"first")
        second.undeclare()
        first.take(wait_s=5.0)
        eventually(lambda: gate.owner is not None)
        stranger.put(KEYS.command, sent[0][0], attachment=sent[0][1], congestion_control=SURELY)
        eventually(lambda: gate.foreign == 1)
        assert got == [b"first", b"second"]
        first.undeclare()
        gate.undeclare()


def test_without_an_owner_commands_are_applied_as_they_come(stage: tuple[Stage, str]) -> None:
    """Who publishes by zenoh alone holds no token; a controller that holds one has precedence from then on."""
    found, endpoint = stage
    with open_client(endpoint, 5.0) as plain, Client.connect(endpoint, timeout_s=5.0) as client:
        plain.put(KEYS.command, wire.encode_command(found.seq + 100, np.full(5000, 2.0)), congestion_control=SURELY)
        eventually(lambda: found.applies(2.0))
        client.command(found.seq + 100, np.full(5000, 3.0))
        eventually(lambda: found.applies(3.0))
        plain.put(KEYS.command, wire.encode_command(found.seq + 100, np.full(100, 2.0)), congestion_control=SURELY)
        eventually(lambda: found.said.get("stranger") == "a controller without a token")
        assert found.applies(3.0)


def test_without_a_key_two_controllers_of_one_process_are_two(stage: tuple[Stage, str]) -> None:
    endpoint = stage[1]
    with open_client(endpoint, 5.0) as a, open_client(endpoint, 5.0) as b:
        leases = [CommandLease(session, KEYS, NO_KEY) for session in (a, b)]
        leases[0].take()
        with pytest.raises(CommandHeldError, match=rf"process {os.getpid()} on "):
            leases[1].put(wire.encode_command(0, [1.0]))
        leases[0].undeclare()
        leases[1].take(wait_s=5.0)
        leases[1].undeclare()


@given(
    st.integers(0, 9_999_999_999_999), st.integers(0, 2**32), st.from_regex(r"[A-Za-z0-9._-]{1,64}", fullmatch=True),
    st.integers(0, 9_999_999_999_999),
)  # fmt: skip
def test_a_token_says_who_holds_it_and_proves_it(order: int, process: int, host: str, since_unix_ms: int) -> None:
    ours, theirs = own_authenticator(), Authenticator(os.urandom(16))
    holder = Holder(order, "0123456789abcdef", process, host, since_unix_ms)
    key = holder.key(ours, KEYS)
    assert Holder.read(ours, KEYS, key) == holder == Holder.read(NO_KEY, KEYS, KEYS.token("owner", holder.name))
    assert str(holder).startswith(f"process {process} on {host} since ")
    assert Holder.read(theirs, KEYS, key) is None
    assert Holder.read(ours, Keys("demo", "y"), key.replace("/x/", "/y/")) is None
    assert Holder.read(ours, KEYS, KEYS.token("owner", holder.name)) is None


@given(st.text())
def test_a_token_of_another_form_is_none(text: str) -> None:
    assert Holder.read(NO_KEY, KEYS, f"{KEYS.base}/owner/{text}/") is None
