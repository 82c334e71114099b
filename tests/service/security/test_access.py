"""Closed to strangers: who is let in, for what, and that every refusal is counted. Real sessions against real TLS."""

from __future__ import annotations

import base64
import json
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from dehyst.adaptive.errors import InputError
from dehyst.service.client.client import Client
from dehyst.service.operating.remote import operate
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import NoReplyError, SessionError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client
from dehyst.service.security.access import (
    ROLES,
    Plan,
    access_control,
    add,
    check_reach,
    create,
    missing_protection,
    read_plan,
    remove,
)
from dehyst.service.security.refusals import note
from tests.service.conftest import ServeProcess, unused_port, write_config
from tests.service.living import eventually

USERS = {
    "service": "service",
    "router": "router",
    "afm": "stage",
    "other": "stage",
    "loop": "controller",
    "plot": "client",
    "alice": "operator",
}
KEYS = Keys("demo", "x")
pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="the openssl command is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("access")
    create(path, Plan(USERS, stages={"other": "elsewhere"}))
    return path


def as_json(path: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(path.read_text().split("\n", 1)[1])
    return data


def test_every_file_is_for_its_owner_alone_and_nobody_gets_the_authoritys_key(folder: Path) -> None:
    for path in folder.rglob("*"):
        secret = path.suffix in {".key", ".json5"}
        assert not secret or stat.S_IMODE(path.stat().st_mode) == 0o600, path
    assert sorted(path.stem for path in folder.glob("*.json5")) == sorted(USERS)
    key = (folder / "ca" / "ca.key").read_text().splitlines()[1]
    for path in folder.glob("*.json5"):
        assert key not in path.read_text()


def test_only_who_listens_can_be_taken_for_a_service(folder: Path) -> None:
    found = {}
    for path in folder.glob("*.json5"):
        text = path.read_text()
        config = json.loads(text[text.index("{") :])
        pem = base64.b64decode(config["transport"]["link"]["tls"]["connect_certificate_base64"])
        shown = subprocess.run(["openssl", "x509", "-noout", "-text"], input=pem, capture_output=True, check=True)
        words = shown.stdout.decode()
        assert "TLS Web Client Authentication" in words
        listens = "listen_certificate_base64" in config["transport"]["link"]["tls"]
        found[path.stem] = listens
        assert ("TLS Web Server Authentication" in words) == listens
        assert ("Subject Alternative Name" in words) == listens
    assert set(found.values()) == {True, False}


def test_what_is_made_counts_as_closed_and_what_lacks_a_part_does_not(folder: Path, tmp_path: Path) -> None:
    assert missing_protection(folder / "service.json5", listens=True) == []
    assert missing_protection(folder / "plot.json5", listens=False) == []
    for section, words in (
        (("transport", "link", "protocols"), "protocols"),
        (("transport", "link", "tls", "enable_mtls"), "enable_mtls"),
        (("access_control",), "access control"),
    ):
        config = as_json(folder / "service.json5")
        inner: Any = config
        for name in section[:-1]:
            inner = inner[name]
        del inner[section[-1]]
        path = tmp_path / "weak.json5"
        path.write_text(json.dumps(config))
        (lacks,) = missing_protection(path, listens=True)
        assert words in lacks
        with pytest.raises(InputError, match="insecure_beyond_loopback"):
            check_reach("f", ["tls/0.0.0.0:7447"], [], path)


def test_beyond_the_machine_needs_protection_or_an_explicit_word(folder: Path) -> None:
    secure = folder / "service.json5"
    check_reach("f", ["tcp/127.0.0.1:7447"], ["tcp/localhost:1"], None)
    check_reach("f", ["tls/0.0.0.0:7447"], ["tls/192.0.2.1:7447"], secure)
    check_reach("f", ["tcp/0.0.0.0:7447"], ["tcp/192.0.2.1:1"], None, insecure=True)
    for listen, connect, config, words in (
        (["tcp/0.0.0.0:7447"], [], None, "no zenoh_config"),
        ([], ["tcp/192.0.2.1:7447"], None, "no zenoh_config"),
        (["tcp/0.0.0.0:7447"], [], secure, "tcp/0.0.0.0:7447 is not one of tls"),
        (["tls/127.0.0.1:1"], ["tcp/192.0.2.1:7447"], secure, "f: connect"),
    ):
        with pytest.raises(InputError, match=words):
            check_reach("f", listen, connect, config)


def test_who_comes_later_gets_in_and_who_leaves_is_out(folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / "access"
    shutil.copytree(folder, mine)
    before = as_json(mine / "plot.json5")
    written = add(mine, {"bob": "operator", "tip": "stage"}, {"tip": "demo"})
    assert {path.name for path in written} == {"bob.json5", "tip.json5", "service.json5", "router.json5"}
    assert as_json(mine / "plot.json5") == before
    control = as_json(mine / "service.json5")["access_control"]
    assert {subject["id"] for subject in control["subjects"]} == {*USERS, "bob", "tip"}
    remove(mine, ["plot"])
    control = as_json(mine / "service.json5")["access_control"]
    assert "plot" not in {subject["id"] for subject in control["subjects"]}
    assert not (mine / "plot.json5").exists()
    assert read_plan(mine).stages == {"other": "elsewhere", "tip": "demo"}
    with pytest.raises(InputError, match="plot"):
        remove(mine, ["plot"])
    with pytest.raises(InputError, match="not taken"):
        add(mine, {"bob": "client"}, {})
    with pytest.raises(InputError, match="an access folder"):
        create(mine, Plan(USERS))


@pytest.mark.parametrize(
    ("users", "stages", "words"),
    [({"a b": "client"}, {}, "user"), ({"a": "king"}, {}, "role of a"), ({"a": "client"}, {"a": "demo"}, "stages")],
)
def test_a_plan_that_makes_no_sense_is_refused(users: dict[str, str], stages: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Plan(users, stages=stages)


def test_only_the_roles_meant_to_have_a_right_have_it() -> None:
    control = access_control(USERS, {"other": "elsewhere"})
    rules = {rule["id"]: rule for rule in control["rules"]}
    may: dict[tuple[str, str], set[str]] = {}
    for policy in control["policies"]:
        (name,) = policy["subjects"]
        for rule in (rules[id_] for id_ in policy["rules"]):
            for message in rule["messages"] if rule["flows"] == ["ingress"] and rule["permission"] == "allow" else ():
                for key in rule["key_exprs"]:
                    may.setdefault((message, key), set()).add(name)
    every = {"service", "router"}  # through their rule for all keys; the service's denials are tried for real below
    of_stage = {f"dehyst/v1/{stage}/*/{what}" for stage in ("*", "elsewhere") for what in ("sample", "stage_status")}
    of_controller = {"dehyst/v1/*/*/command", "dehyst/v1/*/*/reference"}
    assert {key for message, key in may if message == "put"} == {"dehyst/v1/**"} | of_stage | of_controller
    assert may["put", "dehyst/v1/*/*/sample"] == {"afm"}
    assert may["put", "dehyst/v1/elsewhere/*/sample"] == {"other"}
    assert may["put", "dehyst/v1/*/*/command"] == {"loop"}
    assert may["liveliness_token", "dehyst/v1/*/*/owner/**"] == {"loop"}
    assert may["query", "dehyst/v1/*/*/operate"] == {"alice"}
    assert may["put", "dehyst/v1/**"] == every
    assert may["declare_queryable", "dehyst/v1/**"] == every
    assert control["default_permission"] == "deny"
    assert set(USERS.values()) == set(ROLES)


def test_refusals_are_counted_by_what_was_wrong() -> None:
    counts = dict.fromkeys(("messages", "identities", "certificates"), 0)
    text = (
        b"\x1b[2m2026-01-01T00:00:00Z\x1b[0m \x1b[35mTRACE\x1b[0m rx-0 ThreadId(11) "
        b"\x1b[2mzenoh::net::routing::interceptor\x1b[0m\x1b[2m:\x1b[0m Msg intercepted!\n"
        b"2026 DEBUG acc-0 zenoh_transport::unicast::establishment::accept: New transport link accepted from\n"
        b"2026 INFO acc-0 zenoh::x::access_control: abc did not match any configured ACL subject. Default\n"
        b"2026 WARN acc-0 zenoh_link_tls::unicast: invalid peer certificate. Hint: increase\n"
        b"2026 WARN somewhere: something to be shown\n"
    )
    shown = [line for line in text.splitlines(keepends=True) if note(line, counts)]
    assert counts == {"messages": 1, "identities": 1, "certificates": 1}
    assert shown == [b"2026 WARN somewhere: something to be shown\n"]


@pytest.fixture(scope="module")
def closed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServeProcess]:
    """A service with TLS and access control."""
    at, port = tmp_path_factory.mktemp("closed"), unused_port()
    config = write_config(at, port)
    text = config.read_text().replace(f"tcp/127.0.0.1:{port}", f"tls/127.0.0.1:{port}")
    config.write_text(f'zenoh_config = "{folder / "service.json5"}"\n{text}')
    process = ServeProcess(config, port)
    process.endpoint = f"tls/127.0.0.1:{port}"
    yield process
    process.kill()


def status(closed: ServeProcess, folder: Path) -> dict[str, Any]:
    with Client.connect(closed.endpoint, timeout_s=5.0, zenoh_config=folder / "plot.json5") as client:
        return client.status()


def some_samples(n: int = 10, first: int = 0) -> bytes:
    k = list(range(first, first + n))
    return wire.encode_samples(k, [1e-3 * i for i in k], [1.0] * n, [12.0] * n)


@pytest.mark.e2e
def test_each_may_do_its_own_and_nothing_else(closed: ServeProcess, folder: Path) -> None:
    before = status(closed, folder)
    for name in ("plot", "loop", "alice", "other", "service"):
        with open_client(closed.endpoint, zenoh_config=folder / f"{name}.json5") as session:
            session.put(KEYS.sample, some_samples())
            session.put(KEYS.sample, b"junk")
    for name in ("plot", "loop", "afm", "service"):
        with (
            open_client(closed.endpoint, zenoh_config=folder / f"{name}.json5") as session,
            pytest.raises(NoReplyError, match="your role may command"),
        ):
            operate(session, KEYS, "freeze", name, timeout_s=2.0)
    for name in ("plot", "loop", "alice"):
        with Client.connect(closed.endpoint, timeout_s=5.0, zenoh_config=folder / f"{name}.json5") as client:
            assert client.point(40.0).u_V > 0.0
    after = status(closed, folder)
    assert after["samples"]["received"] == before["samples"]["received"] == 0
    assert after["samples"]["malformed"] == 0
    assert after["refused"]["messages"] - before["refused"]["messages"] >= 2 * 5 + 4
    with open_client(closed.endpoint, zenoh_config=folder / "afm.json5") as stage:
        stage.put(KEYS.sample, some_samples())
        now = eventually(lambda: (s := status(closed, folder))["samples"]["received"] == 10 and s)
    with open_client(closed.endpoint, zenoh_config=folder / "alice.json5") as session:
        assert operate(session, KEYS, "freeze", "alice")["seq"] == 9
        assert operate(session, KEYS, "thaw", "alice")["ok"]
    assert now["samples"]["malformed"] == 0


@pytest.mark.e2e
def test_voltages_reach_the_stage_from_the_controller_alone(closed: ServeProcess, folder: Path) -> None:
    heard: list[bytes] = []

    def put(name: str, payload: bytes) -> None:
        with open_client(closed.endpoint, zenoh_config=folder / f"{name}.json5") as session:
            session.put(KEYS.command, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    with open_client(closed.endpoint, zenoh_config=folder / "afm.json5") as stage:
        stage.declare_subscriber(KEYS.command, lambda sample: heard.append(sample.payload.to_bytes()))
        eventually(lambda: put("loop", b"first") or heard)  # until its subscription is known
        for name in ("plot", "alice", "service"):
            put(name, b"wrong")
        eventually(lambda: put("loop", b"last") or b"last" in heard)
    assert set(heard) == {b"first", b"last"}


@pytest.mark.e2e
def test_a_controller_alone_may_own_the_command(closed: ServeProcess, folder: Path) -> None:
    for name in ("plot", "alice", "loop"):
        with Client.connect(closed.endpoint, timeout_s=5.0, zenoh_config=folder / f"{name}.json5") as client:
            client.take_command()
            until = time.monotonic() + (10.0 if name == "loop" else 0.5)
            while (owner := client.status()["command"]["owner"]) is None and time.monotonic() < until:
                time.sleep(0.02)
        assert (owner is not None) == (name == "loop")


@pytest.mark.e2e
def test_strangers_are_kept_out_and_counted(closed: ServeProcess, folder: Path, tmp_path: Path) -> None:
    before = status(closed, folder)["refused"]
    mine, theirs = as_json(folder / "plot.json5"), tmp_path / "theirs"
    create(theirs, Plan({"service": "service", "plot": "client"}))
    forged = as_json(theirs / "plot.json5")
    # Trusts the real service, and shows it a certificate of another authority.
    forged["transport"]["link"]["tls"]["root_ca_certificate_base64"] = mine["transport"]["link"]["tls"][
        "root_ca_certificate_base64"
    ]
    bare = json.loads(json.dumps(mine))
    for key in ("connect_certificate_base64", "connect_private_key_base64"):
        del bare["transport"]["link"]["tls"][key]
    bare["transport"]["link"]["tls"]["enable_mtls"] = False
    for name, config in (("forged", forged), ("bare", bare)):
        path = tmp_path / f"{name}.json5"
        path.write_text(json.dumps(config))
        with pytest.raises((SessionError, NoReplyError), match=r"certificate or password was refused|no reply within"):
            Client.connect(closed.endpoint, timeout_s=1.0, zenoh_config=path)
    # A genuine certificate of somebody whom the service does not know, as after 'access remove'.
    add(folder, {"mallory": "operator"}, {})
    with pytest.raises(NoReplyError), open_client(closed.endpoint, zenoh_config=folder / "mallory.json5") as session:
        operate(session, KEYS, "freeze", "mallory", timeout_s=1.0)
    remove(folder, ["mallory"])
    after = status(closed, folder)["refused"]
    assert after["certificates"] - before["certificates"] >= 2
    assert after["identities"] - before["identities"] == 1
    assert after["messages"] > before["messages"]


def test_serving_and_routing_openly_is_refused_in_words(tmp_path: Path) -> None:
    config = write_config(tmp_path, 1)
    config.write_text(config.read_text().replace("tcp/127.0.0.1:1", "tcp/0.0.0.0:1"))
    for args in (("serve", "--config", str(config)), ("router", "--listen", "tcp/0.0.0.0:1")):
        done = subprocess.run(
            [sys.executable, "-m", "dehyst.lab.cli", *args], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 2
        assert "--insecure-beyond-loopback" in done.stderr
        assert "Traceback" not in done.stderr
