"""Checkpoints: whole or refused with the reason, enough of them, and a learner that goes on from one."""

from __future__ import annotations

import errno
import itertools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive.errors import InputError, ModelFileError
from adaptive.types import InverseModel
from service.answers.guard import Limits
from service.config.settings import AxisConfig
from service.intake.sample_queue import SampleQueue
from service.protocol.samples import SampleBatch
from service.server.axis import Axis
from service.server.axis_loading import load_axis, make_learner
from service.server.axis_loop import AxisLoop
from service.server.learner_supervisor import fingerprint
from service.storage import checkpoint
from service.storage.checkpoint import (
    CheckpointFolder,
    CheckpointKeeper,
    CheckpointMeta,
    decode_checkpoint,
    encode_checkpoint,
    is_kept,
    restore_newest,
)
from service.storage.model_file import UNITS, Bundle, BundleMeta
from tests.service.conftest import DT_S, make_models
from tests.service.living import eventually

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
    return CheckpointFolder(directory, "demo", "x", DT_S, kept)


def meta(of: Axis, **changes: Any) -> CheckpointMeta:
    made = CheckpointMeta("demo", "x", DT_S, of.handled_seq, of.sequence.received)
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
    ):
        foreign = kept.write(meta(axis, **changes), state)
        fresh = make_axis()
        assert restore_newest(fresh, kept) == 1
        foreign.unlink()
        assert any(words in e["detail"] for e in fresh.take_events() if e["event"] == "checkpoint_refused")
    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "UNITS", {**UNITS, "y": "nm"})
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
    # A learner with other settings, or one that began as another model, has nothing to do with what is kept.
    path.unlink()
    for other, words in (
        (make_axis(learner={"window": 100}), "another setting: .*config.window is 500, now 100"),
        (make_axis(_shifted(make_models())), "another identified model: .*base.beta"),
    ):
        before = fingerprint(other.newest.models["lssvm_adaptive"])
        with pytest.raises(ModelFileError, match=words):
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
    assert axis.checkpoints()[0]["seq"] == 1000
    assert axis.rollback(1, "bob") == 2999
    assert fingerprint(axis.newest.models["lssvm_adaptive"]) == good
    axis.handle(recording(3000, 500))
    assert axis.learning
    assert fingerprint(axis.newest.models["lssvm_adaptive"]) != good
    with pytest.raises(InputError, match="one of those there are"):
        axis.rollback(77)
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
