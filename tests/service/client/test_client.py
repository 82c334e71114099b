"""The client against a real service: a point, a trajectory, the model followed, and everything that goes wrong."""

from __future__ import annotations

import io
import json
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zenoh

from dehyst.adaptive.errors import InputError
from dehyst.lab.cli import main
from dehyst.service.answers.answering import derivatives
from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import (
    BehindError,
    NoReplyError,
    RefusedError,
    ReplyTimeoutError,
    SessionError,
    error_from_json,
    error_to_json,
)
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import LIMITED_SLEW, LIMITED_VOLTAGE
from dehyst.service.runtime.session import open_client, open_service
from dehyst.service.security.authenticator import own_authenticator
from tests.service.living import declared, eventually

pytestmark = pytest.mark.e2e
DT_S = 1e-3


@pytest.fixture
def client(shared_service: Any) -> Iterator[Client]:
    with Client.connect(shared_service.endpoint, timeout_s=5.0) as connected:
        yield connected


def next_seq(client: Client) -> int:
    """Where the samples of the test before ended, at the beginning of a snapshot's span."""
    return (int(client.status()["seq"]) // 20 + 2) * 20


def teach(client: Client, first: int, n: int) -> None:
    k = np.arange(first, first + n)
    y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * DT_S)
    client.samples(k, k * DT_S, (y - 1.0) / (11.0 * 0.95), y)


def test_points_and_trajectories_continue_each_other(client: Client) -> None:
    y = 40.0 + 0.1 * np.arange(30)
    v, a = np.full(30, 100.0), np.zeros(30)
    whole = client.trajectory(y, v, a)
    assert whole.u_V.shape == whole.std_V.shape == whole.flags.shape == (30,)
    assert whole.tracked_memory
    first = client.trajectory(y[:20], v[:20], a[:20])
    point = client.point(y[20], v[20], after=first)
    assert not point.tracked_memory
    rest = client.trajectory(y[21:], v[21:], a[21:], after=point)
    np.testing.assert_array_equal(np.concatenate([first.u_V, [point.u_V], rest.u_V]), whole.u_V)
    np.testing.assert_array_equal(rest.memory, whole.memory)
    # Velocity and acceleration are taken from the displacement where they are not given.
    np.testing.assert_allclose(client.trajectory(y).u_V, whole.u_V, atol=1e-9)


def test_as_of_waits_for_what_is_still_being_learnt(client: Client) -> None:
    first = next_seq(client)
    teach(client, first, 200)
    feeder = threading.Timer(0.3, teach, (client, first + 200, 200))
    feeder.start()
    try:
        answer = client.trajectory([40.0], as_of=first + 300, wait_s=10.0)
        assert answer.snapshot_seq == first + 300
    finally:
        feeder.join()
    with pytest.raises(BehindError, match="as_of"):
        client.trajectory([40.0], as_of=first + 5000, wait_s=0.05)


def test_the_follower_answers_as_the_service_does_and_keeps_up(client: Client) -> None:
    follower = client.follow(deltas=False)
    k, until = next_seq(client), time.monotonic() + 20.0
    while follower.received < 5 and time.monotonic() < until:
        teach(client, k, 20)
        k += 20
        time.sleep(0.02)
    assert follower.received >= 5
    assert follower.refused == 0
    assert follower.age_s < 5.0
    # The publication of the last snapshot may still be on its way.
    eventually(lambda: follower.snapshot_seq == k - 20)
    y = 40.0 + 3.0 * np.sin(np.arange(40) / 6.0)
    v, a = derivatives(y, None, None, client.dt_s)
    asked = client.trajectory(y, v, a, memory=follower.memory, as_of=follower.snapshot_seq)
    u, flags = follower.trajectory(y[:25], v[:25], a[:25])
    ones = [follower.point(*point) for point in zip(y[25:].tolist(), v[25:].tolist(), a[25:].tolist(), strict=True)]
    np.testing.assert_array_equal(np.concatenate([u, ones]), asked.u_V)
    np.testing.assert_array_equal(flags, asked.flags[:25])
    np.testing.assert_array_equal(follower.memory, asked.memory)


def test_a_lost_whole_model_is_fetched_and_the_follower_is_at_the_last_sample(client: Client) -> None:
    follower = client.follow()
    deliver: Any = follower._heard.take
    left_out: list[bytes] = []

    def lossy(sample: zenoh.Sample) -> bytes | None:
        """Leaves out the second whole model that comes."""
        payload: bytes | None = deliver(sample)
        if payload is not None and payload[1] == wire.MODEL and follower.received > 1 and not left_out:
            left_out.append(payload)
            return None
        return payload

    follower._heard.take = lossy  # type: ignore[method-assign]
    k, until = next_seq(client), time.monotonic() + 20.0
    first = k
    while time.monotonic() < until and k < first + 1000:
        teach(client, k, 5)
        k += 5
        time.sleep(0.004)
    assert follower.wait(k - 1, 20.0), "the newest state has seen the last sample, not only the last snapshot"
    assert left_out
    assert follower.received > 10
    assert follower.lost >= 1
    assert follower.refused == 0
    follower.close()


def test_commands_leave_within_the_limits_and_say_so_and_references_arrive(client: Client) -> None:
    got: list[float] = []
    wanted: list[wire.Block] = []
    subscribers = [
        client._session.declare_subscriber(
            client.keys.command, lambda sample: got.extend(wire.decode_command(sample.payload.to_bytes()).values)
        ),
        client._session.declare_subscriber(
            client.keys.reference, lambda sample: wanted.append(wire.decode_reference(sample.payload.to_bytes()))
        ),
    ]
    client.reference(6, [3.0])
    flags = [client.command(100, [1.0, 9.0, 50.0]), client.command(103, [9.0]), client.command(110, [9.5])]
    assert [f.tolist() for f in flags] == [[0, LIMITED_SLEW, LIMITED_VOLTAGE | LIMITED_SLEW], [LIMITED_SLEW], [0]]
    eventually(lambda: len(got) == 5 and wanted)
    assert got == pytest.approx([1.0, 3.0, 5.0, 7.0, 9.5])
    assert [(block.seq, block.values.tolist()) for block in wanted] == [(6, [3.0])]
    for subscriber in subscribers:
        subscriber.undeclare()


def test_the_follower_guards_what_leaves_too(client: Client) -> None:
    follower = client.follow("linear")
    low = follower.point(12.0)
    assert low == pytest.approx(1.0)
    assert follower.point(90.0) == pytest.approx(low + 2.0)
    for y_um, v in ((200.0, 0.0), (float("nan"), 0.0), (40.0, float("inf"))):
        with pytest.raises(InputError):
            follower.point(y_um, v)
        with pytest.raises(InputError):
            follower.trajectory([y_um, y_um], [v, v])
    with pytest.raises(RefusedError, match="sorcery"):
        client.follow("sorcery")


@pytest.mark.parametrize("wrong", ["40", [1.5]], ids=repr)
def test_an_argument_that_is_no_number_is_named(client: Client, wrong: Any) -> None:
    for field, ask in (
        ("y_um", lambda: client.point(wrong)),
        ("v_um_per_s", lambda: client.point(40.0, wrong)),
        ("u_before_V", lambda: client.point(40.0, u_before_V=wrong)),
        ("as_of", lambda: client.point(40.0, as_of=wrong)),
        ("wait_s", lambda: client.point(40.0, wait_s=wrong)),
        ("wait_s", lambda: client.wait_learnt(0, wrong)),
        ("wait_s", lambda: client.take_command(wrong)),
        ("seq", lambda: client.wait_learnt(wrong)),
        ("seq", lambda: client.command(wrong, 1.0)),
        ("seq", lambda: client.reference(wrong, 1.0)),
    ):
        with pytest.raises(InputError, match=f"^{field}: got "):
            ask()
    for field, ask in (
        ("keep", lambda: client.follow(keep=wrong)),
        ("memory", lambda: client.follow(memory="40")),
        ("after", lambda: client.trajectory([40.0], after=wrong)),
        ("begin", lambda: client.point(40.0, begin=wrong)),
        ("model", lambda: client.follow(40)),  # type: ignore[arg-type]
        ("y_um", lambda: client.trajectory("40")),
    ):
        with pytest.raises(InputError, match=f"^{field}: got "):
            ask()


def test_nobody_there(free_port: int) -> None:
    with pytest.raises(SessionError, match="no answer at"):
        Client.connect(f"tcp/127.0.0.1:{free_port}")
    for wrong in ("localhost", None, 7447, [7447], []):
        with pytest.raises(InputError, match=r"^endpoint: got "):
            Client.connect(wrong)  # type: ignore[arg-type]
    for field in ("key", "zenoh_config"):
        for wrong in (b"a.key", 1.5, ["a.key"], {}):
            with pytest.raises(InputError, match=f"^{field}: got "):
                Client.connect(f"tcp/127.0.0.1:{free_port}", **{field: wrong})  # type: ignore[arg-type]
    for field in ("timeout_s", "wait_s", "retry_s"):
        for wrong in ("1", None, [1.5], -1.0, float("nan")):
            with pytest.raises(InputError, match=f"^{field}: got "):
                Client.connect(f"tcp/127.0.0.1:{free_port}", **{field: wrong})  # type: ignore[arg-type]


def test_a_service_that_does_not_answer_in_time(free_port: int) -> None:
    """A queryable of the right name that keeps its queries for too long."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    release = threading.Event()
    keys = Keys("demo", "x")

    def slow(query: zenoh.Query) -> None:
        with query:
            release.wait(10.0)

    with open_service([endpoint]) as server:
        server.declare_queryable(keys.feedforward, slow)
        server.declare_queryable(keys.status, slow)
        try:
            with pytest.raises(ReplyTimeoutError, match=r"no answer within 0\.2 s"):
                Client.connect(endpoint, timeout_s=0.2)
        finally:
            release.set()


def ask_until_unanswered(client: Client) -> None:
    for _ in range(1000):
        client.status()


def test_every_question_is_repeated_while_another_service_takes_over(free_port: int) -> None:
    endpoint, keys = f"tcp/127.0.0.1:{free_port}", Keys("demo", "x")

    by, limits = own_authenticator(), Limits(0.0, 10.0, 2000.0).to_json()
    status = {"stage": "demo", "axis": "x", "dt_s": DT_S, "limits": limits, "instance": "a"}

    def tell(query: zenoh.Query) -> None:
        with query:
            payload = json.dumps(status).encode()
            query.reply(keys.status, payload, attachment=by.answered(query, keys.status, payload))

    with open_service([endpoint]) as server:
        first = server.declare_queryable(keys.status, tell)
        with (
            Client.connect(endpoint, timeout_s=2.0, wait_s=5.0, retry_s=20.0) as patient,
            Client.connect(endpoint, timeout_s=2.0, wait_s=5.0, retry_s=0.0) as hasty,
        ):
            assert patient.status()["instance"] == "a"
            assert patient.retries == 0
            first.undeclare()  # type: ignore[no-untyped-call]
            with pytest.raises(NoReplyError):
                ask_until_unanswered(hasty)  # its session has to hear of it
            again = threading.Timer(0.3, lambda: server.declare_queryable(keys.status, tell))
            again.start()
            assert patient.status()["instance"] == "a"
            again.join()
            assert patient.retries > 0
            assert hasty.retries == 0


def test_errors_keep_the_words_of_the_service() -> None:
    refused = error_from_json(error_to_json(ValueError("no")))
    assert isinstance(refused, RefusedError)
    assert (refused.kind, str(refused)) == ("ValueError", "no")
    assert isinstance(error_from_json(b"Timeout"), ReplyTimeoutError)
    assert isinstance(error_from_json(b"\xff\xfe"), RefusedError)
    assert isinstance(error_from_json(b"[1]"), RefusedError)


def test_the_command_asks_a_running_service(
    shared_service: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def query(*args: str, stdin: str = "") -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "stdin", io.StringIO(stdin))
        code = main(["query", *args, "--endpoint", shared_service.endpoint, "--timeout", "5"])
        return code, *capsys.readouterr()

    answer = json.loads(query("12", "23", "--model", "linear", "--json")[1])
    assert answer["u_V"] == pytest.approx([1.0, 2.0])
    assert (answer["model"], answer["flags"]) == ("linear", [[], []])
    code, table, _ = query("--from", "-", "--model", "linear", stdin="y_um,v\n12,0\n34,0\n")
    assert code == 0
    rows = [line.split() for line in table.splitlines() if not line.startswith("#")]
    assert [float(row[1]) for row in rows] == pytest.approx([1.0, 3.0])
    assert [row[3:] for row in rows] == [[], []]
    assert json.loads(query("--status", "--json")[1])["stage"] == "demo"
    for args, words in (
        (("12", "300"), "y_um[1]: got 300 µm, expected -4.5 to 94.5 µm"),
        (("nan",), "y_um[0]: got nan, expected a finite number"),
        (("12", "--model", "sorcery"), "expected one of linear"),
        (("12", "--axis", "q"), "no reply within"),
        (("12", "--axis", "Q"), "axis: got 'Q'"),
        (("12", "13", "--v", "3"), "a single point"),
        ((), "--from"),
        (("--from", "-"), "columns"),
        (("--from", "/nowhere"), "readable CSV"),
    ):
        code, _, complaint = query(*args)
        assert code == 2, args
        assert words in complaint


def test_no_command_of_a_burst_is_dropped(client: Client, shared_service: Any) -> None:
    """Zenoh's default drops one message in some hundred where several wait: a voltage that never comes."""
    bursts, each = 100, 20
    seen: list[int] = []
    with open_client(shared_service.endpoint) as stage:
        stage.declare_subscriber(
            client.keys.command, lambda s: seen.append(wire.decode_command(s.payload.to_bytes()).seq)
        )
        declared(stage, client._session)
        for burst in range(bursts):
            for i in range(each):
                client.command(burst * each + i, [1.0])
            time.sleep(0.005)
        eventually(lambda: len(seen) == bursts * each)
    assert seen == list(range(bursts * each))
