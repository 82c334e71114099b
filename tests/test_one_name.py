"""Everything is `dehyst`: no module of a user's own takes the place of one of ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dehyst
from dehyst.adaptive.errors import DehystError
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

ROOT = Path(__file__).resolve().parents[1]
DT_S = 1e-3


def run(code: str, folder: Path) -> str:
    """Standard output of a program in ``folder``, which must succeed."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_modules_of_a_users_own_with_the_names_of_our_folders_change_nothing(tmp_path: Path) -> None:
    for name in ("adaptive", "baselines", "sim", "service", "lab"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('the module of the user')\n")
    code = (
        "import dehyst\nfrom dehyst.sim.recordings import read\nfrom dehyst.lab.cli import main\n"
        "print(dehyst.Client.__module__, dehyst.Learner.__module__)"
    )
    assert run(code, tmp_path).split() == ["dehyst.service.client.client", "dehyst.adaptive.online.learner"]


def test_importing_dehyst_loads_nothing_else(tmp_path: Path) -> None:
    assert run("import sys, dehyst; print({'numpy', 'zenoh', 'numba'} & set(sys.modules))", tmp_path).strip() == "set()"


def test_a_stage_is_identified_and_followed_by_what_the_top_offers() -> None:
    stage = Stage(preset("rich", dt_s=DT_S, seed=20))
    u_V = training_input(DT_S, 4.0)[1]
    y_um = stage.run(stage.initial_state(), u_V)[0]
    learner = dehyst.Learner.from_model(dehyst.identify(u_V, y_um, DT_S))
    for k in range(200):
        learner.handle(dehyst.Sample(seq=k, t_s=k * DT_S, u_V=float(u_V[k]), y_um=float(y_um[k])))
    assert learner.counters()["learnt"] > 20


def test_what_cannot_be_used_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DehystError, match="at least 100"):
        dehyst.identify(np.zeros(5), np.zeros(5), DT_S)
    (tmp_path / "short.csv").write_text("t_s,u_V,y_um\n0.000,1.0,10.0\n0.001,1.1,10.5\n")
    with pytest.raises(DehystError, match=r"short\.csv"):
        dehyst.diagnose(tmp_path / "short.csv")
    with pytest.raises(AttributeError, match="no attribute 'clients'"):
        dehyst.clients  # noqa: B018
