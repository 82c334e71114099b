"""The command line: groups, help, version, completion, log level and exit statuses."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dehyst.lab.cli import COMMANDS, main
from dehyst.service.cli.main import build_parser

ROOT = Path(__file__).resolve().parents[3]
DOCUMENTED = """
identify serve diagnose modes stage query replay status freeze thaw rollback checkpoints select retune ask-diagnosis
access export router view demo rehearse scenarios soak bench reproduce
""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def parsers() -> dict[str, argparse.ArgumentParser]:
    whole = build_parser(COMMANDS, COMMANDS)
    (sub,) = [action for action in whole._actions if isinstance(action, argparse._SubParsersAction)]
    return dict(sub.choices)


def test_every_documented_command_is_there_with_help_and_a_log_level(
    parsers: dict[str, argparse.ArgumentParser],
) -> None:
    assert set(DOCUMENTED) <= set(parsers)
    for name, parser in parsers.items():
        text = parser.format_help()
        assert f"dehyst {name}" in text
        assert "--log-level" in text


@pytest.mark.parametrize(
    "args", [["dance"], [], ["query", "--speed", "3"], ["query", "1", "--log-level", "loud"], ["demo", "--seed", "-1"]]
)
def test_a_usage_error_ends_with_2_and_a_message(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = main(args)
    except SystemExit as ended:
        status = int(ended.code or 0)
    assert status == 2
    assert capsys.readouterr().err.startswith(("usage: dehyst", "dehyst demo: --seed: got -1, expected 0 or more"))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh"])
def test_completion_knows_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for word in ("ask-diagnosis", "standby", "log-level"):
        assert word in script


@pytest.mark.parametrize("encoding", ["cp932", "ascii"])
def test_help_can_be_read_in_any_encoding(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in COMMANDS:
        out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(sys, "stdout", out)
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code in (0, None)
        out.flush()
        text = out.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
        assert f"usage: dehyst {command}" in text
        assert "?m" not in text, "a unit that cannot be shown is spelt: um"


def run_into(out: object, *words: str) -> tuple[int, str]:
    """(exit status, what is said on stderr) of a command whose output goes to ``out``."""
    done = subprocess.run(
        [sys.executable, "-m", "dehyst.lab.cli", *words],
        cwd=ROOT,
        stdout=out,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )  # type: ignore[call-overload]
    return done.returncode, done.stderr


def test_a_full_disk_and_a_closed_pipe_are_no_traceback() -> None:
    with open("/dev/full", "w") as full:
        assert run_into(full, "serve", "--example") == (1, "dehyst serve: [Errno 28] No space left on device\n")
        assert run_into(full, "serve", "--help")[1].count("\n") <= 1
    reading, writing = os.pipe()
    os.close(reading)
    try:
        assert run_into(writing, "serve", "--example") == (1, "")
    finally:
        os.close(writing)


@pytest.mark.parametrize("words", [
    ["identify", "no.csv", "--out", "{folder}"],
    ["identify", "no.csv", "--out", "/proc/model.npz"],
    ["identify", "no.csv", "--out", "{folder}/model.npz", "--picture", "/proc/picture.png"],
], ids=["a folder", "read only", "the picture"])  # fmt: skip
def test_an_output_that_cannot_be_written_is_refused_before_the_data_are_read(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word.replace("{folder}", str(tmp_path)) for word in words]) == 2
    told = capsys.readouterr().err
    assert "expected a file in a folder that can be written to" in told
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["diagnose", "modes"])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data.csv"
    k = np.arange(4000)
    u_V = 4.0 + 3.0 * np.sin(2.0 * np.pi * k / 400)
    rows = np.column_stack([k * 1e-3, u_V, 10.0 * u_V + 1.0])
    np.savetxt(data, rows, delimiter=",", header="t_s,u_V,y_um", comments="", fmt="%.9g")
    for module, name in (("dehyst.sim.diagnosis.prepare", "prepare"), ("dehyst.sim.modal", "study")):
        monkeypatch.setattr(importlib.import_module(module), name, lambda *_, **__: pytest.fail("it computes"))
    assert main([command, str(data), "--out", "/proc", *(["--period", "400"] if command == "modes" else [])]) == 2
    assert "--out: got /proc, expected a folder that can be written to" in capsys.readouterr().err
