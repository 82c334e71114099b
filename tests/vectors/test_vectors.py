"""The test vectors of the protocol, against the service's evaluator, the Python follower and the page-only client."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh

from dehyst.adaptive.errors import InputError
from dehyst.service.answers.answering import Served, answer
from dehyst.service.answers.guard import Limits
from dehyst.service.client import follower as follower_module
from dehyst.service.client.follower import Follower
from dehyst.service.config.settings import AxisConfig
from dehyst.service.fleet.wire import decode_fleet
from dehyst.service.protocol.delta import decode_delta
from dehyst.service.protocol.errors import NoReplyError
from dehyst.service.protocol.model import ModelMessage, decode_model
from dehyst.service.protocol.query import Trajectory, decode_query, decode_reply
from dehyst.service.protocol.samples import decode_command, decode_reference, decode_samples
from dehyst.service.security.authenticator import Authenticator, HeardSamples
from tests.service.protocol import page_client
from tests.vectors import make_vectors as vectors

FOLDER = vectors.DEFAULT_OUT
TOLERANCE = 1e-12


class Line(NamedTuple):
    """One line of ``cases.txt``."""

    case: str
    model: str
    query: str
    reply: str
    continues: str
    limits: Limits
    age_s: float

    def payload(self, kind: str) -> bytes:
        return (FOLDER / getattr(self, kind)).read_bytes()


def table(name: str, folder: Path = FOLDER) -> list[list[str]]:
    return [line.split() for line in (folder / name).read_text().splitlines() if not line.startswith("#")]


LINES = [Line(*row[:5], Limits(*map(float, row[5:10])), float(row[10])) for row in table("cases.txt")]
every_case = pytest.mark.parametrize("line", LINES, ids=[line.case for line in LINES])


def assert_same(got: Trajectory | dict[str, Any], line: Line) -> None:
    """Voltages, deviations and memory to 1e-12, flags and names exactly."""
    expected = page_client.decode_reply(line.payload("reply"))
    if not isinstance(got, dict):
        got = got._asdict() | ({"model": f"{got.model}/{got.stand_in}"} if got.stand_in else {})
    for name in ("u_V", "std_V", "memory"):
        np.testing.assert_allclose(got[name], expected[name], rtol=TOLERANCE, atol=TOLERANCE, err_msg=name)
    assert list(got["flags"]) == expected["flags"]
    assert got["model"] == expected["model"]


def served(message: ModelMessage) -> tuple[Served, AxisConfig]:
    """A snapshot of a service with what a model payload holds."""
    safety, name = message.safety, message.name
    models, memories = {name: message.model}, {name: message.memory}
    if safety.stand_in is not None:
        models[safety.stand_in.name] = safety.stand_in.model
        memories[safety.stand_in.name] = safety.stand_in.memory
    other = "" if safety.stand_in is None else safety.stand_in.name
    config = AxisConfig(
        "x", Path("x.npz"), Limits(0.0, 1.0, 1.0), served=name if safety.blends else "another",
        learn=name if safety.stale_s > 0.0 and name != "auto" else vectors.LEARNING, blend_share=safety.blend_share,
        stale_s=safety.stale_s, last_good_s=safety.last_good_s,
    )  # fmt: skip
    seq = message.snapshot_seq
    return Served(seq, seq * 1e-3, 3.0, models, memories, config.served, other, safety.trust), config


@every_case
@pytest.mark.filterwarnings("ignore:overflow")
def test_the_service_reproduces_the_vectors(line: Line) -> None:
    snapshot, config = served(decode_model(line.payload("model")))
    age_s = 0.0 if math.isnan(line.age_s) else line.age_s
    got = answer(decode_query(line.payload("query")), (snapshot,), snapshot.seq, config, line.limits, age_s)
    assert_same(got, line)
    expected = decode_reply(line.payload("reply"))
    assert (got.tracked_memory, got.fallback, got.behind) == (expected.tracked_memory, expected.fallback, False)
    assert got.snapshot_seq == expected.snapshot_seq


@every_case
@pytest.mark.filterwarnings("ignore:overflow")
def test_a_client_from_the_page_alone_reproduces_the_vectors(line: Line) -> None:
    message = page_client.decode_model(line.payload("model"))
    query = page_client.decode_query(line.payload("query"))
    limits = (line.limits.u_min_V, line.limits.u_max_V, line.limits.slew_V_per_s)
    assert_same(page_client.answer(message, query, limits, line.age_s), line)


class Wire:
    """A session that hands models to a follower, and the clock by which the follower judges their age."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        self._deliver: Callable[[Any], None]
        monkeypatch.setattr(follower_module, "time", SimpleNamespace(monotonic=lambda: self.now_s))

    def declare_subscriber(self, key: str, deliver: Callable[[Any], None]) -> Any:
        self._deliver = deliver
        return SimpleNamespace(undeclare=lambda: None)

    def send(self, payload: bytes) -> None:
        self._deliver(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


def follow(wire: Any, line: Line) -> Follower:
    payload = line.payload("model")
    session: zenoh.Session = wire
    made = Follower(session, "model", decode_model(payload).name, lambda: payload, line.limits)
    if not math.isnan(line.age_s):
        wire.send(payload)  # from the second message on more are expected
        wire.now_s += line.age_s
    return made


# What the follower leaves to a query: samples under way, and a voltage from which the slew limit begins.
FOLLOWED = [
    line for line in LINES
    if line.continues == "-" and decode_query(line.payload("query")).pending is None
    and math.isnan(decode_query(line.payload("query")).u_before_V)
]  # fmt: skip


@pytest.mark.parametrize("line", FOLLOWED, ids=[line.case for line in FOLLOWED])
@pytest.mark.filterwarnings("ignore:overflow")
def test_the_follower_reproduces_the_vectors(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    made = follow(Wire(monkeypatch), line)
    query = decode_query(line.payload("query"))
    made.trajectory(query.y_um, query.v_um_per_s, query.a_um_per_s2)
    got = made.last_trajectory
    assert got is not None
    assert_same(got._replace(model=made.name), line)


def test_the_follower_goes_along_a_jump_with_its_own_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    chain = [line for line in LINES if line.case.startswith("follow-")]
    wire = Wire(monkeypatch)
    made = follow(wire, chain[0])
    gains = []
    for before, line in zip([chain[0], *chain], chain, strict=False):
        assert line.continues == ("-" if line is chain[0] else before.case)
        if line.model != before.model:
            wire.send(line.payload("model"))
        model: Any = made.model
        gains.append(model.models[0].features.gain)
        query = decode_query(line.payload("query"))
        if query.y_um.size == 1:  # a single point takes another path
            made.point(query.y_um.item(), query.v_um_per_s.item(), query.a_um_per_s2.item())
            expected = decode_reply(line.payload("reply"))
            assert made._u_before_V == pytest.approx(expected.u_V.item(), rel=TOLERANCE, abs=TOLERANCE)
            assert made.last_std_V == pytest.approx(expected.std_V.item(), rel=TOLERANCE, abs=TOLERANCE)
            assert made.last_flags == expected.flags.item()
            np.testing.assert_allclose(made.memory, expected.memory, rtol=TOLERANCE, atol=TOLERANCE)
            continue
        made.trajectory(query.y_um, query.v_um_per_s, query.a_um_per_s2)
        assert made.last_trajectory is not None
        assert_same(made.last_trajectory._replace(model=made.name), line)
    assert gains[0] == 1.0
    assert 0.94 in gains


def test_the_vectors_hold_what_the_page_promises() -> None:
    flags = {flag for line in LINES for flag in page_client.decode_reply(line.payload("reply"))["flags"]}
    assert {bit for bit in (1, 2, 4, 8, 16, 32, 64) if any(flag & bit for flag in flags)} == {1, 2, 4, 8, 16, 32, 64}
    kinds = {page_client.decode_model(path.read_bytes())["kind"] for path in FOLDER.glob("*.model.payload")}
    assert kinds == {"linear", "lssvm", "bouc_wen", "mpi", "champion"}
    sizes = [path.stat().st_size for path in FOLDER.iterdir()]
    assert max(sizes) < 200_000
    assert sum(sizes) < 2_000_000


@pytest.mark.parametrize("changed", [{"gain": 1.0}, {"offset_um": 0.0}, {"anchor": []}, {"dead_um": 0.0}])
def test_a_client_that_leaves_out_a_step_of_the_page_is_noticed(changed: dict[str, Any]) -> None:
    line = next(line for line in LINES if line.case == "lssvm-jumped-30")
    message = page_client.decode_model(line.payload("model"))
    query = page_client.decode_query(line.payload("query"))
    for key, value in changed.items():
        into = message["data"] if isinstance(value, list) else message["values"]
        into[key if key == "anchor" else f"features.{key}"] = value
    got = page_client.answer(message, query)
    expected = page_client.decode_reply(line.payload("reply"))
    assert float(np.max(np.abs(np.subtract(got["u_V"], expected["u_V"])))) > 1e-6


def columns_of(name: str) -> dict[str, dict[str, list[float]]]:
    """The values of a table by file and field."""
    read: dict[str, dict[str, list[float]]] = {}
    for file, field, _, value in table(name):
        read.setdefault(file, {}).setdefault(field, []).append(float(value))
    return read


def test_payloads_without_an_answer_hold_the_values_of_the_table() -> None:
    read = columns_of("payloads.txt")
    assert set(read) == {"samples.payload", "command.payload", "reference.payload"}
    for file, fields in read.items():
        got = page_client.decode_plain((FOLDER / file).read_bytes())
        assert got.keys() == fields.keys()
        for name, values in fields.items():
            np.testing.assert_array_equal(got[name], values)


def test_payloads_of_a_fleet_hold_the_values_of_the_table() -> None:
    read = columns_of("fleet.txt")
    assert len(read) == 5
    for file, fields in read.items():
        data = (FOLDER / file).read_bytes()
        first, got = page_client.decode_fleet(data)
        assert got.keys() == fields.keys()
        for name, values in fields.items():
            np.testing.assert_array_equal(got[name], values)
        message = decode_fleet(data[1], data)
        assert message.first == first
        there = {name: np.ravel(part).tolist() for name, part in message.parts.items() if part is not None}
        np.testing.assert_equal(there, got)


class Step(NamedTuple):
    """One line of ``deltas.txt``."""

    name: str
    message: str
    file: str
    outcome: str
    base: str
    seq: str

    @property
    def payload(self) -> bytes:
        return (FOLDER / self.file).read_bytes()

    @property
    def reply(self) -> bytes | None:
        path = FOLDER / f"deltas-{self.name}.reply.payload"
        return path.read_bytes() if path.exists() else None


STEPS = [Step(*row) for row in table("deltas.txt")]
QUERY = FOLDER / "deltas.query.payload"
CHANGE_LIMITS = vectors.LIMITS


def expect(got: Any, reply: bytes) -> None:
    expected = page_client.decode_reply(reply)
    values = got if isinstance(got, dict) else got._asdict()
    for name in ("u_V", "std_V", "memory"):
        np.testing.assert_allclose(values[name], expected[name], rtol=TOLERANCE, atol=TOLERANCE, err_msg=name)
    assert list(values["flags"]) == expected["flags"]


def test_the_follower_of_changes_goes_through_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [STEPS[0].payload]
    wire: Any = Wire(monkeypatch)

    def fetch() -> bytes:
        if not answers:
            raise NoReplyError("nobody answers")
        return answers.pop()

    monkeypatch.setattr("dehyst.service.client.follower._FETCH_S", 0.0)
    made = Follower(wire, "delta", "auto", fetch, CHANGE_LIMITS)
    counts = lambda: (made.received, made.lost, made.refused)  # noqa: E731
    index = {"taken": 0, "lost": 1, "refused": 2}
    for last, step in itertools.pairwise(STEPS):
        before = counts()
        if step.message == "fetched":  # what a lost one asks for
            answers.append(step.payload)
            while made.received == before[0]:
                wire.send(last.payload)
                time.sleep(0.01)
        else:
            wire.send(step.payload)
        assert counts()[index[step.outcome]] == before[index[step.outcome]] + 1, (step.name, made.last_error)
        assert made.snapshot_seq == int(step.seq)
        if step.reply is not None:
            expect(made.answer(decode_query(QUERY.read_bytes())), step.reply)
    made.close()


def test_a_client_from_the_page_alone_goes_through_the_steps() -> None:
    client = page_client.Changes()
    query = page_client.decode_query(QUERY.read_bytes())
    limits = (CHANGE_LIMITS.u_min_V, CHANGE_LIMITS.u_max_V, CHANGE_LIMITS.slew_V_per_s)
    gains = []
    for step in STEPS:
        assert client.take(step.payload) == step.outcome, step.name
        assert f"{client.base:08x}" == step.base, step.name
        message = client.model()
        assert message["snapshot_seq"] == int(step.seq)
        gains.append(message["values"]["lssvm_adaptive.features.gain"])
        if step.reply is not None:
            expect(page_client.answer(message, query, limits), step.reply)
    assert gains[:3] == [1.0, 0.98, 0.94]  # the stage's gain has dropped, and the changes alone have told it


@pytest.mark.parametrize(("file", "kind", "field"), table("refused.txt"))
def test_the_service_refuses_with_the_field_of_the_table(file: str, kind: str, field: str) -> None:
    decode: dict[str, Callable[[bytes], Any]] = {
        "1": decode_samples, "2": decode_command, "3": decode_reference, "4": decode_query, "6": decode_model,
        "7": decode_delta,
    }  # fmt: skip
    with pytest.raises(InputError) as caught:
        decode[kind]((FOLDER / file).read_bytes())
    assert vars(caught.value)["field"] == field


def parts_of(row: list[str]) -> tuple[bytes | str, ...]:
    """What the tag of a line of ``authenticators.txt`` is made of, by the page."""
    _, kind, key, stamp, parameters, asked_stamp, asked, payload, _ = ("" if cell == "-" else cell for cell in row)
    query, said = ((FOLDER / name).read_bytes() if name else b"" for name in (asked, payload))
    stamps = bytes.fromhex(stamp), bytes.fromhex(asked_stamp)
    return {
        "reply": ("reply", key, *stamps, parameters, query, said),
        "put": ("put", key, stamps[0], said),
        "query": ("query", key, stamps[0], parameters, said),
        "claim": ("claim", key),
    }[kind]


def test_service_and_page_make_the_same_authenticators() -> None:
    rows = table("authenticators.txt")
    assert {row[1] for row in rows} == {"reply", "put", "query", "claim"}
    secret = bytes.fromhex((FOLDER / "authenticators.txt").read_text().split()[2])
    for row in rows:
        parts = parts_of(row)
        assert page_client.tag(secret, *parts).hex() == row[-1], row[0]
        assert Authenticator(secret).tag(*parts).hex() == row[-1], row[0]


def test_a_client_from_the_page_alone_believes_what_is_signed() -> None:
    secret = bytes.fromhex((FOLDER / "authenticators.txt").read_text().split()[2])
    found = {row[0]: row for row in table("authenticators.txt")}
    _, key, stamp, asked_stamp, parameters, asked, said = parts_of(found["model"])
    assert isinstance(key, str)
    assert isinstance(parameters, str)
    assert all(isinstance(part, bytes) for part in (stamp, asked_stamp, asked, said))
    trust, right = page_client.Trust(secret), bytes.fromhex(found["model"][3] + found["model"][-1])
    asked_with = bytes.fromhex(found["model"][5])
    payload = (FOLDER / found["model"][7]).read_bytes()
    change, told = bytes.fromhex(found["change"][3] + found["change"][-1]), (FOLDER / found["change"][7]).read_bytes()
    assert not trust.publication(found["change"][2], change, told)  # it does not know the service yet
    assert not trust.reply(key, bytes(16), parameters, b"", right, payload)
    assert not trust.reply(key, asked_with, parameters, b"", right, payload + b"x")
    assert trust.reply(key, asked_with, parameters, b"", right, payload)
    assert not trust.publication(found["change"][2], change, told)  # it is in the model: not after it
    trust.number -= 1
    assert not trust.publication(found["change"][2], change, told[:-1])
    assert [trust.publication(found["change"][2], change, told) for _ in range(2)] == [True, False]
    stage, heard = page_client.Stage(secret), HeardSamples(Authenticator(secret), "key")
    for number in range(3):
        attached = SimpleNamespace(to_bytes=lambda number=number: stage.attachment("key", b"samples"))
        message: Any = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: b"samples"), attachment=attached)
        assert heard.take(message) == b"samples", number


def test_the_command_makes_the_same_vectors(tmp_path: Path) -> None:
    vectors.write(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in FOLDER.iterdir()}
    for made in tmp_path.iterdir():
        old, new = (FOLDER / made.name).read_bytes(), made.read_bytes()
        if old == new:
            continue
        # The last bits of memories and answers depend on the processor.
        if made.name in ("correction.txt", "repetition.txt"):
            for before, now in zip(table(made.name), table(made.name, tmp_path), strict=True):
                compare_cells(before, now)
            continue
        assert len(old) == len(new), made.name
        for kind, decode in (
            (".model.", page_client.decode_model),
            (".fetched.", page_client.decode_model),
            (".query.", page_client.decode_query),
            (".reply.", page_client.decode_reply),
        ):
            if kind in made.name:
                compare(decode(old), decode(new))
                break
        else:
            pytest.fail(f"{made.name}: not the bytes of the command; run python -m tests.vectors.make_vectors")


def compare_cells(old: list[str], new: list[str]) -> None:
    for before, now in zip(old, new, strict=True):
        if before != now:
            np.testing.assert_allclose(float(now), float(before), rtol=TOLERANCE, atol=TOLERANCE)


def compare(old: dict[str, Any], new: dict[str, Any]) -> None:
    assert old.keys() == new.keys()
    for key, value in old.items():
        if isinstance(value, dict):
            compare(value, new[key])
        elif isinstance(value, float) or (
            isinstance(value, list | tuple) and value and all(isinstance(x, float) for x in value)
        ):
            np.testing.assert_allclose(new[key], value, rtol=TOLERANCE, atol=TOLERANCE)
        else:
            assert new[key] == value
