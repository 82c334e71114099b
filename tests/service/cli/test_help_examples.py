"""The examples of each command's --help are real: all of them parse, and those that end soon run as printed.

Endpoints are the exception: a free port takes the place of the default one, so that nothing else here answers.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.cli import COMMANDS, main
from dehyst.service.cli.main import build_parser
from tests.service.conftest import ServeProcess, unused_port

ROOT = Path(__file__).resolve().parents[3]


def help_of(name: str) -> str:
    whole = build_parser(COMMANDS, [name])
    (sub,) = [action for action in whole._actions if isinstance(action, argparse._SubParsersAction)]
    text: str = sub.choices[name].format_help()
    return text


def examples(name: str) -> list[str]:
    """The lines of the help that are commands, continued ones joined."""
    text = help_of(name).replace("\\\n", " ")
    return [line.strip() for line in text.splitlines() if re.match(r"  dehyst \w", line)]


def words(example: str) -> list[str]:
    """The arguments of an example, without comment and redirection."""
    return shlex.split(example.partition(" > ")[0], comments=True)[1:]


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_help_has_examples_and_all_of_them_parse(name: str) -> None:
    found = examples(name)
    assert any(words(example)[0] == name for example in found), f"dehyst {name} --help has no example of its own"
    for example in found:
        command, *_ = args = words(example)
        parsed = build_parser(COMMANDS, [command]).parse_args(args)
        assert parsed.command == command


@pytest.mark.parametrize(("typed", "meant"), [("identfy", "identify"), ("stat", "status"), ("seve", "serve")])
def test_a_mistyped_command_is_answered_with_the_nearest(
    typed: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([typed])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert f"got '{typed}'; did you mean " in told
    assert meant in told.partition("did you mean")[2].partition("?")[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that examples name, as one of them writes them into an empty folder, and what is made of them here."""
    folder = tmp_path_factory.mktemp("examples")
    (writing,) = [example for example in examples("stage") if "--examples" in example]
    assert "recording.csv" in run_as_printed(writing, folder)
    return folder


@pytest.fixture(scope="module")
def stage(folder: Path) -> Path:
    """The same with the models that the first example of ``identify`` writes."""
    assert "models: stage.npz" in run_as_printed(examples("identify")[0], folder)
    return folder


def run_as_printed(example: str, folder: Path, *more: str, status: int = 0) -> str:
    """Run an example in ``folder``; returns what it prints."""
    printed, complaint = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complaint):
        ended = main([*words(example), *more])
    assert ended == status, f"{example}\n{printed.getvalue()}\n{complaint.getvalue()}"
    return printed.getvalue() + complaint.getvalue() * (status != 0)


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def test_no_file_of_the_reader_is_replaced(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "scope.csv").read_bytes()
    assert main(["stage", "--examples", str(folder)]) == 2
    assert "no file is replaced" in capsys.readouterr().err
    assert (folder / "scope.csv").read_bytes() == before


def test_identify_and_replay_run_as_printed(stage: Path) -> None:
    for example in examples("identify")[1:]:
        other = example.replace("stage.npz", "other.npz")
        assert "models: other.npz" in run_as_printed(other, stage, "--models", "linear", "--no-pictures")
    for example in examples("replay"):
        assert "samples scored" in run_as_printed(example, stage, "--no-pictures")


def test_export_runs_as_printed(stage: Path) -> None:
    for example in examples("export")[:2]:
        assert "demo_x.c: C99" in run_as_printed(example.replace(" --fmu", ""), stage)


def test_look_runs_as_printed(folder: Path) -> None:
    """The first example finds two columns in V and asks; the second says which is which."""
    asking, understood = examples("look")
    assert "--column y=CH2" in run_as_printed(asking, folder, status=1)
    assert "understood: 12000 samples" in run_as_printed(understood, folder)


def test_modes_run_as_printed(folder: Path) -> None:
    """The files hold modes at 90 and 230 Hz; two amplitudes show that one of them softens."""
    amplitudes, columns = (run_as_printed(example, folder, "--no-pictures") for example in examples("modes"))
    assert "softens by" in amplitudes
    assert " 90 Hz" in columns


@pytest.mark.parametrize(
    ("command", "module", "work"),
    [
        ("diagnose", "dehyst.sim.diagnosis.diagnose", "diagnose_prepared"),
        ("rehearse", "dehyst.lab.rehearsal", "rehearse"),
    ],
)
def test_examples_that_take_minutes_are_read_as_printed(
    command: str, module: str, work: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Up to the work itself: files, columns, plants and events."""

    def begins(*_: object, **__: object) -> None:
        raise InputError("here the work begins")

    monkeypatch.setattr(importlib.import_module(module), work, begins)
    for example in examples(command):
        where = ROOT if "examples/" in example else folder
        out = () if "--out" in example else ("--out", str(folder / "out"))
        assert "here the work begins" in run_as_printed(example, where, *out, status=2)


def test_examples_that_print_run_as_printed(folder: Path) -> None:
    for name in ("completion", "access"):
        for example in examples(name):
            run_as_printed(example, folder)
    assert (folder / "access" / "r1.json5").exists()
    assert "[[axis]]" in run_as_printed(examples("serve")[0], folder)
    assert (folder / "access" / "service.json5").exists()


@pytest.mark.e2e
def test_examples_beside_a_service_run_as_printed(folder: Path, serve: Callable[..., ServeProcess]) -> None:
    service = serve(extra='checkpoints = "checkpoints/{axis}"\ncheckpoint_s = 1.0')
    printed = {
        example: run_as_printed(example, folder, "--endpoint", service.endpoint)
        for name in ("query", "freeze", "thaw", "checkpoints", "select", "retune", "ask-diagnosis")
        for example in examples(name)
    }
    assert "40.0000" in printed["dehyst query 40                              # the voltage for 40 µm at rest"]
    listing, back = examples("rollback")
    assert "checkpoint" in run_as_printed(listing, folder, "--endpoint", service.endpoint)
    assert "rollback from sample" in run_as_printed(back.replace("41", "1"), folder, "--endpoint", service.endpoint)
    learnt = run_as_printed(examples("export")[2], folder, "--endpoint", service.endpoint)
    assert "of dehyst/v1/demo/x after sample" in learnt
    run_as_printed(examples("view")[2], folder, "--endpoint", service.endpoint)
    assert (folder / "run.rrd").stat().st_size > 1000
    _, once, check = examples("status")
    assert '"axes"' in run_as_printed(once, folder, "--endpoint", service.endpoint)
    # No samples come: the check says so by its exit status.
    assert "demo/x: no samples" in run_as_printed(check, folder, "--endpoint", service.endpoint, status=1)
    for name, port in (("metrics", "9464"), ("epics", "")):
        example = examples(name)[0].replace(port or "\0", str(unused_port()))
        if name == "metrics" or importlib.util.find_spec("p4p") is not None:
            comes_up(example, folder, "--endpoint", service.endpoint)


def test_examples_that_serve_come_up_as_printed(stage: Path) -> None:
    """Routers without and with access control, the stage, and a service with its standby."""
    folder = stage
    shutil.rmtree(folder / "access", ignore_errors=True)  # of another test of this file
    for example in examples("access"):
        run_as_printed(example, folder)
    for example in (*examples("router"), examples("stage")[0]):
        comes_up(re.sub("74[0-9]{2}", str(unused_port()), example), folder)
    _, primary, standby = examples("serve")
    config = folder / "serve.toml"
    text = config.read_text()
    for port in ("7447", "7449"):
        text = text.replace(port, str(unused_port()))
    config.write_text(text)
    comes_up(primary, folder, then=lambda: comes_up(standby, folder))


def comes_up(example: str, folder: Path, *more: str, then: Callable[[], None] = lambda: None) -> None:
    """Start an example that serves, until its first line; call ``then``, and end it by Ctrl-C."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dehyst.lab.cli", *words(example), *more],
        cwd=folder, env=environment(), stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith(("ready", "metrics at")), example
        then()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, example
    finally:
        process.kill()
        process.communicate()
