"""The options that say how to read a recording, through the command line."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter

from dehyst.adaptive.errors import InputError
from dehyst.lab.cli import main
from dehyst.service.identification.recording_options import add_mapping_arguments, load, mapping_from

N, PERIODS, DT_S = 400, 4, 0.002
T = np.arange(N) * DT_S
U = 4.0 - 4.0 * np.cos(2 * np.pi * 2.5 * T)
RNG = np.random.default_rng(3)
Y = np.stack([10.0 * U + 0.4 * np.sin(2 * np.pi * 2.5 * T) + RNG.normal(0.0, 1e-3, N) for _ in range(PERIODS)])


def parsed(*arguments: str, test: bool = False) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    if test:
        parser.add_argument("--test", type=Path)
    add_mapping_arguments(parser, test=test)
    return parser.parse_args(arguments)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """One period of the drive, and readings of four periods, each a row; of a second run too."""
    np.save(tmp_path / "drive_V.npy", U)
    np.save(tmp_path / "sensor.npy", Y)
    np.save(tmp_path / "again.npy", Y[::-1])
    return tmp_path


OPTIONS = ("--unit", "y=um", "--index", "y=*,:", "--repeat", "u", "--dt-s", str(DT_S))


def test_a_test_recording_has_files_of_its_own(rig: Path) -> None:
    files = ("--file", f"y={rig / 'sensor.npy'}")
    test_files = ("--test", str(rig / "drive_V.npy"), "--test-file", f"y={rig / 'again.npy'}")
    args = parsed(*files, *test_files, *OPTIONS, test=True)
    np.testing.assert_array_equal(load(rig / "drive_V.npy", args).y_um, Y.reshape(-1))
    np.testing.assert_array_equal(load(args.test, args, test=True).y_um, Y[::-1].reshape(-1))
    with pytest.raises(InputError, match="--test-file: got nothing, expected a file for y"):
        mapping_from(parsed(*files, "--test", "b.npy", test=True), test=True)
    with pytest.raises(InputError, match="--test-file: got y, expected a file for no quantity"):
        mapping_from(parsed(*test_files, test=True), test=True)
    with pytest.raises(InputError, match=r"--test-file: .*expected a test recording; give it by --test"):
        load(rig / "drive_V.npy", parsed(*test_files[2:], test=True))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--file", "y"), "--file: got 'y', expected QUANTITY=VALUE"),
        (("--file", "z=a.npy"), "--file: got 'z=a.npy'"),
        (("--repeat", "t"), "repeat: got 't', expected a quantity of one period: u, y"),
        (("--header", "-1"), "header: got '-1', expected the number of a line, from 1, or none"),
    ],
)
def test_wrong_options(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        mapping_from(parsed(*arguments))


def test_identify_reads_a_table_without_names_and_judges_on_a_tdms_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savetxt(tmp_path / "a.csv", np.column_stack([np.tile(U, PERIODS), Y.reshape(-1)]), delimiter=",")
    with TdmsWriter(tmp_path / "b.tdms") as writer:
        clock = {"wf_increment": DT_S, "wf_start_offset": 0.0}
        channels = (("1", np.tile(U, PERIODS)), ("2", Y[::-1].reshape(-1)))
        writer.write_segment([ChannelObject("rig", name, values, clock) for name, values in channels])
    out = tmp_path / "m.npz"
    mapping = ("--column", "u=1", "--column", "y=2", "--unit", "u=V", "--unit", "y=um", "--dt-s", str(DT_S))
    arguments = ("--test", str(tmp_path / "b.tdms"), "--models", "linear", "--no-pictures", "--out", str(out))
    assert main(["identify", str(tmp_path / "a.csv"), *arguments, *mapping, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["samples"] == N * PERIODS
    assert summary["gain_um_per_V"] == pytest.approx(10.0, abs=0.02)
    assert any("called by their position" in finding["message"] for finding in summary["findings"])
    assert out.exists()


def test_the_commands_read_two_files_and_refuse_without_writing(
    rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(rig)
    read = ("drive_V.npy", "--file", "y=sensor.npy", "--unit", "y=um", "--dt-s", str(DT_S))
    periods = ("--index", "y=*,:", "--repeat", "u")
    models = ("--models", "linear,lssvm_adaptive", "--support", "50", "--no-pictures")
    assert main(["identify", *read, *periods, *models, "--out", "m.npz"]) == 0
    said = capsys.readouterr().err
    assert f"drive_V.npy: {N * PERIODS} samples" in said
    assert "y: 4 periods of 400 samples put one after another" in said
    assert "u: its 400 samples are one period and are repeated 4 times" in said
    (rig / "learner.toml").write_text("window = 200\n")
    before = sorted(path.name for path in rig.iterdir())
    for arguments, message in (
        (("diagnose", *read, *periods[:2], "--out", "report"), "add --repeat u"),
        (("replay", *read, *periods[2:], "--config", "learner.toml", "--model", "m.npz", "--out", "played"), "y=*,:"),
    ):
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"dehyst {arguments[0]}: ")
        assert message in said
    assert sorted(path.name for path in rig.iterdir()) == before
