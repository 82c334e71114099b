"""Identification from the simulated stage and from measured data, with the held-out errors it reaches."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive import identification
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm, select
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import FloatArray, Sample
from dehyst.sim.signals.voltages import training_input
from tests.foreign.plants import random_plant

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


def answered(model: LssvmInverse, u_V: FloatArray, y_um: FloatArray) -> FloatArray:
    """(n,) errors of what a learner answers, V: blocks of 20 samples, each from before its own samples are learnt."""
    learner, memory, error_V = Learner.from_model(model), model.rest_memory(float(y_um[0])), np.empty(u_V.size)
    v_um_per_s = np.gradient(y_um, model.dt_s)
    motion = np.column_stack([y_um, v_um_per_s, np.gradient(v_um_per_s, model.dt_s)])
    for start in range(0, u_V.size, 20):
        part = slice(start, start + 20)
        y, v, a = np.ascontiguousarray(motion[part].T)
        answer = learner.snapshot().feedforward(y, v, a, memory)
        memory, error_V[part] = answer.memory, answer.u_V - u_V[part]
        for k in range(start, min(start + 20, u_V.size)):
            learner.handle(Sample(k, k * model.dt_s, float(u_V[k]), float(y_um[k])))
    return error_V


def test_the_kernel_does_not_fit_single_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stage whose residual is smooth in time but does not repeat: with the gamma of the evidence alone the kernel
    part makes the answers on another motion worse."""
    factory = random_plant(61_000_009)
    low_V, high_V = factory.traits.excite_V
    wave = training_input(factory.traits.dt_s, 10.0)[1]
    t = np.arange(0.0, 6.0, factory.traits.dt_s)
    other = 0.45 * np.minimum(1.0, t / 0.5) - 0.3 * np.cos(4.4 * t) - 0.15 * np.cos(14.5 * t) * np.minimum(1.0, t / 0.5)
    motions = []
    for share in (wave / wave.max(), other - other[0]):
        plant, u_V = factory(), low_V + (high_V - low_V) * share
        plant.run(np.full(1000, low_V))
        true_um, read_um = plant.run(u_V)
        motions.append((u_V, true_um, read_um))
    (u_V, _, read_um), (other_V, other_um, _) = motions
    limited, _ = identify_lssvm(u_V, read_um, factory.traits.dt_s)
    assert limited.gamma == identification.GAMMA_MAX
    monkeypatch.setattr(identification, "GAMMA_MAX", np.inf)
    free, _ = identify_lssvm(u_V, read_um, factory.traits.dt_s)
    assert free.gamma > limited.gamma
    settled = slice(other_V.size // 2, None)
    errors = [float(np.abs(answered(model, other_V, other_um)[settled]).mean()) for model in (limited, free)]
    assert errors[0] < 0.7 * errors[1]


def test_the_gamma_of_a_model_without_a_linear_part_is_that_of_the_evidence(
    recording: tuple[np.ndarray, np.ndarray],
) -> None:
    assert identify_lssvm(*recording, DT, "two", IdentifyConfig(n=200))[0].gamma > identification.GAMMA_MAX


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
