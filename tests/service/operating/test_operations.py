"""The operator's verbs: read strictly, applied between batches, written down, and shown in a table."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.lab.cli import main
from dehyst.service.client.client import Client
from dehyst.service.operating.remote import operate, screen, statuses
from dehyst.service.operating.server import RESERVE, Journal, OperationsServer, Switch
from dehyst.service.operating.verbs import MAX_BYTES, Request, decode_request, encode_request
from dehyst.service.protocol.errors import FieldError, NoReplyError, RefusedError, ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client, open_service
from dehyst.service.security.authenticator import NO_KEY, Authenticator, own_authenticator
from dehyst.service.server.axis_verbs import axis_verbs
from tests.service.living import eventually, samples

KEYS = Keys("demo", "x")


class FakeAxis:
    """Remembers what was done to it, and in which thread."""

    def __init__(self) -> None:
        self.handled_seq = 41
        self.learner = object()
        self.done: list[tuple[Any, ...]] = []
        self.hold = threading.Event()
        self.hold.set()

    def freeze(self, by: str = "") -> int:
        self.hold.wait(10.0)
        self.done.append(("freeze", by))
        return self.handled_seq

    def thaw(self, by: str = "") -> int:
        self.done.append(("thaw", by))
        return self.handled_seq

    def select(self, model: str, by: str = "") -> int:
        if model != "linear":
            raise FieldError("model", repr(model), "one of linear")
        self.done.append(("select", model, by))
        return self.handled_seq

    def rollback(self, learner: object, checkpoint: int, by: str = "") -> int:
        self.done.append(("rollback", checkpoint, by))
        return self.handled_seq


class FakeFolder:
    """One checkpoint, with the number 3."""

    def entries(self) -> list[dict[str, Any]]:
        return [{"checkpoint": 3, "seq": 30, "samples": 20, "time_unix_s": 1.0, "bytes": 999}]

    def learner_of(self, number: int, like: object) -> object:
        if number == 666:
            raise RuntimeError("something within")
        return like


def make(axis: FakeAxis, folder: Path | None, role: str = "primary") -> tuple[OperationsServer, list[tuple[str, str]]]:
    events: list[tuple[str, str]] = []
    background = {"retune": lambda: lambda arguments: {"started": True, "job": 3}, "diagnose": lambda: None}
    checkpoints = SimpleNamespace(folder=FakeFolder(), keep_listed=lambda: frozenset({3}))
    verbs = axis_verbs(axis, checkpoints, lambda work: work(), background)  # type: ignore[arg-type]
    journal = Journal(folder, wall_s=lambda: 1234.5)
    return OperationsServer(
        KEYS, "i1-00", verbs, journal, lambda name, detail: events.append((name, detail)), lambda: role,
        background=tuple(background), authenticator=own_authenticator(),
    ), events  # fmt: skip


def ask(verb: str, who: str = "alice", **arguments: Any) -> bytes:
    return encode_request(Request(verb, who, arguments))


def request(client: zenoh.Session, payload: bytes | None) -> Any:
    """The replies to a request that carries the key."""
    attachment = own_authenticator().question(payload=payload or b"", key=KEYS.operate).attachment
    return client.get(KEYS.operate, payload=payload, attachment=attachment, timeout=10.0)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (None, "payload"),
        (b"", "no JSON"),
        (b"[]", "JSON object"),
        (b'{"verb": "freeze"}', "who"),
        (b'{"verb": "freeze", "who": "a\\u001b[2J"}', "printable"),
        (b'{"verb": "freeze", "who": "%s"}' % (b"a" * 65), "who"),
        (b'{"verb": "freeze", "who": "a", "arguments": []}', "arguments"),
        (b'{"verb": "freeze", "who": "a", "sudo": true}', "sudo"),
        (b'{"verb": 3, "who": "a"}', "verb"),
        (b'{"verb": "freeze", "who": "a", "arguments": {"x": NaN}}', "NaN"),
        (b'{"verb": "freeze", "who": "%s"}' % (b"a" * MAX_BYTES), "at most"),
        (b"[" * 10_000, "no JSON"),
        (ask("explode"), "one of freeze"),
        (ask("freeze", hard=True), "arguments.hard"),
        (ask("rollback"), "arguments.checkpoint"),
        (ask("rollback", checkpoint="3"), "an integer"),
        (ask("rollback", checkpoint=True), "an integer"),
        (ask("select", model=3), "a text"),
        (ask("select", model="sorcery"), "'sorcery'"),
        (ask("diagnose"), "switched off"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_words_and_counted(
    payload: bytes | None, words: str, tmp_path: Path
) -> None:
    axis = FakeAxis()
    server, _ = make(axis, tmp_path)
    with pytest.raises((InputError, ServiceError), match=words.replace("[", r"\[")):
        server.handle(payload)
    assert (axis.done, server.counters()["refused"], server.counters()["done"]) == ([], 1, 0)


def test_the_journal_is_bounded_and_keeps_the_one_before(tmp_path: Path) -> None:
    journal = Journal(tmp_path, max_bytes=1000)
    for i in range(40):
        assert journal.write({"verb": "freeze", "number": i})
    sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir() if path.name != RESERVE}
    assert set(sizes) == {"operations.jsonl", "operations.1.jsonl"}
    assert max(sizes.values()) <= 1000
    newest = [json.loads(line)["number"] for line in (tmp_path / "operations.jsonl").read_text().splitlines()]
    assert newest[-1] == 39


@given(
    st.text(min_size=1, max_size=32),
    st.text(min_size=1, max_size=64),
    st.dictionaries(st.text(max_size=9), st.integers() | st.text(max_size=9) | st.booleans(), max_size=3),
)
def test_a_request_comes_back_or_is_not_sent(verb: str, who: str, arguments: dict[str, Any]) -> None:
    request = Request(verb, who, arguments)
    try:
        payload = encode_request(request)
    except InputError:
        assert not who.isprintable() or not who.strip()
        return
    assert decode_request(payload) == request


@pytest.fixture
def wire_axis(free_port: int, tmp_path: Path) -> Iterator[tuple[FakeAxis, zenoh.Session, OperationsServer]]:
    """An operations server on the wire, and a client's session to it."""
    axis = FakeAxis()
    server, _ = make(axis, tmp_path)
    with open_service([f"tcp/127.0.0.1:{free_port}"]) as session:
        entities = server.declare(session)
        with open_client(f"tcp/127.0.0.1:{free_port}") as client:
            yield axis, client, server
        axis.hold.set()
        for entity in entities:
            entity.undeclare()


def test_over_the_wire(wire_axis: tuple[FakeAxis, zenoh.Session, OperationsServer]) -> None:
    axis, client, server = wire_axis
    assert operate(client, KEYS, "freeze", "alice")["seq"] == 41
    assert axis.done == [("freeze", "alice")]
    with pytest.raises(RefusedError, match="sorcery") as refused:
        operate(client, KEYS, "select", "alice", {"model": "sorcery"})
    assert (refused.value.field, refused.value.kind) == ("model", "InputError")
    with pytest.raises(RefusedError, match="something within"):
        operate(client, KEYS, "rollback", "alice", {"checkpoint": 666})
    with pytest.raises(NoReplyError, match="dehyst/v1/demo/y"):
        operate(client, Keys("demo", "y"), "freeze", "alice", timeout_s=0.5)
    for payload in (b"", b"junk", b"x" * 2**20, None):
        (reply,) = list(request(client, payload))
        assert json.loads(reply.err.payload.to_bytes())["error"] == "InputError"
    assert server.counters() == {"done": 1, "refused": 6, "unsigned": 0, "unlogged": 0}


def test_only_who_has_the_key_commands(wire_axis: tuple[FakeAxis, zenoh.Session, OperationsServer]) -> None:
    axis, client, server = wire_axis
    payload = ask("freeze", "mallory")
    theirs = Authenticator(b"a stranger's own one")
    signed = own_authenticator().question(payload=payload, key=KEYS.operate).attachment
    for attachment, got in (
        (None, "none"),
        (bytes(32), "wrong"),
        (own_authenticator().question(payload=payload).attachment, "wrong"),  # a stamp alone, as for a status
        (own_authenticator().question(payload=payload, key=KEYS.status).attachment, "wrong"),
        (own_authenticator().question(payload=ask("thaw"), key=KEYS.operate).attachment, "wrong"),
        (theirs.question(payload=payload, key=KEYS.operate).attachment, "wrong"),
        (signed, ""),
        (signed, "came before"),
    ):
        (reply,) = list(client.get(KEYS.operate, payload=payload, attachment=attachment, timeout=5.0))
        if got:
            error = json.loads(reply.err.payload.to_bytes())
            assert (error["error"], error["field"]) == ("InputError", "authenticator")
            assert got in error["got"]
            assert "--key" in error["message"]
    assert axis.done == [("freeze", "mallory")]
    assert server.counters() == {"done": 1, "refused": 0, "unsigned": 7, "unlogged": 0}
    with pytest.raises(RefusedError, match="authenticator: got a wrong one"):
        operate(client, KEYS, "freeze", "mallory", authenticator=theirs)


def test_who_only_says_that_a_command_is_done_is_not_believed(
    wire_axis: tuple[FakeAxis, zenoh.Session, OperationsServer],
) -> None:
    axis, client, _ = wire_axis
    said = json.dumps({"ok": True, "seq": 7, "result": {}})

    def lie(query: zenoh.Query) -> None:
        with query:
            query.reply(KEYS.operate, said, attachment=query.attachment)

    liar = client.declare_queryable(KEYS.operate, lie, complete=True)
    assert operate(client, KEYS, "freeze", "alice")["seq"] == 41
    assert axis.done == [("freeze", "alice")]
    liar.undeclare()  # type: ignore[no-untyped-call]


def test_more_than_can_wait_is_refused_at_once_and_a_flood_is_journaled_as_a_number(
    wire_axis: tuple[FakeAxis, zenoh.Session, OperationsServer], tmp_path: Path
) -> None:
    axis, client, server = wire_axis
    operate(client, KEYS, "thaw", "warm")
    axis.hold.clear()
    waiting = [request(client, ask("freeze", f"a{i}")) for i in range(200)]
    eventually(lambda: server.counters()["refused"] >= 200 - 33)
    axis.hold.set()
    replies = [reply for handler in waiting for reply in handler]
    errors = [json.loads(reply.err.payload.to_bytes()) for reply in replies if reply.err is not None]
    refused = len(errors)
    # 32 wait, and one is being done if it was taken before the last of them came.
    assert 200 - 33 <= refused <= 200 - 32
    assert len(replies) == 200
    assert all("wait already" in error["message"] for error in errors)

    def told() -> int:
        lines = [json.loads(line) for line in (tmp_path / "operations.jsonl").read_text().splitlines()]
        errors = [line["error"] for line in lines if not line["ok"]]
        return sum(int(error.split()[0]) if "more requests" in error else 1 for error in errors)

    eventually(lambda: told() == refused)
    assert len((tmp_path / "operations.jsonl").read_text().splitlines()) < 80


def test_a_freeze_is_written_on_a_full_disk_where_there_was_room_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path)
    journal.reserve()
    path = tmp_path / "operations.jsonl"
    path.write_bytes(b'{"verb": "thaw", "who": "alice", "ok": true}\n{"verb": "sel')  # cut off by a full disk
    reserve, written = tmp_path / RESERVE, os.write
    assert reserve.stat().st_size > 10_000

    def full(handle: int, data: bytes) -> int:
        if reserve.exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        return written(handle, data)

    monkeypatch.setattr(os, "write", full)
    assert journal.write({"verb": "freeze", "who": "bob", "ok": True, "samples": 5})
    switch = Journal(tmp_path).last_switch()
    assert switch is not None
    assert (switch.verb, switch.who) == ("freeze", "bob")
    assert journal.lost == 0
    monkeypatch.undo()
    assert journal.write({"verb": "thaw", "who": "bob", "ok": True, "samples": 6})
    assert reserve.exists(), "it is made again as soon as there is room"


def test_an_answer_says_whether_it_outlives_a_crash(tmp_path: Path) -> None:
    (tmp_path / "full").write_text("a file where a folder should be")
    for folder, durable in ((tmp_path, True), (tmp_path / "full", False), (None, False)):
        server, _ = make(FakeAxis(), folder)
        assert json.loads(server.handle(ask("freeze")))["durable"] is durable
    settled = OperationsServer(
        KEYS, "i1-00", {"freeze": lambda request: (41, {})}, Journal(None), lambda *_: None, settle=lambda: True
    )  # fmt: skip
    assert json.loads(settled.handle(ask("freeze")))["durable"] is True


def test_the_last_switch_is_read_from_a_damaged_journal(tmp_path: Path) -> None:
    journal = Journal(tmp_path, wall_s=lambda: 5.0)
    assert journal.last_switch() is None
    for entry in (
        {"verb": "freeze", "who": "alice", "ok": True, "samples": 77},
        {"verb": "thaw", "who": "bob", "ok": False, "error": "no"},
        {"verb": "select", "who": "bob", "ok": True, "samples": 80},
        {"verb": "freeze", "who": 3, "ok": True},
    ):
        journal.write(entry)
    with open(tmp_path / "operations.jsonl", "ab") as file:
        file.write(b'\xff\x00 rubbish\n[1]\n{"verb": "thaw", "ok": tr')
    assert journal.last_switch() == Switch("freeze", "alice", 77, 5.0)
    (tmp_path / "operations.jsonl").replace(tmp_path / "operations.1.jsonl")
    assert journal.last_switch() == Switch("freeze", "alice", 77, 5.0)
    journal.write({"verb": "thaw", "who": "bob", "ok": True, "samples": 90})
    assert journal.last_switch() == Switch("thaw", "bob", 90, 5.0)


@pytest.mark.parametrize(
    ("samples", "time_unix_s", "instance", "included"),
    [
        (499, 9999.0, "i1-a", False),  # the clock went back between the two
        (501, 1.0, "i1-a", True),
        (500, 999.0, "i1-a", False),
        (500, 1001.0, "i1-a", True),
        (10, 1001.0, "i2-b", True),  # the process after it counts anew
        (10_000, 999.0, "i2-b", False),
    ],
)
def test_a_state_includes_a_switch_whatever_the_clock_does(
    samples: int, time_unix_s: float, instance: str, included: bool
) -> None:
    assert Switch("freeze", "alice", 500, 1000.0, "i1-a").is_in(samples, time_unix_s, instance) is included


STATUS: dict[str, Any] = {
    "stage": "demo", "axis": "x", "instance": "i1-ab", "role": "primary", "state": "ok", "served": "lssvm_adaptive",
    "learning": "lssvm_adaptive", "seq": 12345, "sample_age_s": 0.01, "refused": {"messages": 3},
    "samples": {"learnt": 9000, "lost": 2, "dropped": 0, "gates": {"learnt": 9000, "saturated": 70, "late": 5}},
    "queries": {"count": 88, "errors": 1, "p50_us": 101.4, "p99_us": 240.0},
}  # fmt: skip


def test_what_others_say_moves_no_cursor() -> None:
    shown = screen([{**STATUS, "served": "\x1b[2Jboo\n"}], "tcp/\x1b:1", ["\x1b[31mred"])
    assert "\x1b[2Jboo" not in shown
    assert "\x1b[31mred" not in shown


def test_statuses_of_two_instances_on_one_key_are_both_heard(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def answer(name: str) -> Callable[[zenoh.Query], None]:
        def callback(query: zenoh.Query) -> None:
            with query:
                status = json.dumps({**STATUS, "instance": name}).encode()
                query.reply(KEYS.status, status, attachment=by[name].answered(query, KEYS.status, status))

        return callback

    by = {"a": own_authenticator(), "b": own_authenticator(), "liar": NO_KEY}
    with open_service([endpoint]) as hub, open_client(endpoint) as other, open_client(endpoint) as client:
        entities = [hub.declare_queryable(KEYS.status, answer("a")), other.declare_queryable(KEYS.status, answer("b"))]
        entities.append(other.declare_queryable(KEYS.status, answer("liar")))
        found = eventually(lambda: len(found := statuses(client)) == 2 and found)
        assert [status["instance"] for status in found] == ["a", "b"]
        assert statuses(client, axis="nobody") == []
        for entity in entities:
            entity.undeclare()


@dataclass
class Ended:
    """What a command printed and how it ended."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def dehyst(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """The command line, in this process: a start of the interpreter costs more than all that is looked at here."""

    def run(*args: str) -> Ended:
        status = main(args)
        return Ended(status, *capsys.readouterr())

    return run


@pytest.mark.e2e
def test_the_commands_against_a_real_service(
    serve: Callable[..., Any], dehyst: Callable[..., Ended], tmp_path: Path
) -> None:
    process = serve(
        ("x", "y"),
        extra=f'recorder = "{tmp_path}/rec-{{axis}}"\ncheckpoints = "{tmp_path}/ckpt-{{axis}}"\ncheckpoint_s = 0.1',
    )
    at = ("--endpoint", process.endpoint, "--who", "alice")
    began_at = time.time()
    with Client.connect(process.endpoint, axis="y", timeout_s=5.0) as client, open_client(process.endpoint) as stage:
        for first in range(0, 1000, 20):
            stage.put(client.keys.sample, samples(first, 20), congestion_control=zenoh.CongestionControl.BLOCK)
        eventually(lambda: client.status()["seq"] == 999)
        frozen = dehyst("freeze", *at, "--axis", "y", "--json")
        assert json.loads(frozen.stdout)["seq"] == 999
        learnt = client.status()["samples"]["learnt"]
        stage.put(client.keys.sample, samples(1000, 100))
        eventually(lambda: client.status()["seq"] == 1099)
        status = client.status()
        assert (status["frozen"], status["samples"]["learnt"]) == (True, learnt)
        assert dehyst("thaw", *at, "--axis", "y").stdout == "demo/y: thaw from sample 1099 on\n"
        assert client.point(40.0).model != "linear"
        assert "served linear" in dehyst("select", "linear", *at, "--axis", "y").stdout
        assert client.point(40.0).model == "linear"
        listed = json.loads(dehyst("checkpoints", *at, "--axis", "y", "--json").stdout)["result"]["checkpoints"]
        assert len(listed) > 1
        # Older ones may give way to one that is being written; the newest few do not.
        back = dehyst("rollback", str(listed[1]["checkpoint"]), *at, "--axis", "y")
        assert back.returncode == 0, back.stderr
        refused = dehyst("rollback", "987654321", *at, "--axis", "y")
        assert refused.returncode == 2
        assert "checkpoint" in refused.stderr
        status = client.status()
        assert status["operations"]["refused"] == 1
        assert status["operations"]["done"] == 5
    journal = [json.loads(line) for line in (tmp_path / "rec-y" / "operations.jsonl").read_text().splitlines()]
    assert {line["who"] for line in journal} == {"alice"}
    assert [line["verb"] for line in journal] == ["freeze", "thaw", "select", "checkpoints", "rollback", "rollback"]
    assert (journal[2]["arguments"], journal[2]["seq"]) == ({"model": "linear"}, 1099)
    times = [began_at, *(line["time_unix_s"] for line in journal), time.time()]
    assert times == sorted(times)
    assert [line["ok"] for line in journal] == [True] * 5 + [False]
    once = dehyst("status", "--endpoint", process.endpoint, "--once")
    assert [line.split()[0] for line in once.stdout.splitlines()] == ["stage/axis", "demo/x", "demo/y"]
    axes = json.loads(dehyst("status", "--endpoint", process.endpoint, "--once", "--json", "--axis", "y").stdout)[
        "axes"
    ]
    assert [(status["axis"], status["role"]) for status in axes] == [("y", "primary")]
    assert axes[0]["memory"]["resident_bytes"] > 5e7
    assert axes[0]["checkpoints"]["age_s"] is not None
    assert dehyst("status", "--endpoint", process.endpoint, "--once", "--stage", "none").returncode == 1


@pytest.mark.e2e
def test_the_live_table_goes_on_until_ctrl_c_and_ends_cleanly(serve: Callable[..., Any]) -> None:
    process = serve()
    live = subprocess.Popen(
        [sys.executable, "-m", "dehyst.lab.cli", "status", "--endpoint", process.endpoint, "--period", "0.2", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert live.stdout is not None
    lines = [json.loads(live.stdout.readline()) for _ in range(3)]
    assert [line["axes"][0]["axis"] for line in lines] == ["x", "x", "x"]
    live.send_signal(signal.SIGINT)
    _, err = live.communicate(timeout=20)
    assert (live.returncode, err) == (0, "")


def test_a_standby_takes_no_commands() -> None:
    axis = FakeAxis()
    server, _ = make(axis, None, role="standby")
    with pytest.raises(ServiceError, match="only a primary"):
        server.handle(ask("freeze"))
    assert axis.done == []
