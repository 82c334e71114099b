"""``dehyst rehearse``: from a file with a plant to a table, a picture and JSON, and what it says where that fails."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dehyst.lab.cli import main
from dehyst.lab.commands.rehearse import failed
from dehyst.lab.rehearsal.rehearsal import remarks
from dehyst.service.cli.python_file import load_object
from dehyst.sim.stage.file import save_stage
from dehyst.sim.stage.presets import preset

ROOT = Path(__file__).resolve().parents[3]
#: Rate-dependent in nothing, and fast: two plays in a line, a sample late.
PLANT = """
import numpy as np

class Stage:
    dt_s, u_min_V, u_max_V = 0.001, 0.0, 10.0

    def __init__(self):
        self.play = np.zeros(2)
        self.y = 0.0

    def run(self, u_V):
        true = np.empty(len(u_V))
        for k, u in enumerate(u_V):
            true[k] = self.y
            self.play = np.clip(self.play, u - np.array([0.5, 1.5]), u + np.array([0.5, 1.5]))
            self.y = 5.0 * u + self.play.sum()
        return true, true + 1e-3 * np.sin(np.arange(len(u_V)) * 7.0)

def memoryless(u_V):
    return 3.0 * u_V, 3.0 * u_V

def short(u_V):
    return u_V[1:], u_V

def endless(u_V):
    return u_V / 0.0 * 0.0, u_V

number = 7
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(PLANT)
    return path


def test_a_stage_file_is_a_plant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "stage.toml"
    save_stage(preset("bouc_wen", changes=((0.1, {"mechanics.payload_kg": 1.0}),)), path)
    options = ["--events", "none", "--settle", "2", "--after", "4", "--no-pictures", "--quiet", "--json"]
    assert main(["rehearse", "--plant", str(path), "--out", str(tmp_path / "out"), *options]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["u_min_V"], found["u_max_V"], found["dt_s"]) == (-2.0, 10.0, 0.001)
    assert found["runs"][0]["adaptive"]["settled_pct"] < 0.1
    assert main(["rehearse", "--plant", str(tmp_path / "none.toml"), "--out", str(tmp_path / "out"), *options]) == 2
    assert "expected a stage file" in capsys.readouterr().err


WATCHED = """
import sys
from numba.core import event
from dehyst.lab.cli import main

class Compiled(event.Listener):
    def on_start(self, event):
        print("compiled:", event.data["dispatcher"].py_func.__qualname__, file=sys.stderr)
    def on_end(self, event):
        pass

event.register("numba:compile", Compiled())
sys.exit(main(sys.argv[1:]))
"""


def test_a_rehearsal_leaves_table_json_and_picture_and_compiles_nothing_that_an_installation_has(
    plant: Path, tmp_path: Path
) -> None:
    """Ten seconds of compiling in the thread that learns are what the first jump of a new installation led to."""
    out, events = tmp_path / "out", ["none", "gain_at_once", "stuck", "zero_at_once"]
    arguments = ["rehearse", "--plant", f"{plant}:Stage", "--events", ",".join(events), "--out", str(out)]
    told = subprocess.run(
        [sys.executable, "-c", WATCHED, *arguments, "--settle", "2", "--after", "4", "--json"],
        capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    assert "identifying" in told.stderr
    assert "[4/4]" in told.stderr
    assert "compiled:" not in told.stderr
    summary = json.loads(told.stdout)
    assert summary == json.loads((out / "rehearsal.json").read_text())
    assert [run["event"]["name"] for run in summary["runs"]] == events
    assert summary["runs"][0]["adaptive"]["settled_pct"] < 0.5
    assert summary["runs"][0]["range_um"] > 10.0
    assert (out / "rehearsal.png").stat().st_size > 10_000
    table = (out / "rehearsal.md").read_text()
    assert table.startswith("| what happens")
    assert "nothing happens" in table
    assert "the stage's gain changes" in table


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("missing.py:Stage", (), "which is not there"),
        ("mine.py", (), "expected FILE.py:NAME"),
        ("mine.py:Other", (), "'Other', which is not in"),
        ("mine.py:number", (), "an object with run"),
        ("mine.py:memoryless", (), "plant.dt_s: got nothing"),
        ("mine.py:memoryless", ("--rate", "-1"), "--rate"),
        ("mine.py:memoryless", ("--rate", "1000", "--u-min", "3", "--u-max", "2"), "more than u_min_V"),
        ("mine.py:short", ("--rate", "1000", "--u-min", "0", "--u-max", "2"), "shape"),
        ("mine.py:endless", ("--rate", "1000", "--u-min", "0", "--u-max", "2"), "a finite displacement"),
        ("mine.py:Stage", ("--events", "thunder"), "some of none"),
        ("mine.py:Stage", ("--seed", "-1"), "--seed"),
        ("mine.py:Stage", ("--settle", "0"), "at least 2 s before"),
        ("mine.py:Stage", ("--controllers", "0,5"), "--controllers"),
        ("mine.py:Stage", ("--mode-hz", "0"), "--mode-hz"),
        ("broken.py:Stage", (), "ZeroDivisionError"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_is_wrong_is_told_by_name(
    plant: Path, capsys: pytest.CaptureFixture[str], name: str, more: tuple[str, ...], words: str
) -> None:
    (plant.parent / "broken.py").write_text("1 / 0\n")
    where = str(plant.parent / name)
    assert main(["rehearse", "--plant", where, "--out", str(plant.parent / "out"), *more]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "got" in told
    assert "expected" in told


def test_readings_of_another_stage_steer_the_example_nowhere() -> None:
    """They move as fast as the stage for 64 ms, and were once taken for a shift of its zero."""
    from dehyst.lab.rehearsal import factory_of, rehearse, standard_events

    made = factory_of(load_object("--plant", f"{ROOT / 'examples' / 'plant.py'}:Stage", ""))
    event = standard_events(0, 4.0)[-1]
    assert event.kind == "foreign"
    done = rehearse(made, events=[event])
    assert not failed(remarks(done.runs[0].outcome))
    assert done.runs[0].outcome.named_s < 0.5


def test_ctrl_c_ends_it_at_once_and_without_a_traceback(plant: Path, tmp_path: Path) -> None:
    arguments = ["rehearse", "--plant", f"{plant}:Stage", "--out", str(tmp_path / "out"), "--settle", "1000"]
    with subprocess.Popen(
        [sys.executable, "-m", "dehyst.lab.cli", *arguments], cwd=ROOT, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as process:  # fmt: skip
        assert process.stderr is not None
        said = ""
        while "[1/" not in said:
            said += process.stderr.readline()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        said += process.stderr.read()
        assert process.wait(timeout=30) == 130
    assert "interrupted" in said
    assert "Traceback" not in said
