"""Identification from the simulated stage and from measured data, with the held-out errors it reaches."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from adaptive.errors import InputError
from adaptive.identification import IdentifyConfig, identify_lssvm, select
from adaptive.inverse_model import LssvmInverse

DT = 1e-3
QUICK = IdentifyConfig(tune=False, n=200)


def test_memory_beats_two_inputs_on_held_out_data(recording: tuple[np.ndarray, np.ndarray]) -> None:
    memory, report = identify_lssvm(*recording, DT, "memory", QUICK)
    two, chapter = identify_lssvm(*recording, DT, "two", IdentifyConfig(n=200))
    assert report.heldout_mae_pct < 0.1
    assert report.heldout_mae_pct < 0.3 * chapter.heldout_mae_pct
    assert chapter.heldout_mae_pct < 2.0
    assert (memory.name, two.name) == ("lssvm_adaptive", "lssvm_frozen")
    assert two.memory_size == 0


def test_reported_error_is_that_of_a_free_run(recording: tuple[np.ndarray, np.ndarray]) -> None:
    _, report = identify_lssvm(*recording, DT, "memory", QUICK)
    error = report.heldout_model_V - report.heldout_u_V
    assert report.heldout_mae_pct == pytest.approx(100 * np.abs(error).mean() / np.ptp(recording[0]))


def test_evidence_finds_widths_that_fit_better_than_a_guess(recording: tuple[np.ndarray, np.ndarray]) -> None:
    _, guessed = identify_lssvm(*recording, DT, "two", IdentifyConfig(tune=False, n=200))
    _, tuned = identify_lssvm(*recording, DT, "two", IdentifyConfig(n=200))
    assert tuned.heldout_rmse_um < 0.7 * guessed.heldout_rmse_um


def test_deterministic(recording: tuple[np.ndarray, np.ndarray]) -> None:
    one, two = (identify_lssvm(*recording, DT, "memory", QUICK)[0] for _ in range(2))
    np.testing.assert_array_equal(one.alpha, two.alpha)
    np.testing.assert_array_equal(one.beta, two.beta)


def test_selection_spreads_and_does_not_repeat() -> None:
    x = np.concatenate([np.zeros((500, 1)), np.linspace(1, 2, 20)[:, None]])
    rows = select(x, np.ones(1), 40)
    assert np.unique(rows).size == rows.size
    assert np.sum(rows >= 500) >= 15


def test_measured_stack() -> None:
    """Measured recording of a stack actuator, 5 ms, 24 % loop width, 70 nm sensor noise: held out below 0.15 µm."""
    folder = Path(os.environ.get("DEHYST_DATA", Path(__file__).parents[3] / "shared" / "data")) / "picma_stack"
    if not folder.is_dir():
        pytest.skip(f"measured data not found in {folder}; set DEHYST_DATA")
    data = np.genfromtxt(folder / "model_sine_1hz.csv", delimiter=",", names=True)
    model, report = identify_lssvm(data["u_V"], data["y_um"], 5e-3, "memory", IdentifyConfig(tune=False))
    assert isinstance(model, LssvmInverse)
    assert report.heldout_rmse_um < 0.15
    assert report.heldout_mae_pct < 0.25


@pytest.mark.parametrize(
    ("u", "y", "named"),
    [
        (np.zeros(200), np.linspace(0, 1, 200), "constant"),
        (np.zeros(50), np.zeros(50), "at least 100"),
        (np.zeros(200), np.zeros(150), "shapes"),
        (np.full(200, np.nan), np.zeros(200), "finite"),
    ],
)
def test_bad_recordings_are_named(u: np.ndarray, y: np.ndarray, named: str) -> None:
    with pytest.raises(InputError, match=named):
        identify_lssvm(u, y, DT)


def test_bad_configuration_is_named(recording: tuple[np.ndarray, np.ndarray]) -> None:
    with pytest.raises(InputError, match="heldout"):
        IdentifyConfig(heldout=1.0)
    with pytest.raises(InputError, match="inputs"):
        identify_lssvm(*recording, DT, "three")  # type: ignore[arg-type]
