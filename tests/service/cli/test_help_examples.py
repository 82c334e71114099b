"""The examples of each command's --help are real: all of them parse, and those that end soon run as printed.

Endpoints are the exception: a free port takes the place of the default one, so that nothing else here answers.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
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
    """The files that examples name, as one of them writes them into an empty folder."""
    folder = tmp_path_factory.mktemp("examples")
    (writing,) = [example for example in examples("stage") if "--examples" in example]
    assert "recording.csv" in run_as_printed(writing, folder)
    return folder


def run_as_printed(example: str, folder: Path, *more: str) -> str:
    """Run an example in ``folder``; returns what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "dehyst.lab.cli", *words(example), *more],
        cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, f"{example}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def test_no_file_of_the_reader_is_replaced(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "scope.csv").read_bytes()
    assert main(["stage", "--examples", str(folder)]) == 2
    assert "no file is replaced" in capsys.readouterr().err
    assert (folder / "scope.csv").read_bytes() == before


def test_identify_and_replay_run_as_printed(folder: Path) -> None:
    for example in examples("identify"):
        (folder / "stage.npz").unlink(missing_ok=True)
        assert "models: stage.npz" in run_as_printed(example, folder)
        assert (folder / "stage.npz").stat().st_size > 1000
    for example in examples("replay"):
        assert "samples scored" in run_as_printed(example, folder)


def test_export_runs_as_printed(folder: Path) -> None:
    if not (folder / "stage.npz").exists():
        run_as_printed(examples("identify")[0], folder)
    for example in examples("export")[:2]:
        assert "demo_x.c: C99" in run_as_printed(example.replace(" --fmu", ""), folder)


def test_look_runs_as_printed(folder: Path) -> None:
    """The first example finds two columns in V and asks; the second says which is which."""
    asking, understood = examples("look")
    done = subprocess.run(
        [sys.executable, "-m", "dehyst.lab.cli", *words(asking)],
        cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 1
    assert "--column y=CH2" in done.stdout
    assert "understood: 12000 samples" in run_as_printed(understood, folder)


def test_modes_run_as_printed(folder: Path) -> None:
    """The files hold modes at 90 and 230 Hz; two amplitudes show that one of them softens."""
    amplitudes, columns, in_json = (run_as_printed(example, folder, "--no-pictures") for example in examples("modes"))
    assert "softens by" in amplitudes
    assert " 90 Hz" in columns
    assert [round(mode["frequency_hz"][0]) for mode in json.loads(in_json)["modes"]] == [90, 228]


@pytest.mark.timeout(600)
def test_a_diagnosis_runs_as_printed(folder: Path) -> None:
    """The example that reads one period of the drive beside many of readings; it takes a minute."""
    (periods,) = [example for example in examples("diagnose") if "--repeat" in example]
    assert "report: out/diagnosis/report.md" in run_as_printed(periods, folder)


def test_a_plant_that_is_a_function_is_rehearsed_as_printed(folder: Path) -> None:
    (example,) = [example for example in examples("rehearse") if "mine.py" in example]
    assert "the stage rings" in run_as_printed(example, folder)


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
    with pytest.raises(AssertionError, match="demo/x: no samples"):
        run_as_printed(check, folder, "--endpoint", service.endpoint)
    for name, port in (("metrics", "9464"), ("epics", "")):
        example = examples(name)[0].replace(port or "\0", str(unused_port()))
        if name == "metrics" or importlib.util.find_spec("p4p") is not None:
            comes_up(example, folder, "--endpoint", service.endpoint)


def test_examples_that_serve_come_up_as_printed(folder: Path) -> None:
    """Routers without and with access control, the stage, and a service with its standby."""
    shutil.rmtree(folder / "access", ignore_errors=True)  # of another test of this file
    for example in examples("access"):
        run_as_printed(example, folder)
    for example in (*examples("router"), examples("stage")[0]):
        comes_up(re.sub("74[0-9]{2}", str(unused_port()), example), folder)
    if not (folder / "stage.npz").exists():
        run_as_printed(examples("identify")[0], folder)
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


def test_the_plant_of_the_example_is_there() -> None:
    """The example of rehearse takes a minute: its file and class are checked here, its run in tests/lab/rehearsal."""
    (plant,) = [words(e)[2] for e in examples("rehearse") if "examples/" in e]
    path, _, name = plant.partition(":")
    assert f"class {name}" in (ROOT / path).read_text()
