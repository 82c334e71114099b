"""Folders that another process holds, that vanish or that are full; and files that only pretend to be models."""

from __future__ import annotations

import errno
import io
import json
import shutil
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.intake.sample_queue import SampleQueue
from dehyst.service.protocol.errors import FieldError
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage import checkpoint
from dehyst.service.storage.checkpoint import CheckpointKeeper
from dehyst.service.storage.model_file import BundleMeta, read_bundle, write_bundle
from dehyst.service.storage.output import atomic_write
from dehyst.service.storage.recorder import Recorder, RecorderConfig
from dehyst.service.storage.segments import rows_behind
from dehyst.sim.recordings import read
from tests.service.conftest import DT_S, make_models
from tests.service.living import eventually
from tests.service.storage.test_stored_files import folder, make_axis, meta, recording, rewritten


def keeper(tmp_path: Path) -> tuple[Any, CheckpointKeeper]:
    axis = make_axis(checkpoints=tmp_path, checkpoint_s=0.01)
    axis.handle(recording(0, 200))
    return axis, CheckpointKeeper(axis, SampleQueue("x", 1000), "demo", "i1", folder(tmp_path))


def test_a_full_disk_gets_room_from_old_checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axis, kept = make_axis(), folder(tmp_path)
    axis.handle(recording(0, 100))
    state = axis.state_dict()
    for _ in range(10):
        kept.write(meta(axis), state)
    before = len(kept.numbers())
    real = atomic_write
    limit = before - 3

    def full(path: Path) -> Any:
        if len(list(tmp_path.glob("checkpoint-*"))) > limit:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path)

    monkeypatch.setattr(checkpoint, "atomic_write", full)
    kept.write(meta(axis), state)
    assert kept.numbers()[0] == 11
    assert 2 <= len(kept.numbers()) <= limit + 1
    limit = 0  # nothing helps: the newest ones stay
    with pytest.raises(OSError, match="No space left"):
        kept.write(meta(axis), state)
    assert kept.numbers()[:2] == [11, 10]


@pytest.mark.parametrize("how", ["removed", "renamed"])
def test_a_recording_folder_that_vanishes_is_degraded_and_made_anew(tmp_path: Path, how: str) -> None:
    where = tmp_path / "rec"
    with Recorder(RecorderConfig(where, retry_s=2.0)) as recorder:
        k = np.arange(100)
        recorder.put(k, k * DT_S, k * 0.1, k * 0.2, "learnt")
        eventually(lambda: recorder.counters()["written"] == 100)
        if how == "removed":
            shutil.rmtree(where)
        else:
            where.rename(tmp_path / "elsewhere")
        last = 100

        def counts_after(n: int) -> dict[str, Any]:
            """Of the recorder, when it has taken n more samples."""
            nonlocal last
            k, last = np.arange(last, last + n), last + n
            recorder.put(k, k * DT_S, k * 0.1, k * 0.2, "learnt")
            return eventually(lambda: (counts := recorder.counters())["waiting"] == 0 and counts)

        told = eventually(lambda: (counts := counts_after(50))["degraded"] and counts)
        assert "vanished" in told["error"]
        eventually(lambda: counts_after(50)["written"] == last)
        assert recorder.counters()["errors"] == 1
        rows = rows_behind(where, last - 50, "")
        assert rows is not None
        assert int(rows.seq[-1]) == last - 1
    assert recorder.counters()["lost"] == 0


def npy_header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    made = io.BytesIO()
    np.lib.format.write_array_header_1_0(made, {"descr": descr, "fortran_order": False, "shape": shape})
    return made.getvalue()


#: Headers of arrays without their values, and what is said of them.
DECLARED = {
    "2^40 values": (npy_header((2**40,)), r"header: declares float64 of shape \(1099511627776,\), 8796093022208 bytes"),
    "2^34 values": (npy_header((2**34,)), "declares float64"),
    "2^80 values": (npy_header((2**20,) * 4), "declares float64"),
    "values of no size": (npy_header((2**40,), "|S0"), "declares"),
    "a negative length": (npy_header((-5,)), "negative"),
    "brackets": (b"\x93NUMPY\x01\x00" + (9000).to_bytes(2, "little") + b"(" * 8999 + b"\n", "damaged"),
    "a header of 4 GiB": (b"\x93NUMPY\x02\x00" + b"\xff" * 4, "header: EOF"),
    "256 MiB of zeros": (npy_header((2**25,)) + bytes(2**28), r"unpacks to .* bytes, expected at most"),
}


@pytest.mark.parametrize("declared", list(DECLARED))
@pytest.mark.parametrize("form", ["archive", "array", "array and archive"])
def test_a_small_file_that_declares_a_large_array_is_refused_before_anything_is_allocated(
    tmp_path: Path, declared: str, form: str
) -> None:
    """As a model file, and as a recording; also one array alone, and an archive behind one."""
    content, words = DECLARED[declared]
    archived = io.BytesIO()
    with zipfile.ZipFile(archived, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.npy", content)
    path, alone = tmp_path / "x.npz", content[:200]
    path.write_bytes({"archive": b"", "array": alone, "array and archive": alone}[form])
    if form != "array":
        with path.open("ab") as file:
            file.write(archived.getvalue())
    assert path.stat().st_size < 2**20
    tracemalloc.start()
    with pytest.raises(ModelFileError, match=words if form != "array" else "not a model bundle"):
        read_bundle(path)
    if declared != "256 MiB of zeros":  # as a recording that is not much
        with pytest.raises(InputError, match=words if form != "array" and declared != "brackets" else r"npz file"):
            read(path)
        (tmp_path / "x.npy").write_bytes(content)
        with pytest.raises(InputError, match=r"is not a whole .npy file"):
            read(tmp_path / "x.npy")
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_a_model_of_numbers_that_no_stage_has_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    write_bundle(path, make_models(), BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0))
    with np.load(path) as file:
        models = json.loads(file["header"].tobytes())["models"]
    models["lssvm_adaptive"]["values"]["features.offset_um"] = 2.0**63
    with pytest.raises((ModelFileError, InputError), match=r"x\.npz: model 'lssvm_adaptive' cannot learn"):
        load_axis("demo", AxisConfig("x", rewritten(path, models=models), Limits(0.0, 10.0, 2000.0)))


def test_a_checkpoint_folder_that_vanishes_is_made_anew(tmp_path: Path) -> None:
    _, kept = keeper(tmp_path / "kept")
    kept.hold(0.0)
    kept.copy_now()
    assert kept.wait_written(5.0)
    shutil.rmtree(tmp_path / "kept")
    kept.copy_now()
    assert kept.wait_written(5.0)
    assert len(folder(tmp_path / "kept").numbers()) == 1
    _, other = keeper(tmp_path / "kept")
    with pytest.raises(FieldError):
        other.hold(0.0)
    kept.close()
    other.close()
