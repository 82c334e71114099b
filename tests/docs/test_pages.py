"""The pages say what the code does: the site builds without a warning, and programs on pages are those that run."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from dehyst.lab.cli import main
from dehyst.service.client.client import Client
from dehyst.service.config.settings import read_config
from dehyst.service.stage_node.example_files import DT_S, LENGTH_S, _readings
from dehyst.sim.signals.voltages import training_input

ROOT = Path(__file__).resolve().parents[2]
_SAVED = re.compile(r"Save as `([\w.]+)`.*?\n```(?:python|toml)\n(.*?)```", re.S)


def saved() -> dict[str, str]:
    """The files that the tutorial tells to save."""
    return dict(_SAVED.findall((ROOT / "docs" / "tutorial.md").read_text()))


def test_the_programs_of_the_tutorial_are_those_of_the_examples() -> None:
    programs = {name: text for name, text in saved().items() if name.endswith(".py")}
    assert set(programs) == {"my_stage.py", "record_stage.py", "corrected_move.py"}
    for name, text in programs.items():
        assert text == (ROOT / "examples" / name).read_text(), f"docs/tutorial.md and examples/{name} differ"


def test_the_configuration_of_the_tutorial_is_one(tmp_path: Path) -> None:
    text = saved()["serve.toml"]
    assert tomllib.loads(text)["axis"][0]["model"] == "stage.npz"
    (tmp_path / "serve.toml").write_text(text)
    (axis,) = read_config(tmp_path / "serve.toml").axes
    assert (axis.limits.u_min_V, axis.limits.u_max_V) == (0.0, 80.0)


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.stem)
def test_python_on_a_page_is_python_and_calls_what_a_client_has(page: Path) -> None:
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.S):
        compile(block, page.name, "exec")
        for name in re.findall(r"\bclient\.(\w+)\(", block):
            assert hasattr(Client, name), f"{page.name}: client.{name}"


def test_every_link_leads_to_a_file_of_the_checkout() -> None:
    """The site moves some pages; who reads them in the checkout follows the same links."""
    pages = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    dead = [
        f"{page}: {target}"
        for page in pages.split()
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)", (ROOT / page).read_text())
        if "://" not in target and not (ROOT / page).parent.joinpath(target).exists()
    ]
    assert not dead


def test_the_servo_of_the_page_gains_by_the_model_and_makes_no_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    u_V = training_input(DT_S, LENGTH_S)[1]
    rows = np.column_stack([np.arange(u_V.size) * DT_S, u_V, _readings(u_V)])
    np.savetxt(tmp_path / "recording.csv", rows, delimiter=",", header="t_s,u_V,y_um", comments="", fmt="%.9g")
    files = (str(tmp_path / "recording.csv"), str(tmp_path / "stage.npz"))
    options = ["--models", "lssvm_adaptive", "--no-pictures", "--quiet"]
    assert main(["identify", files[0], "--out", files[1], *options]) == 0
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["servo.py", files[1], str(tmp_path / "servo.png")])
    said = runpy.run_path(str(ROOT / "examples" / "servo.py"), run_name="__main__")
    alone, with_model, step = capsys.readouterr().out.splitlines()
    error_um = [float(re.search(r"mean error ([\d.]+) µm", line)[1]) for line in (alone, with_model)]  # type: ignore[index]
    assert error_um[0] == pytest.approx(2.58, rel=0.1)
    assert error_um[1] < 0.03
    assert step == "step of the voltage at the switch: 0.0000 V"
    assert said["U_MIN_V"] <= said["u_V"].min() < said["u_V"].max() <= said["U_MAX_V"]
    assert (tmp_path / "servo.png").stat().st_size > 10_000


@pytest.mark.skipif(importlib.util.find_spec("mkdocstrings") is None, reason="mkdocs is not installed (extra 'docs')")
def test_the_site_builds_without_a_warning_and_loads_nothing_from_outside(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 40
    fetched = re.compile(r"<(?:script|img|iframe)[^>]*\ssrc=\"https?://|<link[^>]*\shref=\"https?://")
    for page in pages:
        assert not fetched.search(page.read_text()), f"{page.name} loads something from another host"
    assert "resynchronise" in (tmp_path / "site" / "api.html").read_text()
    assert "corrected_move.py" in (tmp_path / "site" / "programs.html").read_text()
    assert "learner.filter.covariance" in (tmp_path / "site" / "state.html").read_text()
