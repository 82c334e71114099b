"""The files of an export beside the C: tables with their stated error, an FMU, and what the command refuses."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dehyst.lab.cli import main
from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client
from dehyst.service.export.exporting import Frozen, trial_motion, voltages, write_export
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.service.conftest import DT_S, ServeProcess, make_models
from tests.service.export.compiled import STRICT, needs_a_compiler

LIMITS = Limits(-5.0, 15.0, 2000.0)


@pytest.fixture
def model_file(tmp_path: Path) -> Path:
    notes = {"heldout_rmse_um": {"linear": 0.2, "lssvm_adaptive": 0.1}}
    meta = BundleMeta("demo", "x-1", DT_S, y_min_um=0.0, y_max_um=90.0, u_min_V=0.0, u_max_V=9.0, notes=notes)
    write_bundle(tmp_path / "stage.npz", make_models(), meta)
    return tmp_path / "stage.npz"


def table(path: Path) -> np.ndarray:
    rows = [line.split(",") for line in path.read_text().splitlines() if line[0] not in "#y"]
    return np.array(rows, dtype=float)


def test_the_table_has_the_stated_error_on_its_motion(tmp_path: Path) -> None:
    frozen = Frozen(make_models()["lssvm_adaptive"], LIMITS, "it", "a test")
    write_export(frozen, tmp_path, (10.0, 70.0), 2.0, fmu=False)
    places, rising, falling = table(tmp_path / "it_table.csv").T
    assert (places[0], places[-1]) == (10.0, 70.0)
    # The motion anew, and by the model alone: from rest at 10 µm, the sixth period.
    t = np.arange(6 * 500) * DT_S
    phase, omega = 4.0 * np.pi * t, 4.0 * np.pi
    y = 40.0 - 30.0 * np.cos(phase)
    u, _ = voltages(frozen, y, 30.0 * omega * np.sin(phase), 30.0 * omega**2 * np.cos(phase))
    y, u, up = y[-500:], u[-500:], np.sin(phase[-500:]) >= 0.0
    off = np.where(up, np.interp(y, places, rising), np.interp(y, places, falling)) - u
    stated = re.search(r"largest error ([\d.e-]+) mV on 10 to 70 µm at 2 Hz", (tmp_path / "it_table.csv").read_text())
    assert stated is not None
    assert np.abs(off).max() * 1e3 == pytest.approx(float(stated[1]), rel=0.05, abs=1e-3)
    assert np.abs(off).max() < 0.01
    wave = np.loadtxt(tmp_path / "it_wave.txt")
    np.testing.assert_allclose(wave, u, atol=1e-3)


@needs_a_compiler
def test_a_model_file_becomes_c_that_compiles(
    model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out"
    assert main(["export", str(model_file), "--out", str(out), "--u-max", "8"]) == 0
    told = capsys.readouterr().out
    assert "lssvm_adaptive of stage.npz" in told, "the model with the least error"
    endings = {".h", ".c", "_test.c", "_vectors.csv", "_table.csv", "_wave.txt"}
    assert {path.name for path in out.iterdir()} == {f"demo_x_1{ending}" for ending in endings}
    assert table(out / "demo_x_1_vectors.csv")[:, 3].max() == 8.0
    (command,) = re.findall(r"(cc -O3 .*) &&", told)
    subprocess.run([*command.split(), *STRICT], cwd=out, check=True)
    assert subprocess.run(["./a.out", "demo_x_1_vectors.csv"], cwd=out, check=False).returncode == 0


@needs_a_compiler
def test_the_fmu_is_the_model(tmp_path: Path) -> None:
    fmpy = pytest.importorskip("fmpy")
    from fmpy.validation import validate_fmu

    frozen = Frozen(make_models()["lssvm_adaptive"], LIMITS, "it", "a test")
    write_export(frozen, tmp_path, (5.0, 85.0), 1.0, fmu=True)
    path = tmp_path / "it.fmu"
    assert validate_fmu(str(path)) == []
    y, v, a = (column[:800] for column in trial_motion(frozen))  # the NaN is later
    signals = np.array(
        list(zip(np.arange(800) * DT_S, y, v, a, strict=True)),
        dtype=[(name, float) for name in ("time", "y_um", "v_um_per_s", "a_um_per_s2")],
    )
    got = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=799 * DT_S, step_size=DT_S, output_interval=DT_S, input=signals,
        start_values={"y_start_um": y[0]}, output=["u_V", "flags"],
    )  # fmt: skip
    expected, flags = voltages(frozen, y, v, a)
    # What is answered to the input at a communication point stands at the next one.
    np.testing.assert_allclose(got["u_V"][1:800], expected[:799], atol=1e-12)
    np.testing.assert_array_equal(got["flags"][1:800], flags[:799])
    assert got["u_V"][0] == pytest.approx(expected[0], abs=1e-12)
    with pytest.raises(fmpy.fmi1.FMICallException):
        fmpy.simulate_fmu(str(path), stop_time=0.1, step_size=1.4 * DT_S, output_interval=1.4 * DT_S)


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line that the command says."""
    assert main(["export", *map(str, words)]) == 2
    told = capsys.readouterr().err
    assert told.startswith("dehyst export: ")
    assert told.count("\n") == 1
    return told


def test_what_is_wrong_is_one_line(
    model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert "expected a model file, or the key of a service" in refused(capsys, "--out", out)
    assert "no such file" in refused(capsys, tmp_path / "no.npz", "--out", out)
    assert "--model: got 'mine', expected one of linear, lssvm_adaptive" in refused(
        capsys, model_file, "--out", out, "--model", "mine"
    )
    assert "--motion: got '3', expected LOW:HIGH in µm" in refused(capsys, model_file, "--out", out, "--motion", "3")
    assert "100 samples in a period" in refused(capsys, model_file, "--out", out, "--hz", "50")
    assert "--name: got 'My Stage'" in refused(capsys, model_file, "--out", out, "--name", "My Stage")
    assert "u_max_V: got -1" in refused(capsys, model_file, "--out", out, "--u-max", "-1")
    assert "expected dehyst/v1/STAGE/AXIS" in refused(capsys, "--from-service", "demo", "--out", out)
    monkeypatch.setenv("CC", "no-such-compiler")
    assert "no C compiler (no-such-compiler), expected one" in refused(capsys, model_file, "--out", out, "--fmu")
    assert not list(out.iterdir()), "nothing is written before all is known to be right"


@pytest.mark.parametrize("place", ["stage.npz", "stage.npz/below", "/proc/none", "/proc"])
def test_a_folder_that_cannot_be_written_to_is_named_before_anything_is_read(
    place: str, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = refused(capsys, "no-such-model.npz", "--out", model_file.parent / place)
    assert "--out: got" in told
    assert "expected a folder that can be written to" in told


@pytest.mark.e2e
@needs_a_compiler
def test_what_a_running_service_has_learnt_is_exported(
    serve: Callable[..., ServeProcess], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """After a gain change that it has learnt, the C has the follower's voltages, not the model file's."""
    service = serve()
    key, out, n = "dehyst/v1/demo/x", tmp_path / "out", 6000
    k = np.arange(n)
    u = 4.0 + 2.5 * np.sin(2 * np.pi * 4e-3 * k) + 0.8 * np.sin(2 * np.pi * 11e-3 * k)
    with Client.connect(service.endpoint, timeout_s=10.0) as client:
        for at in range(0, n, 50):
            part = slice(at, at + 50)
            client.samples(k[part], k[part] * DT_S, u[part], 0.94 * (11.0 * u[part] + 1.0))
            client.wait_learnt(at + 49)
        words = ["export", "--from-service", key, "--endpoint", service.endpoint, "--model", "lssvm_adaptive"]
        assert main([*words, "--out", str(out)]) == 0, capsys.readouterr().err
        told = re.search(rf"lssvm_adaptive of {key} after sample (\d+)", capsys.readouterr().out)
        assert told is not None
        assert int(told[1]) > n - 30, "the newest snapshot"
        rest_um = table(out / "demo_x_vectors.csv")[0, 0]
        model = client.follow("lssvm_adaptive", deltas=False).model
        follower = client.follow("lssvm_adaptive", model.rest_memory(rest_um), deltas=False)
        y, v, a, expected, _ = table(out / "demo_x_vectors.csv")[:900].T
        inside = np.cumsum((y < 0.0) | (y > 90.0)) == 0  # beyond, the follower blends its stand-in
        followed = [follower.point(*map(float, row)) for row in zip(y[inside], v[inside], a[inside], strict=True)]
        np.testing.assert_allclose(expected[inside], followed, atol=1e-12)
        assert inside.sum() > 100
    frozen = Frozen(make_models()["lssvm_adaptive"], Limits(0.0, 10.0, 2000.0), "it", "")
    assert np.abs(voltages(frozen, y, v, a)[0] - expected).max() > 0.05, "the service has learnt nothing"
    subprocess.run(["cc", *STRICT, "-O2", "demo_x.c", "demo_x_test.c", "-lm"], cwd=out, check=True)
    assert subprocess.run(["./a.out", "demo_x_vectors.csv"], cwd=out, check=False).returncode == 0


@pytest.mark.e2e
def test_a_service_that_cannot_prove_itself_is_not_exported(
    serve: Callable[..., ServeProcess], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service = serve()
    other = tmp_path / "other.key"
    other.write_bytes(b"0" * 64)
    other.chmod(0o600)
    words = ["export", "--from-service", "dehyst/v1/demo/x", "--endpoint", service.endpoint, "--key", str(other)]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert "none with the authenticator by" in capsys.readouterr().err
    assert not list((tmp_path / "out").iterdir())
