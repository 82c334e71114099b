"""The benchmark of measured records: its yardstick and its scores exactly, and the whole way over a made-up record."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import measured
from benchmarks.measured import SCORES, Record, Source, data_folder, least_squares, main, plays, recursive, replayed
from dehyst.baselines import fit_linear
from dehyst.service.config.settings import COMPETE
from dehyst.service.identification.identifying import Stretch


def test_the_recursion_is_weighted_least_squares_of_the_samples_before_the_age() -> None:
    rng = np.random.default_rng(1)
    n, m, p, forget, age = 60, 40, 4, 0.97, 3
    Z, u = rng.normal(size=(n + m, p)), rng.normal(size=n + m)
    c, P = least_squares(Z[:n], u[:n])
    got = recursive(Z[n:], u[n:], c, P, forget, age)
    prior = 1e-6 * n * np.eye(p)
    for k in range(m):
        seen = max(0, k - age)  # samples of the test that the coefficients have seen
        rows = slice(0, n + seen)
        # Each sample of the test makes all that came before count less, and the prior too.
        weight = forget ** np.r_[np.full(n, seen), np.arange(seen - 1, -1, -1)]
        information = (Z[rows].T * weight) @ Z[rows] + forget**seen * prior
        expected = Z[n + k] @ np.linalg.solve(information, (Z[rows].T * weight) @ u[rows])
        assert got[k] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_a_record_that_is_missing_is_skipped_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DEHYST_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    assert main(["--only", "raster"]) == 1
    assert capsys.readouterr().out.count("missing; set DEHYST_DATA") == 3


def test_the_learner_beats_the_frozen_model_on_a_stage_that_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    t_s = np.arange(6000) * 0.002
    u_V = 4.0 + 4.0 * np.sin(2.0 * np.pi * (0.4 * t_s + 0.1 * np.sin(0.7 * t_s)))
    y_um = 10.0 * u_V - 2.0 * plays(u_V, np.array([0.4, 1.2])).sum(axis=1)
    y_um[3000:] *= 1.03  # where the test begins
    y_um += np.random.default_rng(2).normal(0.0, 0.003, y_um.size)
    rows = np.column_stack([t_s, u_V, y_um])
    np.savetxt(tmp_path / "made.csv", rows, delimiter=",", header="t_s,u_V,y_um", comments="")
    monkeypatch.setenv("DEHYST_DATA", str(tmp_path))
    monkeypatch.setattr(measured, "RECORDS", (Record("made up", Source("made.csv"), (0.0, 6.0), (6.0, 12.0)),))
    assert main(["--json", str(tmp_path / "out.json")]) == 0
    (result,) = json.loads((tmp_path / "out.json").read_text())
    scores = result["scores"]
    assert set(scores) == {*SCORES, "yardstick"}
    assert set(COMPETE) <= set(scores)
    assert scores["frozen"] > 1.0
    assert scores["learner"] < 0.3 * scores["frozen"]
    assert scores["served"] == pytest.approx(scores["learner"], rel=0.05)
    assert result["worst"] < 0.5
    assert result["troubles"] == []
    assert sum(result["verdicts"].values()) == pytest.approx(1.0)
    assert "| made up | 6 / 6 | " in capsys.readouterr().out


@pytest.mark.parametrize(("dt_s", "least", "most"), [(0.001, 61.0, 64.0), (0.005, 13.0, 13.0)])
def test_no_prediction_knows_the_samples_of_the_last_60_ms(dt_s: float, least: float, most: float) -> None:
    n = 400
    u_V = np.arange(float(n))
    test = Stretch(u_V, np.zeros(n), np.zeros((n, 3)), np.ones(n, dtype=np.bool_))
    model = fit_linear(u_V, np.sin(u_V) + u_V, dt_s)[0]
    taught = [-1]
    got = replayed(
        test, dt_s,
        lambda part: taught.append(part.stop - 1),
        lambda: (taught[-1], model, model.rest_memory(0.0)),
        lambda seen, _model, _memory, points: np.full(points[0].size, float(seen)),
    )  # fmt: skip
    ages = u_V - got  # each answer is the last sample that it knows
    assert np.isnan(got[: int(least)]).all()
    assert (np.nanmin(ages), np.nanmax(ages)) == (least, most)
