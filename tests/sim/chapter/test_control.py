"""Control experiments of the chapter, frozen and learning."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive.errors import InputError
from baselines.bouc_wen.inverse import BoucWenInverse
from baselines.bouc_wen.model import TABLE_2_1
from baselines.fit import fit_bouc_wen
from baselines.fit_report import Domain
from sim.chapter.adaptive_loop import BlockConfig, replay, track_learning
from sim.chapter.control import (
    changing,
    chapter_reference,
    control_references,
    learner_of,
    moving_mae,
    run_control,
    sine_reference,
    training_reference,
)
from sim.chapter.experiments import DT_S, Score, experiments
from sim.stage.closed_loop import track
from sim.stage.presets import preset
from sim.stage.stage import Stage


def inverse() -> BoucWenInverse:
    return BoucWenInverse(TABLE_2_1, DT_S, Domain(0.0, 90.0, 2000.0))


@pytest.mark.parametrize("make", [chapter_reference, training_reference, sine_reference])
def test_references_are_their_own_derivatives(make: object) -> None:
    reference = make(80.0)  # type: ignore[operator]
    inner = slice(2, -2)
    v = np.gradient(reference.y_um, DT_S)[inner]
    a = np.gradient(reference.v_um_per_s, DT_S)[inner]
    assert np.max(np.abs(v - reference.v_um_per_s[inner])) < 2e-3 * np.max(np.abs(v))
    assert np.max(np.abs(a - reference.a_um_per_s2[inner])) < 5e-3 * np.max(np.abs(a))
    assert reference.y_um.min() >= -1e-9
    assert reference.y_um.max() < 80.0
    assert abs(reference.y_um[0]) < 1e-2


def test_references_stay_within_what_was_identified() -> None:
    data = experiments("rich", quick=True)
    for reference in control_references(data, quick=True).values():
        assert reference.y_um.max() < data.training.y_um.max()
        assert reference.y_um.min() > -0.1


def test_blocks_of_a_model_that_does_not_learn_equal_one_run() -> None:
    """A learner that is never due to learn serves its base: blocks and carried memory must not change a voltage."""
    stage, reference = Stage(preset("bouc_wen")), sine_reference(70.0, duration_s=1.0)
    model = inverse()
    from baselines.bouc_wen.online import BoucWenOnline, TrackingConfig

    online = BoucWenOnline(model, TrackingConfig(learn_every=10**6))
    blocks = track_learning(stage, reference, online, config=BlockConfig(block=7, delay_blocks=2))
    whole = track(stage, reference, model=online.snapshot())
    np.testing.assert_allclose(blocks.u_V, whole.u_V, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(blocks.y_um, whole.y_um)


def test_learning_is_deterministic_and_catches_a_gain_change() -> None:
    stage = Stage(changing(preset("bouc_wen"), 1.0))
    reference = sine_reference(70.0, 2.0, 4.0)
    runs = [track_learning(stage, reference, learner_of(inverse())) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].y_um, runs[1].y_um)
    frozen = track(stage, reference, model=inverse())
    late = slice(2500, None)
    assert np.mean(np.abs(runs[0].error_um[late])) < 0.1 * np.mean(np.abs(frozen.error_um[late]))


def test_snapshot_that_answers_has_not_seen_its_block() -> None:
    """Noise-free change of the future must not change voltages of the past, nor of the blocks within the delay."""
    config = BlockConfig(block=20, delay_blocks=3)
    model = inverse()
    t = np.arange(1000) * DT_S
    u = 2.0 + 2.0 * np.sin(2.0 * np.pi * 3.0 * t)
    y = TABLE_2_1.simulate(u, DT_S) * 1.05
    motion = np.column_stack([y, np.gradient(y, DT_S), np.zeros_like(y)])
    first = replay(learner_of(model), motion, u, y, DT_S, config)
    disturbed = y.copy()
    disturbed[600:] *= 1.02
    second = replay(learner_of(model), motion, u, disturbed, DT_S, config)
    # the samples from 600 on are first seen by the snapshot of the block that ends at 620, and that answers from 660
    np.testing.assert_array_equal(first[:660], second[:660])
    assert np.max(np.abs(first[660:720] - second[660:720])) > 0.0
    with pytest.raises(InputError, match="motion"):
        replay(learner_of(model), motion[:-1], u, y, DT_S)


def test_moving_mean_is_of_the_last_half_second() -> None:
    error = np.zeros(2000)
    error[1000:1500] = 0.5
    trace = moving_mae(error, 50.0)
    assert trace[999] == 0.0
    assert trace[1499] == pytest.approx(1.0)
    assert trace[1999] == pytest.approx(0.0, abs=1e-12)


def test_control_on_the_rich_stage_meets_its_targets() -> None:
    data = experiments("rich", quick=True)
    control = run_control(data, quick=True)
    assert not control.chapter_gains_stable
    assert 0.01 < control.ultimate.gain_V_per_um < 0.0864
    name = "answer to (2.45)"
    assert control.loop("lssvm_memory", "FF", name).score.mae_pct <= 0.10
    assert control.loop("lssvm_memory", "FF+FB", name).score.mae_pct <= 0.010
    # adapting is an advantage over every frozen model and over every baseline that adapts too
    for name in ("answer to (2.45)", "sine 5 Hz", "tones, minor loops, holds"):
        others = [loop for loop in control.loops if loop.reference == name and loop.controller == "FF"]
        assert min(others, key=lambda loop: loop.score.mae_pct).model == "lssvm_adaptive"
    after = {loop.model: loop.score.mae_pct for loop in control.changed}
    assert after["lssvm_adaptive"] < 0.1 * after["lssvm_memory"]
    assert after["lssvm_adaptive"] < min(after["bouc_wen_online"], after["mpi_online"])
    with pytest.raises(InputError, match="no run"):
        control.loop("mpi", "FF", "nothing")


def test_an_identified_bouc_wen_is_exact_on_its_own_stage() -> None:
    data = experiments("bouc_wen", quick=True)
    model = fit_bouc_wen(data.training.u_V, data.training.y_um, DT_S)[0]
    run = track(Stage(data.config), chapter_reference(data.range_um), model=model)
    assert Score.of(run.error_um, data.range_um).mae_pct < 0.01
