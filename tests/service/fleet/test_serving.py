"""A fleet of 64 axes as a real process over loopback, and its payloads."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.fleet.fleet import Fleet, FleetConfig
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import Sample, prefixed, under
from dehyst.service.answers.guard import Limits
from dehyst.service.client.follower import Follower
from dehyst.service.config.learner import learner_config
from dehyst.service.config.settings import AxisConfig, parse_config
from dehyst.service.fleet import wire
from dehyst.service.fleet.checkpoints import FleetCheckpoints
from dehyst.service.operating.remote import operate
from dehyst.service.protocol.errors import RefusedError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.model import decode_model, digests
from dehyst.service.protocol.query import LIMITED_VOLTAGE
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.runtime.session import open_client
from dehyst.service.security.authenticator import Authenticator
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.checkpoint import CheckpointMeta, decode_checkpoint, encode_checkpoint
from dehyst.service.storage.model_file import Bundle, BundleMeta, write_bundle
from tests.service.conftest import ServeProcess, make_models, unused_port
from tests.service.living import eventually

DT_S, AXES = 1e-3, 64
GAINS = 1.0 + 0.002 * np.arange(AXES)
KEYS = Keys("mirror", "fleet")


def configuration(port: int, more: str = "") -> str:
    return (
        f'stage = "mirror"\nlisten = ["tcp/127.0.0.1:{port}"]\n[fleet]\naxes = {AXES}\nmodels = ["x.npz"]\n'
        f"u_min_V = 0.0\nu_max_V = 10.0\nslew_V_per_s = 2000.0\ny_min_um = -5.0\ny_max_um = 110.0\n"
        f"gains = {GAINS.tolist()}\nsnapshot_every = 10\n{more}"
    )


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServeProcess]:
    folder, port = tmp_path_factory.mktemp("fleet"), unused_port()
    write_bundle(folder / "x.npz", make_models(), BundleMeta("", "", DT_S, y_min_um=0.0, y_max_um=90.0))
    path = folder / "serve.toml"
    path.write_text(configuration(port), encoding="utf-8")
    process = ServeProcess(path, port)
    yield process
    process.kill()


def motion(first: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """seq, t_s (n,), voltages and readings (n, 64) of stages of 11 µm/V and a gain of their own."""
    k = np.arange(first, first + n)
    stage_um = 45.0 + 30.0 * np.sin(2.0 * np.pi * 3.0 * k * DT_S)[:, None]
    return k, k * DT_S, np.repeat((stage_um - 1.0) / 11.0, AXES, 1), stage_um * GAINS


def samples(seq: np.ndarray, t_s: np.ndarray, u_V: np.ndarray, y_um: np.ndarray, first: int = 0) -> bytes:
    return wire.encode_fleet(wire.FLEET_SAMPLES, first, seq=seq, t_s=t_s, u_V=u_V, y_um=y_um)


def send(session: zenoh.Session, payload: bytes) -> None:
    """Publish samples; the sender waits where the network is full, so that none is lost."""
    session.put(KEYS.sample, payload, congestion_control=zenoh.CongestionControl.BLOCK)


def query(y_um: np.ndarray, memory: np.ndarray | None = None, u_before_V: np.ndarray | None = None) -> bytes:
    """A query of resting points."""
    still, rest = np.zeros_like(y_um), {"memory": memory, "u_before_V": u_before_V}
    return wire.encode_fleet(wire.FLEET_QUERY, y_um=y_um, v_um_per_s=still, a_um_per_s2=still, **rest)


def reply_to(session: zenoh.Session, payload: bytes) -> dict[str, Any]:
    return wire.decode_fleet(wire.FLEET_REPLY, ask(session, KEYS.feedforward, payload)).parts


def ask(session: zenoh.Session, key: str, payload: bytes = b"") -> Any:
    """The reply to a query: its bytes, or what a refusal says as a dictionary."""
    reply = next(iter(session.get(key, payload=payload, timeout=60.0)))  # the first one compiles
    return reply.ok.payload.to_bytes() if reply.ok is not None else json.loads(reply.err.payload.to_bytes())


def status(session: zenoh.Session, **of: int) -> dict[str, Any]:
    said: dict[str, Any] = json.loads(ask(session, KEYS.status, json.dumps(of).encode() if of else b""))
    return said


def follow_one_axis(session: zenoh.Session) -> None:
    """An axis is followed as a model of a service is: changes, and whole models now and then."""
    limits, of, key = Limits(0.0, 10.0, 2000.0), b'{"axis": 9, "changes": true}', f"{KEYS.model_delta}/9"
    follower = Follower(session, key, "lssvm_adaptive", lambda: ask(session, KEYS.model, of), limits)
    before = follower.model.state_dict()
    for first in range(1801, 2401, 20):
        send(session, samples(*motion(first, 20)))
        eventually(lambda: status(session)["samples"]["waiting"] < 100)
    eventually(lambda: status(session)["seq"] == 2400)
    assert status(session)["followed"] == 1
    now = decode_model(ask(session, KEYS.model, b'{"axis": 9}')).model.state_dict()
    for name in ("support", "alpha", "beta"):
        eventually(lambda name=name: np.array_equal(follower.model.state_dict()[name], now[name]))  # type: ignore[misc]
        assert not np.array_equal(before[name], now[name])
    assert follower.received > 2
    assert (follower.lost, follower.refused) == (0, 0)
    follower.close()
    eventually(lambda: status(session)["followed"] == 0)


@pytest.mark.e2e
def test_a_fleet_learns_answers_and_refuses_axis_by_axis(service: ServeProcess) -> None:
    changes: list[wire.FleetMessage] = []
    with open_client(service.endpoint) as session:
        session.declare_subscriber(
            KEYS.model, lambda s: changes.append(wire.decode_fleet(wire.FLEET_CHANGES, s.payload.to_bytes()))
        )
        for first in range(0, 600, 20):
            send(session, samples(*motion(first, 20)))
        eventually(lambda: status(session)["seq"] == 599)
        before = status(session)
        assert before["gates"]["learnt"] > 50 * AXES
        assert len(before["worst"]) == 10
        errors = [one["rms_error_pct"] for one in before["worst"]]
        assert errors == sorted(errors, reverse=True)
        assert errors[0] == before["rms_error_pct"]["max"]
        # Axis 3 is missing, 5 has no reading, the message holds two axes too many; then it comes once more, late.
        seq, t_s, u, y = motion(600, 1)
        u, y = np.pad(u, ((0, 0), (0, 2))), np.pad(y, ((0, 0), (0, 2)))
        u[0, 3] = y[0, 3] = y[0, 5] = np.nan
        bad = samples(seq, t_s, u, y)
        early = samples(*motion(400, 5), first=0)
        for payload in (bad, bad, early, b"\x01\x08", b"\x01\x08" + bytes(40)):
            send(session, payload)
        eventually(lambda: status(session)["samples"]["malformed"] == 2)
        after = eventually(lambda: (now := status(session))["samples"]["received"] == 607 and now)
        assert after["samples"]["missing"] == 2
        assert after["samples"]["unknown_axes"] == 4
        assert after["gates"]["duplicate"] == AXES - 2
        # Batches out of order are refused for each of their axes, and counted.
        assert after["gates"]["out_of_order"] == 5 * AXES
        assert status(session, axis=3)["gates"]["out_of_order"] == 5
        assert after["gates"]["not_finite"] == 2
        # What is refused of one axis costs the others nothing. Now half of the axes a message, and one actuator dead.
        for first in range(601, 1801, 20):
            seq, t_s, u, y = motion(first, 20)
            y[:, 20] = 40.0
            send(session, samples(seq, t_s, u[:, :32], y[:, :32]))
            send(session, samples(seq, t_s, u[:, 32:], y[:, 32:], first=32))
            eventually(lambda: status(session)["samples"]["waiting"] < 500)
        eventually(lambda: status(session)["samples"]["received"] == 607 + 2400)
        now = eventually(lambda: (now := status(session))["seq"] >= 1799 and now)
        assert (now["samples"]["missing"], now["samples"]["dropped"]) == (2, 0)
        assert (now["worst"][0]["axis"], now["worst"][0]["trouble"]) == (20, "sensor_stuck")
        assert now["in_trouble"] == 1
        one, other = status(session, axis=5), status(session, axis=6)
        assert one["gates"]["not_finite"] == 2
        assert other["gates"]["not_finite"] == 0
        assert one["trouble"] == other["trouble"] == ""
        assert ask(session, KEYS.status, b'{"axis": 64}')["field"] == "axis"
        # One query for all axes: the same place of the stages is another reading of each axis.
        at = np.full((2, AXES), 40.0) * GAINS
        at[1, 7], at[0, 8] = np.nan, 1e4
        reply = reply_to(session, query(at))
        refused = np.zeros((2, AXES), dtype=np.bool_)
        refused[1, 7] = refused[:, 8] = True
        np.testing.assert_array_equal(reply["flags"] == wire.REFUSED, refused)
        np.testing.assert_array_equal(np.isnan(reply["u_V"]), refused)
        np.testing.assert_allclose(reply["u_V"][~refused], 39.0 / 11.0, atol=0.1)
        # Its own memory gives the same answer again.
        whole, before_V = np.full((1, AXES), 41.0) * GAINS, np.full(AXES, 3.0)
        again = [reply_to(session, query(whole, reply["memory"], before_V)) for _ in range(2)]
        np.testing.assert_array_equal(again[0]["u_V"], again[1]["u_V"])
        assert again[0]["u_V"].max() <= 5.0
        wrong = ask(session, KEYS.feedforward, query(whole, reply["memory"][:, :3]))
        assert wrong["field"] == "columns"
        # Changes are small, and a whole model comes on demand.
        eventually(lambda: bool(changes))
        assert changes[-1].parts["beta"].shape[1] == make_models()["lssvm_adaptive"].state_dict()["beta"].size
        model = decode_model(ask(session, KEYS.model, b'{"axis": 9}')).model
        assert model.features.gain == pytest.approx(GAINS[9], rel=0.05)  # type: ignore[attr-defined]
        assert len(list(session.liveliness().get(f"{KEYS.base}/alive/*"))) == 1
        follow_one_axis(session)
    code, last, complaints = service.stop()
    assert (code, complaints) == (0, "")
    assert last["fleet"]["samples"]["points_refused"] == 3


@pytest.mark.e2e
def test_a_killed_fleet_goes_on_from_its_checkpoints(tmp_path: Path) -> None:
    write_bundle(tmp_path / "x.npz", make_models(), BundleMeta("", "", DT_S, y_min_um=0.0, y_max_um=90.0))
    path, folder = tmp_path / "serve.toml", tmp_path / "kept"
    port = unused_port()
    path.write_text(configuration(port, 'checkpoints = "kept"\ncheckpoint_s = 0.5\n'), encoding="utf-8")
    process = ServeProcess(path, port)
    with open_client(process.endpoint) as session:
        for first in range(0, 900, 20):
            send(session, samples(*motion(first, 20)))
        eventually(lambda: status(session)["seq"] == 899)
        # Each axis is written after the last sample.
        written = status(session)["checkpoints"]["written"]
        for first in range(900, 2900, 20):
            send(session, samples(*motion(first, 20)))
            if status(session)["checkpoints"]["written"] > written + 2 * AXES:
                break
            time.sleep(0.02)
        learnt = status(session, axis=9)["gates"]["learnt"]
    process.kill()
    # The file of an axis is a single learner's: it goes on from there.
    meta, state = decode_checkpoint((folder / "axis-0009.ckpt").read_bytes())
    single = Learner.from_state(under("learner.", state))
    assert (meta.axis, single.seq) == ("axis-0009", meta.seq)
    assert single.snapshot().features.gain == pytest.approx(GAINS[9], rel=0.05)
    (folder / "axis-0011.ckpt").write_bytes(b"damaged")
    process = ServeProcess(path, port)
    try:
        with open_client(process.endpoint) as session:
            now = status(session)
            assert now["checkpoints"]["restored"] == AXES - 1
            assert now["checkpoints"]["refused"] == 1
            before = status(session, axis=9)["gates"]["learnt"]
            assert 0 < before <= learnt
            assert status(session, axis=11)["gates"]["learnt"] == 0
            # Whatever the number that the stage has come to, or began with again.
            for first in range(50, 250, 20):
                send(session, samples(*motion(first, 20)))
            eventually(lambda: status(session)["samples"]["received"] == 200)
            eventually(lambda: status(session, axis=9)["gates"]["learnt"] > before)
            assert status(session, axis=9)["gates"]["out_of_order"] == 0
    finally:
        process.kill()


@pytest.mark.e2e
def test_an_operator_freezes_axes_and_takes_them_back(tmp_path: Path) -> None:
    write_bundle(tmp_path / "x.npz", make_models(), BundleMeta("", "", DT_S, y_min_um=0.0, y_max_um=90.0))
    path, port = tmp_path / "serve.toml", unused_port()
    # Written where an operator commands it, and else not within this test.
    path.write_text(configuration(port, 'checkpoints = "kept"\ncheckpoint_s = 80000.0\n'), encoding="utf-8")
    process = ServeProcess(path, port)
    try:
        with open_client(process.endpoint) as session:
            # Of an axis that never had a sample nothing is written.
            assert operate(session, KEYS, "thaw", "alice", {"axes": [9]})["durable"] is False
            for first in range(0, 600, 20):
                send(session, samples(*motion(first, 20)))
            eventually(lambda: status(session)["seq"] == 599)
            answer = operate(session, KEYS, "freeze", "alice", {"axes": [9, 5]})
            assert (answer["durable"], answer["seq"], answer["result"]) == (True, 599, {"axes": [9, 5]})
            # What they serve stays, to the last bit; all others learn on.
            at = np.full((1, AXES), 40.0)
            memory = reply_to(session, query(at))["memory"]
            held, learnt = reply_to(session, query(at, memory)), status(session, axis=9)["gates"]["learnt"]
            for first in range(600, 800, 20):
                send(session, samples(*motion(first, 20)))
            eventually(lambda: status(session)["seq"] == 799)
            now = reply_to(session, query(at, memory))
            for name in ("u_V", "std_V"):
                changed = (now[name] != held[name]).any(0)
                assert np.flatnonzero(~changed).tolist() == [5, 9], name
            assert status(session)["frozen"] == [5, 9]
            assert status(session, axis=9)["gates"]["learnt"] == learnt
            for wrong in ({"axes": [64]}, {"axes": [True]}, {"axes": 3}, {}):
                with pytest.raises(RefusedError, match=r"arguments\.axes"):
                    operate(session, KEYS, "freeze", "alice", wrong)
            with pytest.raises(RefusedError, match="one of freeze, thaw, rollback"):
                operate(session, KEYS, "select", "alice", {"axes": [1]})
            stranger = Authenticator(b"a stranger's own one")
            with pytest.raises(RefusedError, match="authenticator"):
                operate(session, KEYS, "thaw", "mallory", {"axes": [9]}, authenticator=stranger)
            assert status(session)["frozen"] == [5, 9]
            assert status(session)["operations"] == {"done": 2, "refused": 5, "unsigned": 1, "unlogged": 0}
    finally:
        process.kill()
    lines = (tmp_path / "kept" / "operations.jsonl").read_text(encoding="utf-8").splitlines()
    said = [json.loads(line) for line in lines]
    done = [{name: one[name] for name in ("who", "verb", "arguments", "seq")} for one in said if one["ok"]]
    assert done[-1] == {"who": "alice", "verb": "freeze", "arguments": {"axes": [9, 5]}, "seq": 599}
    # Refused ones too, with the reason, as by a service of one axis.
    refused = [(one["verb"], one["arguments"], one["error"]) for one in said if not one["ok"]]
    assert refused[0][:2] == ("freeze", {"axes": [64]})
    assert refused[-1][:2] == ("select", {"axes": [1]})
    assert "one of freeze, thaw, rollback" in refused[-1][2]
    assert len(refused) == 5
    process = ServeProcess(path, port)
    try:
        with open_client(process.endpoint) as session:
            assert status(session)["frozen"] == [5, 9]
            # Written before the first sample after the restart too: a rollback returns to a state that is thawed.
            assert operate(session, KEYS, "thaw", "bob", {"axes": [5]})["durable"] is True
            assert status(session)["frozen"] == [9]
            before = status(session, axis=5)["gates"]["learnt"]
            for first in range(0, 400, 20):
                send(session, samples(*motion(first, 20)))
            eventually(lambda: status(session, axis=5)["gates"]["learnt"] > before)
            # Axis 7 was never written.
            answer = operate(session, KEYS, "rollback", "bob", {"axes": [5, 7]})
            assert answer["result"] == {"axes": [5]}
            assert status(session, axis=5)["gates"]["learnt"] == before
            assert status(session)["frozen"] == [9]
            with pytest.raises(RefusedError, match="none of these axes has a checkpoint"):
                operate(session, KEYS, "rollback", "bob", {"axes": [7]})
    finally:
        process.kill()


def test_an_axis_continues_from_the_file_of_a_service_of_one_axis(tmp_path: Path) -> None:
    """Its name is that of the file. What such a service keeps beside its learner is left out."""
    base = make_models()["lssvm_adaptive"]
    assert isinstance(base, LssvmInverse)
    config, single = LearnerConfig(window=60), Learner(base, LearnerConfig(window=60))
    for k, t_s, u_V, y_um in zip(*motion(0, 300), strict=True):
        single.handle(Sample(int(k), float(t_s), float(u_V[0]), float(y_um[0])))
    found = digests({"lssvm_adaptive": base})
    meta = CheckpointMeta("mirror", "axis-0001", base.dt_s, single.seq, 300, 0.0, "i1", models=found)
    state = prefixed("learner.", single.state_dict()) | {"seq": single.seq}
    (tmp_path / "axis-0001.ckpt").write_bytes(b"".join(bytes(part) for part in encode_checkpoint(meta, state)))
    fleet = Fleet([base] * 3, FleetConfig(config))
    kept = FleetCheckpoints(fleet, tmp_path, "mirror", "i2", 60.0)
    assert kept.restore(range(3)) == [1]
    assert fleet.learner_of(1).counters() == single.counters()
    kept.close()
    # Not where its model was replaced since, in what it had learnt least of all.
    fleet = Fleet([base, replace(base, alpha=-base.alpha), base], FleetConfig(config))
    kept = FleetCheckpoints(fleet, tmp_path, "mirror", "i2", 60.0)
    assert kept.restore([1]) == []
    assert kept.counts["refused"] == 1
    assert "axis-0001.ckpt: it grew from another model file: the digest of 'lssvm_adaptive' is" in kept.error
    kept.close()
    # And back.
    restored = Learner.from_state(under("learner.", decode_checkpoint((tmp_path / "axis-0001.ckpt").read_bytes())[1]))
    np.testing.assert_array_equal(restored.parts.filter.beta, single.parts.filter.beta)


def test_an_axis_continues_from_the_file_of_a_service_with_competing_models(tmp_path: Path) -> None:
    """It takes the model that learns, under the same settings; what does not fit is named with its file."""
    models = make_models()
    limits = Limits(0.0, 10.0, 2000.0)
    axis = load_axis(
        "mirror",
        AxisConfig("axis-0001", Path("x.npz"), limits, learner={"window": 60}),
        bundle=Bundle(models, BundleMeta("mirror", "axis-0001", DT_S, y_min_um=0.0, y_max_um=90.0)),
    )
    seq, t_s, u_V, y_um = motion(0, 300)
    axis.handle(SampleBatch(seq, t_s, u_V[:, 0], y_um[:, 0]))
    assert len(str(axis.state_dict()["learner.names"]).split(",")) > 1
    meta = CheckpointMeta("mirror", "axis-0001", DT_S, 299, 300, 0.0, "i1", models=axis.identified)
    (tmp_path / "axis-0001.ckpt").write_bytes(b"".join(map(bytes, encode_checkpoint(meta, axis.state_dict()))))
    # The way back is refused, because such a service keeps more than a learner.
    base = models["lssvm_adaptive"]
    assert isinstance(base, LssvmInverse)
    with pytest.raises(ModelFileError, match=r"as the file of an axis of a fleet does; serve it by a \[fleet\]"):
        axis.restore(prefixed("learner.", Learner(base).state_dict()))
    for window, restored in ((60, [1]), (70, [])):
        fleet = Fleet([base] * 3, FleetConfig(learner_config({"window": window}, limits, "learner")))
        kept = FleetCheckpoints(fleet, tmp_path, "mirror", "i2", 60.0)
        assert kept.restore(range(3)) == restored
        kept.close()
        if restored:
            assert fleet.learner_of(1).counters()["learnt"] > 0
    assert "axis-0001.ckpt: axis 1: the state is of another configuration of the learner" in kept.error


def parts_of(kind: int, rng: np.random.Generator) -> dict[str, Any]:
    """Parts of a message of 3 samples or points of 5 axes."""
    u, y = rng.normal(size=(2, 3, 5))
    memory = rng.normal(size=(5, 4))
    return {
        wire.FLEET_SAMPLES: {"seq": [7, 8, 9], "t_s": [0.1, 0.2, 0.3], "u_V": u, "y_um": y},
        wire.FLEET_QUERY: {"y_um": u, "v_um_per_s": y, "a_um_per_s2": y, "memory": memory, "u_before_V": y[0]},
        wire.FLEET_REPLY: {"snapshot_seq": [42], "u_V": u, "std_V": y, "memory": memory,
                           "flags": np.full((3, 5), LIMITED_VOLTAGE)},
        wire.FLEET_CHANGES: {"snapshot_seq": [42], "axes": [1, 3, 4, 5, 9], "frames": rng.normal(size=(5, 2)),
                             "beta": memory},
    }[kind]  # fmt: skip


KINDS = (wire.FLEET_SAMPLES, wire.FLEET_QUERY, wire.FLEET_REPLY, wire.FLEET_CHANGES)


@pytest.mark.parametrize("kind", KINDS)
def test_payloads_survive_the_way(kind: int) -> None:
    parts = parts_of(kind, np.random.default_rng(0))
    got = wire.decode_fleet(kind, wire.encode_fleet(kind, 2, **parts))
    assert (got.first, got.axes) == (2, 5)
    assert got.parts.keys() == parts.keys()
    for name, value in parts.items():
        np.testing.assert_array_equal(got.parts[name], value)


def test_damage_is_named() -> None:
    parts = parts_of(wire.FLEET_QUERY, np.random.default_rng(0))
    whole = wire.encode_fleet(wire.FLEET_QUERY, **parts)
    less = wire.encode_fleet(wire.FLEET_QUERY, **(parts | {"memory": None, "u_before_V": None}))
    assert wire.decode_fleet(wire.FLEET_QUERY, less).parts["memory"] is None
    for data, field in (
        (whole[:-1], "payload"), (b"\x02" + whole[1:], "version"), (whole[:2] + b"\xff" + whole[3:], "options"),
        (whole[:4] + bytes(4) + whole[8:], "n"), (whole[:5] + b"\x20" + whole[6:], "axes"),
        (whole[:12] + bytes(4) + whole[16:], "rows"),
        (whole[:16] + bytes(4) + whole[20:], "columns"), (less[:16] + b"\x01" + less[17:], "columns"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^{field}: got"):
            wire.decode_fleet(wire.FLEET_QUERY, data)
    with pytest.raises(InputError, match=r"memory: got shape \(4, 4\), expected \(B, m\)"):
        wire.encode_fleet(wire.FLEET_QUERY, **(parts | {"memory": np.zeros((4, 4))}))


def test_a_configuration_names_what_does_not_fit(tmp_path: Path) -> None:
    good = configuration(7447)
    assert parse_config(good, "f", tmp_path).fleet is not None
    for text, message in (
        (good.replace(f"axes = {AXES}", "axes = 3"), r"f: fleet.gains: got 64 gains, expected 3"),
        (good.replace('["x.npz"]', '["x.npz", "y.npz"]'), r"f: fleet.models: got 2 files, expected 1"),
        (good.replace(f"axes = {AXES}", "axes = 0"), r"f: fleet.axes: got 0, expected an integer, 1 to 4096"),
        (good + "colour = 1\n", r"f: fleet.colour: got 1, expected one of the known keys"),
        ('stage = "a"\nfleet = 3\n', r"f: fleet: got 3, expected a table"),
        ('stage = "a"\n', r"f: axis: got none, expected one or more \[\[axis\]\] tables, or a \[fleet\] table"),
    ):
        with pytest.raises(InputError, match=message):
            parse_config(text, "f", tmp_path)


def test_without_torch_the_extra_is_named(tmp_path: Path) -> None:
    write_bundle(tmp_path / "x.npz", make_models(), BundleMeta("", "", DT_S, y_min_um=0.0, y_max_um=90.0))
    more = 'device = "cuda"\nlearner = { solver = { form = "inverse" } }\n'
    (tmp_path / "serve.toml").write_text(configuration(unused_port(), more), encoding="utf-8")
    code = (
        "import sys; sys.modules['torch'] = None\nfrom dehyst.lab.cli import main\n"
        f"sys.exit(main(['serve', '--config', {str(tmp_path / 'serve.toml')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert "[fleet]: got device 'cuda', without torch" in done.stderr
    assert "pip install 'dehyst[torch]'" in done.stderr
