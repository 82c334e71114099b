"""Two real instances on one stage: the model is the same in both, and one of them answers whatever happens."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from dehyst.service.client.client import Client
from dehyst.service.config.settings import read_config
from dehyst.service.failover.role_control import Claims
from dehyst.service.operating.remote import operate
from dehyst.service.operating.server import Journal
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client, open_service
from dehyst.service.security.authenticator import NO_KEY, own_authenticator
from dehyst.service.security.tokens import Claim
from dehyst.service.server.process import Service
from dehyst.sim.recordings import read
from tests.service.conftest import unused_port, write_config
from tests.service.living import Asker, Process, Stage, eventually, settled

pytestmark = pytest.mark.e2e
SLEW_V_PER_S = 2000.0


@pytest.fixture
def processes() -> Iterator[list[Process]]:
    started: list[Process] = []
    yield started
    for process in started:
        process.send(signal.SIGCONT)
        process.kill()


def pair_config(folder: Path) -> tuple[Path, list[str]]:
    """A configuration of an instance and its standby, and where clients find them."""
    ports = [unused_port(), unused_port()]
    extra = 'recorder = "rec"\ncheckpoints = "kept"\nserved = "lssvm_adaptive"\n'
    config = write_config(folder, ports[0], extra=extra)
    endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
    config.write_text(f'standby_listen = ["{endpoints[1]}"]\nlease_s = 0.6\n' + config.read_text())
    return config, endpoints


def test_the_standby_takes_over_and_the_one_that_comes_back_stands_by(tmp_path: Path, processes: list[Process]) -> None:
    config, endpoints = pair_config(tmp_path)
    serve = ("serve", "--config", str(config))
    processes.append(Process(*serve))
    assert processes[0].ready["role"] == "primary"
    standing: dict[str, dict[str, Any]] = {}

    def on_standby(sample: Any) -> None:
        status = json.loads(sample.payload.to_bytes())
        standing[status["instance"]] = status

    with (
        open_client(endpoints, 20.0) as session,
        Client.connect(endpoints, timeout_s=0.3, wait_s=20.0, retry_s=10.0) as client,
        Stage(endpoints) as stage,
    ):
        session.declare_subscriber(f"{client.keys.base}/standby/*", on_standby)
        eventually(lambda: client.status()["samples"]["learnt"] > 300)
        # It comes late, and holds the same model to the last bit nevertheless.
        processes.append(Process(*serve, "--standby"))
        assert (processes[1].ready["role"], processes[1].ready["synced"]) == ("standby", True)
        second = processes[1].ready["instance"]
        learnt = eventually(lambda: standing.get(second, {}).get("samples", {}).get("learnt", 0))
        assert learnt > 300
        assert is_the_same(client, standing, second)

        # The one that serves is killed.
        asker = Asker(client)
        asker.ask_for(0.5)
        # On a busy machine the standby may have taken over before, and have given way again.
        epoch = client.status()["epoch"]
        processes[0].process.kill()
        asker.ask_for(1.5)
        assert asker.silence_s < 1.0, f"no answer for {1e3 * asker.silence_s:.0f} ms"
        assert asker.step_V <= SLEW_V_PER_S * asker.silence_s
        assert asker.step_V < 0.15
        status = client.status()
        assert (status["role"], status["epoch"], status["instance"]) == ("primary", epoch + 1, second)
        assert status["samples"]["lost"] < 1000

        # It comes back, meets the one that serves, and stands by, with the model of that one.
        processes.append(Process(*serve))
        third = processes[2].ready["instance"]
        assert (processes[2].ready["role"], processes[2].ready["synced"]) == ("standby", True)
        eventually(lambda: standing.get(third, {}).get("samples", {}).get("learnt", 0) > learnt)
        assert is_the_same(client, standing, third)

        # The one that serves is stopped for a while: to the others that is as good as dead, until it comes back.
        processes[1].send(signal.SIGSTOP)
        asker.ask_for(3.0)
        assert asker.silence_s < 5.0
        assert asker.step_V < 0.1
        status = client.status()
        assert (status["instance"], status["epoch"]) == (third, epoch + 2)
        standing.pop(second, None)
        processes[1].send(signal.SIGCONT)
        eventually(lambda: standing.get(second, {}).get("role") == "standby")
        eventually(lambda: {client.status()["instance"] for _ in range(20)} == {third})
        assert is_the_same(client, standing, second)
        sent = stage.sent
    # Both wrote what they saw, each into its own folder.
    for process in processes[1:]:
        process.send(signal.SIGTERM)
        assert process.process.wait(30) == 0
    for name in ("rec", "rec-standby"):
        recorded = read(tmp_path / name)
        assert recorded.seq is not None
        assert len(recorded) > 1000
    assert sent > 5000


def is_the_same(client: Client, standing: dict[str, dict[str, Any]], instance: str) -> bool:
    """Whether a standby tells, of two samples, the digest that the serving instance tells of them.

    Fails where one that says it is synced tells another one.
    """
    serving: dict[int, str] = {}
    beside: dict[int, str] = {}
    until = time.monotonic() + 25.0
    while time.monotonic() < until:
        status = client.status()
        serving[status["snapshot_seq"]] = status["fingerprint"]
        told = standing.get(instance)
        if told and told["synced"]:
            beside[told["snapshot_seq"]] = told["fingerprint"]
        common = serving.keys() & beside.keys()
        assert not [seq for seq in common if serving[seq] != beside[seq]]
        if len(common) >= 2:
            return True
        time.sleep(0.004)
    return False


def test_who_serves_claims_anew_where_another_goes_on_serving(tmp_path: Path, processes: list[Process]) -> None:
    """As after a stop, when the wire leaves the one that goes on without the claim of the one that took over."""
    config, endpoints = pair_config(tmp_path)
    processes.append(Process("serve", "--config", str(config)))
    instance = processes[0].ready["instance"]
    keys = Keys("demo", "x")
    heard: list[tuple[int, bool]] = []

    def on_claim(sample: zenoh.Sample) -> None:
        claim = Claim.read(NO_KEY, keys, str(sample.key_expr))
        if claim is not None and claim.instance == instance:
            heard.append((claim.epoch, sample.kind == zenoh.SampleKind.PUT))

    with open_client(endpoints, 20.0) as session, Client.connect(endpoints, wait_s=20.0) as client:
        session.liveliness().declare_subscriber(keys.tokens("claim"), on_claim, history=True)
        eventually(lambda: heard == [(1, True)])
        deaf = session.liveliness().declare_token(Claim(0, "i0-deaf").key(own_authenticator(), keys))
        eventually(lambda: len(heard) >= 5)
        deaf.undeclare()
        # Never without one: whoever stands by would take over.
        assert heard[:5] == [(1, True), (2, True), (1, False), (3, True), (2, False)]
        settled(lambda: len(heard), 3.5)  # nobody is there any more who should hear of it
        assert client.status()["epoch"] == heard[-2][0]


def test_a_router_that_is_started_again_is_found_again(tmp_path: Path, processes: list[Process]) -> None:
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    config = write_config(tmp_path, 1)
    config.write_text(
        config.read_text().replace('listen = ["tcp/127.0.0.1:1"]', f'listen = []\nconnect = ["{endpoint}"]')
    )
    router = ("router", "--listen", endpoint)
    processes.append(Process(*router))
    processes.append(Process("serve", "--config", str(config)))
    with Client.connect(endpoint, timeout_s=0.5, wait_s=20.0, retry_s=20.0) as client, Stage([endpoint]):
        eventually(lambda: client.status()["samples"]["learnt"] > 100)
        processes[0].process.kill()
        time.sleep(0.3)
        processes.append(Process(*router))
        asker = Asker(client)
        asker.ask_for(0.5)
        before = client.status()
        eventually(lambda: client.status()["seq"] > before["seq"] + 100)
        assert client.status()["epoch"] == 1


def test_a_standby_that_loses_its_router_does_not_take_itself_for_the_successor(
    tmp_path: Path, processes: list[Process]
) -> None:
    """It hears that everybody has gone. The one that serves goes on; killed, it is still succeeded."""
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    config = write_config(tmp_path, 1, extra='recorder = "rec"\n')
    text = config.read_text().replace('listen = ["tcp/127.0.0.1:1"]', f'listen = []\nconnect = ["{endpoint}"]')
    config.write_text(text)
    router = ("router", "--listen", endpoint)
    processes.append(Process(*router))
    processes.append(Process("serve", "--config", str(config)))
    processes.append(Process("serve", "--config", str(config), "--standby"))
    first, second = (process.ready["instance"] for process in processes[1:])
    assert [process.ready["role"] for process in processes[1:]] == ["primary", "standby"]
    events: list[dict[str, Any]] = []
    with (
        Client.connect(endpoint, timeout_s=0.5, wait_s=20.0, retry_s=20.0) as client,
        Stage([endpoint]),
        open_client(endpoint) as session,
    ):
        session.declare_subscriber(client.keys.event, lambda s: events.append(json.loads(s.payload.to_bytes())))
        eventually(lambda: client.status()["samples"]["learnt"] > 100)
        processes[0].process.kill()
        time.sleep(1.0)
        processes.append(Process(*router))
        asker = Asker(client)
        asker.ask_for(3.0)
        status = client.status()
        assert (status["instance"], status["epoch"], status["role"]) == (first, 1, "primary")
        assert not [e for e in events if e["event"] in ("took_over", "stood_down")]
        processes[1].process.kill()
        asker.ask_for(1.0)
        assert asker.silence_s < 5.0
        status = client.status()
        assert (status["instance"], status["epoch"], status["role"]) == (second, 2, "primary")


def test_a_standby_that_a_stranger_tells_that_it_differs_asks_who_serves(
    tmp_path: Path, processes: list[Process]
) -> None:
    """Forged statuses, published and as answers, events and unsigned verbs say so. It fetches the state no more; only
    when the one that serves tells it of a verb."""
    config, endpoints = pair_config(tmp_path)
    processes.append(Process("serve", "--config", str(config)))
    processes.append(Process("serve", "--config", str(config), "--standby"))
    second = processes[1].ready["instance"]
    events: list[dict[str, Any]] = []
    told: list[dict[str, Any]] = []
    with (
        Client.connect(endpoints, wait_s=20.0, retry_s=20.0) as client,
        Stage(endpoints),
        open_client(endpoints[1], 20.0) as session,
    ):
        keys = client.keys
        session.declare_subscriber(keys.event, lambda s: events.append(json.loads(s.payload.to_bytes())))
        session.declare_subscriber(keys.standby(second), lambda s: told.append(json.loads(s.payload.to_bytes())))
        eventually(lambda: told and told[-1]["synced"] and told[-1]["samples"]["learnt"] > 500)
        first, said = processes[0].ready["instance"], {"snapshot_seq": client.status()["snapshot_seq"]}

        def lie(query: zenoh.Query) -> None:
            with query:
                query.reply(keys.status, json.dumps({"instance": first, "fingerprint": "?", **said}))

        asked: list[str] = []

        def see(query: zenoh.Query) -> None:
            with query:
                asked.append(str(query.parameters))

        seeing = session.declare_queryable(keys.state, see)
        queryable = session.declare_queryable(keys.status, lie, complete=True)
        for _ in range(150):
            said["snapshot_seq"] = client.status()["snapshot_seq"]
            session.put(keys.status, json.dumps({"instance": first, "fingerprint": "?", **said}))
            session.put(keys.event, json.dumps({"event": "selected", "instance": first}))
            verb = {"instance": first, "verb": "select", "by": "alice", "samples": 10**9}
            session.get(keys.switch, payload=json.dumps(verb), timeout=0.1)
            time.sleep(0.01)
        queryable.undeclare()
        heard = len(told)
        eventually(lambda: len(told) > heard + 2 and told[-1]["synced"])
        assert not asked
        operate(session, keys, "select", "alice", {"model": "linear"})
        eventually(lambda: bool(asked))
        eventually(lambda: told[-1]["served"] == "linear")
        seeing.undeclare()
        processes[0].process.kill()
        eventually(lambda: any(event["event"] == "took_over" for event in events))
    (took,) = (event for event in events if event["event"] == "took_over")
    assert took["synced"]
    assert not [event for event in events if event["event"] == "standby_differed"]


def test_viewers_that_are_killed_or_stopped_harm_nobody(tmp_path: Path, processes: list[Process]) -> None:
    config = write_config(tmp_path, port := unused_port())
    endpoint = f"tcp/127.0.0.1:{port}"
    processes.append(Process("serve", "--config", str(config)))
    program = (
        "import sys, time\n"
        "from dehyst.service.runtime.session import open_client\n"
        "s = open_client(sys.argv[1])\n"
        "sub = s.declare_subscriber('dehyst/v1/demo/x/**', lambda _: None)\n"
        "print('watching', flush=True)\n"
        "time.sleep(100)\n"
    )
    viewers = [
        subprocess.Popen([sys.executable, "-c", program, endpoint], stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    try:
        for viewer in viewers:
            assert viewer.stdout is not None
            assert viewer.stdout.readline() == "watching\n"
        with Client.connect(endpoint, timeout_s=2.0, wait_s=20.0) as client, Stage([endpoint]):
            eventually(lambda: client.status()["samples"]["learnt"] > 100)
            asker = Asker(client)
            viewers[0].kill()
            for viewer in viewers[1:]:
                viewer.send_signal(signal.SIGSTOP)
            asker.ask_for(2.5)
            assert asker.silence_s < 1.5
            assert client.retries == 0
            assert client.status()["samples"]["lost"] == 0
    finally:
        for viewer in viewers:
            viewer.send_signal(signal.SIGCONT)
            viewer.kill()
            viewer.communicate(timeout=20)


def test_a_standby_that_must_serve_before_its_first_state_goes_on_from_its_own_files_and_says_so(
    tmp_path: Path,
) -> None:
    """The journal in its own folder says that it was frozen when it was last ended; that holds."""
    config, endpoints = pair_config(tmp_path)
    keys, by = Keys("demo", "x"), own_authenticator()
    Journal(tmp_path / "rec-standby").write({"who": "alice", "verb": "freeze", "ok": True, "samples": 0})
    events: list[dict[str, Any]] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            life = b'{"instance": "i0-first"}'
            query.reply(keys.status, life, attachment=by.answered(query, keys.status, life))

    with open_service([endpoints[0]]) as first:
        first.declare_queryable(keys.status, answer)
        first.declare_subscriber(keys.event, lambda s: events.append(json.loads(s.payload.to_bytes())))
        token = first.liveliness().declare_token(Claim(1, "i0-first").key(by, keys))
        service = Service(read_config(config), standby=True)
        starting = threading.Thread(target=service.start)
        starting.start()
        try:
            eventually(lambda: service.axes and service.axes[0].status()["role"] == "standby")
            time.sleep(1.0)
            assert (service.axes[0].role, service.axes[0].synced) == ("standby", False)
            token.undeclare()
            starting.join(20.0)
            status = service.axes[0].status()
            assert (status["role"], status["epoch"], status["frozen"]) == ("primary", 2, True)
            (warning,) = status["warnings"]
            assert "without the state of the one before: it continues from the model file" in warning
            (took,) = eventually(lambda: [event for event in events if event["event"] == "took_over"])
            assert took["synced"] is False
        finally:
            service.close()


def test_the_greatest_claim_serves() -> None:
    keys = Keys("demo", "x")
    claims = Claims(keys, "i-me")
    assert (claims.highest(), claims.next_epoch()) == (None, 1)
    claims.update(keys.token("claim", "3/i-me"), True)  # one's own is no news
    assert claims.highest() is None
    for token in ("1/i-b", "2/i-a", "2/i-c"):
        claims.update(keys.token("claim", token), True)
    assert claims.highest() == Claim(2, "i-c")
    claims.update(keys.token("claim", "2/i-c"), False)
    assert claims.highest() == Claim(2, "i-a")
    for token in ("2/i-a", "1/i-b"):
        claims.update(keys.token("claim", token), False)
    assert (claims.highest(), claims.next_epoch()) == (None, 3)


def test_a_standby_needs_ears_of_its_own(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dehyst.lab.cli", "serve", "--config", str(write_config(tmp_path, 1)), "--standby"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "standby_listen" in done.stderr
