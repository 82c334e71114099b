"""The examples of each command's --help are real: all of them parse, and those that end soon run as printed.

Endpoints are the exception: a free port takes the place of the default one, so that nothing else here answers.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from lab.cli import COMMANDS, main
from service.cli.main import build_parser
from sim.signals.voltages import training_input
from tests.service.conftest import ServeProcess

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
    """The files that examples name: recordings of a play operator, in the forms that they say."""
    folder = tmp_path_factory.mktemp("examples")
    t_s, u_V = training_input(0.005, 12.0)
    y_um = np.empty(u_V.size)
    play = 0.0
    for k, u in enumerate(u_V):
        play = min(max(play, u - 1.0), u + 1.0)
        y_um[k] = 8.0 * u + 3.0 * play
    y_um += 0.005 * np.random.default_rng(3).standard_normal(y_um.size)
    rows = np.column_stack([t_s, u_V, y_um])
    np.savetxt(folder / "recording.csv", rows, delimiter=",", header="t_s,u_V,y_um", comments="")
    np.savetxt(
        folder / "scope.csv", rows * (1e3, 1.0, 0.1), delimiter=",", header="Time,CH1,CH2", comments="", fmt="%.9g"
    )
    (folder / "trajectory.csv").write_text("y,v,a\n40,0,0\n40.1,100,0\n40.2,100,0\n")
    for name, shift_s in (("training", 0.0), ("other", 1.0)):
        table = pyarrow.table({"t_s": t_s * 4.0 + shift_s, "u_V": u_V, "y_um": y_um})
        parquet.write_table(table, folder / f"{name}.parquet")
    return folder


def run_as_printed(example: str, folder: Path, *more: str) -> str:
    """Run an example in ``folder``; returns what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "lab.cli", *words(example), *more],
        cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, f"{example}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def test_identify_runs_as_printed(folder: Path) -> None:
    for example in examples("identify"):
        (folder / "stage.npz").unlink(missing_ok=True)
        assert "models: stage.npz" in run_as_printed(example, folder)
        assert (folder / "stage.npz").stat().st_size > 1000


def test_look_runs_as_printed(folder: Path, tmp_path: Path) -> None:
    """The first example finds two columns in V and asks; the second says which is which."""
    rows = (folder / "scope.csv").read_text().splitlines()
    (tmp_path / "scope.csv").write_text("\n".join([rows[0], "ms,V,V", *rows[1:]]))
    asking, understood = examples("look")
    done = subprocess.run(
        [sys.executable, "-m", "lab.cli", *words(asking)],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 1
    assert "--column y=CH2" in done.stdout
    assert "understood: 2400 samples" in run_as_printed(understood, tmp_path)


def test_examples_that_print_run_as_printed(folder: Path) -> None:
    for name in ("completion", "access"):
        for example in examples(name):
            run_as_printed(example, folder)
    assert "[[axis]]" in run_as_printed(examples("serve")[0], folder)
    assert (folder / "access" / "service.json5").exists()


@pytest.mark.e2e
def test_examples_beside_a_service_run_as_printed(folder: Path, serve: Callable[..., ServeProcess]) -> None:
    service = serve(extra='checkpoints = "checkpoints/{axis}"\ncheckpoint_s = 1.0')
    printed = {
        example: run_as_printed(example, folder, "--endpoint", service.endpoint)
        for name in ("query", "freeze", "thaw", "checkpoints", "select", "retune")
        for example in examples(name)
    }
    assert "40.0000" in printed["dehyst query 40                              # the voltage for 40 µm at rest"]
    run_as_printed(examples("rollback")[0].replace("41", "1"), folder, "--endpoint", service.endpoint)
    run_as_printed(examples("view")[2], folder, "--endpoint", service.endpoint)
    assert (folder / "run.rrd").stat().st_size > 1000
    once = examples("status")[1]
    assert '"axes"' in run_as_printed(once, folder, "--endpoint", service.endpoint)


def test_examples_that_serve_come_up_as_printed(folder: Path, free_port: int) -> None:
    for name in ("router", "stage"):
        example = examples(name)[0].replace("7450", str(free_port)).replace("7448", str(free_port))
        process = subprocess.Popen(
            [sys.executable, "-m", "lab.cli", *words(example)],
            cwd=folder, env=environment(), stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready"), example
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0, example
        finally:
            process.kill()
            process.communicate()


def test_the_plant_of_the_example_is_there() -> None:
    """The example of rehearse takes a minute: its file and class are checked here, its run in tests/lab/rehearsal."""
    (plant,) = [words(e)[2] for e in examples("rehearse") if "examples/" in e]
    path, _, name = plant.partition(":")
    assert f"class {name}" in (ROOT / path).read_text()
