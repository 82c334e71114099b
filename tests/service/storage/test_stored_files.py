"""Files of the service: checkpoints, model files, and atomic writes."""

from __future__ import annotations

import errno
import itertools
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.types import InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.intake.sample_queue import SampleQueue
from dehyst.service.operating.verbs import Request
from dehyst.service.protocol.model import digests, fingerprint
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis, make_learner
from dehyst.service.server.axis_loop import AxisLoop
from dehyst.service.server.axis_verbs import axis_verbs
from dehyst.service.storage import model_file as modelfile
from dehyst.service.storage.checkpoint import (
    LISTED_S,
    CheckpointFolder,
    CheckpointKeeper,
    CheckpointMeta,
    decode_checkpoint,
    encode_checkpoint,
    is_kept,
    restore_newest,
)
from dehyst.service.storage.model_file import UNITS, Bundle, BundleMeta, read_bundle, write_bundle
from dehyst.service.storage.output import atomic_write
from tests.service.conftest import DT_S, make_models
from tests.service.living import eventually

# --- Checkpoints: whole or refused with the reason, enough of them, and a learner that goes on from one.

LIMITS = Limits(0.0, 10.0, 2000.0, 0.0, 90.0)
CONFIG = AxisConfig("x", Path("x.npz"), LIMITS, served="lssvm_adaptive")


def make_axis(models: dict[str, InverseModel] | None = None, **changes: Any) -> Axis:
    bundle = Bundle(models or make_models(), BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0))
    return load_axis("demo", replace(CONFIG, **changes), make_learner, bundle)


def recording(first: int, n: int) -> SampleBatch:
    k = np.arange(first, first + n)
    y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * DT_S)
    return SampleBatch(k, k * DT_S, (y - 1.0) / (11.0 * 0.95), y)


def folder(directory: Path, kept: int = 32) -> CheckpointFolder:
    return CheckpointFolder(directory, "demo", "x", DT_S, digests(make_models()), kept)


def meta(of: Axis, **changes: Any) -> CheckpointMeta:
    made = CheckpointMeta("demo", "x", DT_S, of.handled_seq, of.sequence.received, models=of.identified)
    return replace(made, **changes)


def same(a: Axis, b: Axis) -> bool:
    return a.handled_seq == b.handled_seq and fingerprint(a.newest.models["lssvm_adaptive"]) == fingerprint(
        b.newest.models["lssvm_adaptive"]
    )


def test_an_axis_goes_on_from_a_checkpoint_to_the_last_bit(tmp_path: Path) -> None:
    straight = make_axis()
    straight.handle(recording(0, 1503))
    folder(tmp_path).write(meta(straight), straight.state_dict())
    other = make_axis()
    assert restore_newest(other, folder(tmp_path)) == 1
    assert [e["event"] for e in other.take_events()] == ["restored"]
    assert same(straight, other)
    for first in range(1503, 2600, 37):
        straight.handle(recording(first, 37))
        other.handle(recording(first, 37))
        assert same(straight, other)
    for name, memory in straight.newest.memories.items():
        np.testing.assert_array_equal(memory, other.newest.memories[name])
    assert straight.sequence.counters() == other.sequence.counters()
    assert straight.gates == other.gates
    assert not same(straight, make_axis())


def test_the_newest_that_is_whole_and_matches_is_taken_and_the_others_are_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    axis, kept = make_axis(), folder(tmp_path)
    axis.handle(recording(0, 500))
    state = axis.state_dict()
    kept.write(meta(axis), state)
    for changes, words in (
        ({"stage": "other"}, "stage is 'other', expected 'demo'"),
        ({"axis": "y"}, "axis is 'y'"),
        ({"dt_s": 2e-3}, "sample time is 0.002"),
        ({"schema": 99}, "schema is 99"),
        ({"models": {}}, "another model file: the digest of 'linear' is missing"),
        ({"models": digests(_shifted(make_models()))}, "another model file: the digest of 'lssvm_adaptive' is "),
    ):
        foreign = kept.write(meta(axis, **changes), state)
        fresh = make_axis()
        assert restore_newest(fresh, kept) == 1
        foreign.unlink()
        assert any(words in e["detail"] for e in fresh.take_events() if e["event"] == "checkpoint_refused")
    with monkeypatch.context() as patched:
        patched.setitem(UNITS, "y", "nm")
        in_nm = kept.write(meta(axis), state)
    fresh = make_axis()
    assert restore_newest(fresh, kept) == 1
    in_nm.unlink()
    refused, restored = fresh.take_events()
    assert (refused["event"], restored["event"]) == ("checkpoint_refused", "restored")
    assert "units is {'y': 'nm'" in refused["detail"]
    assert "expected {'y': 'um'" in refused["detail"]
    path = kept.write(meta(axis), state)
    whole = path.read_bytes()
    for damaged in (whole[:-1], whole[:40], b"", whole[:5000] + b"\xff" + whole[5001:], b"x" * 100):
        path.write_bytes(damaged)
        fresh = make_axis()
        assert restore_newest(fresh, kept) == 1
        assert [e["event"] for e in fresh.take_events()] == ["checkpoint_refused", "restored"]
    # A learner with other settings has nothing to do with what is kept.
    path.unlink()
    other = make_axis(learner={"window": 100})
    before = fingerprint(other.newest.models["lssvm_adaptive"])
    with pytest.raises(ModelFileError, match=r"another setting: .*config.window is 500, now 100"):
        other.restore(decode_checkpoint(b"".join(encode_checkpoint(meta(axis), state)))[1])
    assert fingerprint(other.newest.models["lssvm_adaptive"]) == before
    assert other.handled_seq == -1


def _shifted(models: dict[str, InverseModel]) -> dict[str, InverseModel]:
    model: Any = models["lssvm_adaptive"]
    return models | {"lssvm_adaptive": replace(model, beta=model.beta + 0.01)}


def test_a_few_dozen_checkpoints_reach_back_for_months(tmp_path: Path) -> None:
    for newest in (1, 10, 1000, 5_000_000):
        ages = [n for n in range(min(newest, 2_000_000)) if is_kept(newest - n, n)]
        assert len(ages) <= 4 + 2 * newest.bit_length()
        # However far back one wants to go, there is one within a factor of two.
        assert all(later <= 2 * max(4, earlier) for earlier, later in itertools.pairwise(ages))
    # What is kept at an age was kept at every earlier one: nothing is wanted that has been removed.
    for number in range(1, 300):
        kept = [is_kept(number, age) for age in range(300)]
        assert kept == sorted(kept, reverse=True)
    axis, few = make_axis(), folder(tmp_path, kept=6)
    axis.handle(recording(0, 100))
    for _ in range(40):
        few.write(meta(axis), {"seq": 1})
    numbers = few.numbers()
    assert len(numbers) == 6
    assert numbers[:4] == [40, 39, 38, 37]
    assert [entry["checkpoint"] for entry in few.entries()] == numbers
    assert not list(tmp_path.glob("*part"))


def test_a_checkpoint_that_was_listed_is_still_there_when_the_operator_goes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    axis, kept = make_axis(), folder(tmp_path)
    axis.handle(recording(0, 100))
    for _ in range(20):
        kept.write(meta(axis), axis.state_dict())
    now_s = [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    keeper = CheckpointKeeper(axis, SampleQueue("x", 1000), "demo", "i1", kept, clock=lambda: now_s[0])
    verbs = axis_verbs(axis, keeper, lambda work: 0, {})

    def listed() -> set[int]:
        _, result = verbs["checkpoints"](Request("checkpoints", "alice"))
        return {entry["checkpoint"] for entry in result["checkpoints"]}

    first = listed()
    assert len(first) > 5
    for _ in range(50):
        kept.write(meta(axis), axis.state_dict())
    assert first <= set(kept.numbers())
    now_s[0] += LISTED_S + 1.0
    kept.write(meta(axis), axis.state_dict())
    assert not first <= set(kept.numbers())
    # Listed all the time, as by a table on a screen: what was shown in the last five minutes is there, not all.
    shown: dict[int, float] = {}
    for _ in range(300):
        now_s[0] += 7.0
        kept.write(meta(axis), {"seq": 1})
        shown |= dict.fromkeys(listed(), now_s[0])
        assert {number for number, at_s in shown.items() if at_s >= now_s[0] - LISTED_S} <= set(kept.numbers())
    assert len(kept.numbers()) < 150
    keeper.close()


def test_the_operator_freezes_selects_and_goes_back(tmp_path: Path) -> None:
    axis = make_axis(checkpoints=tmp_path)
    axis.handle(recording(0, 1001))
    folder(tmp_path).write(meta(axis), axis.state_dict())
    good = fingerprint(axis.newest.models["lssvm_adaptive"])
    assert axis.freeze("alice") == 1000
    axis.handle(recording(1001, 999))
    assert fingerprint(axis.newest.models["lssvm_adaptive"]) == good
    assert axis.frozen
    axis.thaw("alice")
    axis.handle(recording(2000, 1000))
    assert fingerprint(axis.newest.models["lssvm_adaptive"]) != good
    axis.select("linear", "bob")
    assert axis.served == "linear"
    with pytest.raises(InputError, match="sorcery"):
        axis.select("sorcery")
    kept = folder(tmp_path)
    assert kept.entries()[0]["seq"] == 1000
    assert axis.rollback(kept.learner_of(1, axis.learner), 1, "bob") == 2999
    assert fingerprint(axis.newest.models["lssvm_adaptive"]) == good
    axis.handle(recording(3000, 500))
    assert axis.learning
    assert fingerprint(axis.newest.models["lssvm_adaptive"]) != good
    with pytest.raises(InputError, match="one of those there are"):
        kept.learner_of(77, axis.learner)
    events = [(e["event"], e.get("by")) for e in axis.take_events()]
    assert events == [("frozen", "alice"), ("thawed", "alice"), ("selected", "bob"), ("rolled_back", "bob")]


def test_a_full_disk_costs_checkpoints_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axis = make_axis(checkpoints=tmp_path / "kept", checkpoint_s=0.05)
    queue = SampleQueue("x", 1000)
    now_s = [0.0]
    keeper = CheckpointKeeper(axis, queue, "demo", "i-1", folder(tmp_path / "kept"), lambda: now_s[0])
    loop = AxisLoop(axis, queue, lambda: None, on_snapshot=keeper.on_snapshot)
    loop.start()
    full = False
    sync = os.fsync

    def fsync(fd: int) -> None:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(fd)

    monkeypatch.setattr(os, "fsync", fsync)
    try:
        for k in range(30):
            now_s[0] = 0.1 * k
            loop.offer(recording(40 * k, 40))
            eventually(lambda: not queue.waiting)
            if k in (10, 20):
                eventually(lambda: (c := keeper.counters()) is not None and c["written"] > 0)
                full = k == 10
        eventually(lambda: not (keeper.counters() or {})["degraded"])
    finally:
        loop.close()
        keeper.close()
    counters = keeper.counters()
    assert counters is not None
    assert counters["errors"] >= 1
    assert axis.handled_seq == 1199
    assert "checkpoint_failed" in [e["event"] for e in axis.take_events()]
    # The last state is there, and every file that is there is whole.
    assert max(folder(tmp_path / "kept").read(n)[0].seq for n in folder(tmp_path / "kept").numbers()) == 1199
    again = make_axis()
    restore_newest(again, folder(tmp_path / "kept"))
    assert same(again, axis)


# --- The model file: whole or not at all, and nothing foreign is taken for one.

META = BundleMeta("demo", "x", 1e-3, "rec.csv", "ab" * 32, 0.0, 90.0, 0.0, 8.0, {"heldout_rmse_V": 0.01})


def test_models_come_back_and_answer_the_same(models: dict[str, InverseModel], tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    write_bundle(path, models, META)
    bundle = read_bundle(path)
    assert bundle.meta == META
    assert list(bundle.models) == list(models)
    y = np.linspace(5.0, 80.0, 40)
    for name, model in models.items():
        memory = model.rest_memory(5.0)
        mine, theirs = (m.feedforward(y, 10 * y, 0 * y, memory) for m in (bundle.models[name], model))
        np.testing.assert_array_equal(mine.u_V, theirs.u_V)
        np.testing.assert_array_equal(mine.std_V, theirs.std_V)
    assert [p.name for p in tmp_path.iterdir()] == ["m.npz"]


WRONG_META = (
    ("y_min_um", "low"), ("y_min_um", 10**400), ("stage", 7), ("notes", 3), ("notes", ["clipped"]), ("dt_s", 10**400),
    ("magic", []),
)  # fmt: skip


def rewritten(path: Path, **changes: Any) -> Path:
    """The file with fields of its header changed."""
    with np.load(path) as file:
        entries = {name: file[name] for name in file.files}
    header = {**json.loads(entries["header"].tobytes()), **changes}
    entries["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(path, **entries)
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": 2}, "schema is 2, this program reads 1"),
        ({"magic": "other"}, "not a model bundle"),
        ({"units": {"y": "nm"}}, "units"),
        ({"dt_s": 0}, "dt_s"),
        ({"dt_s": 2e-3}, "dt_s"),
        ({"models": {}}, "no models"),
        ({"models": {"a": {"kind": "sorcery", "values": {}, "arrays": []}}}, "sorcery"),
        ({"models": {"a": {"kind": "linear", "values": {}, "arrays": []}}}, "model 'a'"),
        ({"models": {"a": {"kind": "linear", "values": {}, "arrays": ["gone"]}}}, "incomplete"),
        ({"models": {"a": 5}}, "incomplete"),
        ({"models": {"a": {"kind": "lssvm", "values": [1], "arrays": []}}}, "m.npz"),
        ({"models": {"a": {"kind": "lssvm", "values": {}, "arrays": [["x"]]}}}, "m.npz"),
        ({"models": {"linear": {"kind": "linear", "values": {"dt_s": 10**400}, "arrays": []}}}, "m.npz"),
        ({"models": {"a": {"kind": "champion", "values": {"names": 3, "kinds": {}}, "arrays": []}}}, "m.npz"),
        *(({name: value}, "m.npz") for name, value in WRONG_META),
    ],
)
def test_another_version_or_a_foreign_file_is_refused(
    changes: dict[str, Any], words: str, models: dict[str, InverseModel], tmp_path: Path
) -> None:
    path = tmp_path / "m.npz"
    write_bundle(path, models, META)
    with pytest.raises((ModelFileError, InputError), match=words) as refused:
        read_bundle(rewritten(path, **changes))
    assert str(path) in str(refused.value)


@pytest.mark.parametrize("keep", [0, 1, 30, 500, -30])
def test_a_damaged_file_is_refused(keep: int, models: dict[str, InverseModel], tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    write_bundle(path, models, META)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ModelFileError, match=r"m\.npz"):
        read_bundle(path)


def test_models_of_another_sample_time_or_an_unknown_class_are_not_stored(
    models: dict[str, InverseModel], tmp_path: Path
) -> None:
    with pytest.raises(ModelFileError, match="dt_s"):
        write_bundle(tmp_path / "m.npz", models, BundleMeta("demo", "x", 2e-3))

    class Stranger(type(models["linear"])):  # type: ignore[misc]
        pass

    line = models["linear"]
    stranger = Stranger(line.parameters, line.dt_s, line.domain)  # type: ignore[attr-defined]
    with pytest.raises(ModelFileError, match="register"):
        write_bundle(tmp_path / "m.npz", {"s": stranger}, META)


# --- A file is replaced as a whole or not at all.


def test_an_exception_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(TypeError), atomic_write(path) as file:
        file.write(b"new" + 1)  # type: ignore[operator]
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]
    with pytest.raises(OSError, match="No such"), atomic_write(tmp_path / "gone" / "a.bin") as file:
        file.write(b"new")


def test_files_of_other_makes_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", y=np.zeros(3))
    with pytest.raises(ModelFileError, match="header"):
        read_bundle(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", np.zeros(3))
    with pytest.raises(ModelFileError, match="not a model bundle"):
        read_bundle(tmp_path / "b.npy")
    # Pickles are code: never loaded.
    np.savez(tmp_path / "c.npz", header=np.array([{"magic": modelfile.MAGIC}], dtype=object))
    with pytest.raises(ModelFileError):
        read_bundle(tmp_path / "c.npz")
    with pytest.raises(ModelFileError, match="dehyst identify"):
        read_bundle(tmp_path / "missing.npz")
