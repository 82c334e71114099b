"""The model file: whole or not at all, and nothing foreign is taken for one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive.errors import ModelFileError
from adaptive.types import InverseModel
from service.storage import model_file as modelfile
from service.storage.model_file import BundleMeta, read_bundle, write_bundle

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
    ],
)
def test_another_version_or_a_foreign_file_is_refused(
    changes: dict[str, Any], words: str, models: dict[str, InverseModel], tmp_path: Path
) -> None:
    path = tmp_path / "m.npz"
    write_bundle(path, models, META)
    with pytest.raises(ModelFileError, match=words) as refused:
        read_bundle(rewritten(path, **changes))
    assert str(path) in str(refused.value)


@pytest.mark.parametrize("keep", [0, 1, 30, 500, -30])
def test_a_damaged_file_is_refused(keep: int, models: dict[str, InverseModel], tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    write_bundle(path, models, META)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ModelFileError, match=r"m\.npz"):
        read_bundle(path)


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


def test_a_failed_write_leaves_the_old_file_whole(
    models: dict[str, InverseModel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.npz"
    write_bundle(path, models, META)
    before = path.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(modelfile.np, "savez", full)
    with pytest.raises(OSError, match="No space"):
        write_bundle(path, models, META)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.npz"]


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
