"""What has changed since a model was good: causes hidden in a stage of another class than the model's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.smoothing import SmootherConfig, smooth_recording
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.baselines import fit_mpi
from dehyst.sim.changes import Comparison, Stretch, compare
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

DT_S = 1e-3
CHANGE_S = 11.0


@pytest.fixture(scope="module")
def model() -> InverseModel:
    stage = Stage(preset("rich", dt_s=DT_S, seed=1))
    u_V = training_input(DT_S, 10.0)[1]
    return fit_mpi(u_V, stage.run(stage.initial_state(), u_V)[0], DT_S)[0]


def drive() -> FloatArray:
    """20 s of two sines whose sum swings through most of the range every four seconds."""
    t = np.arange(round(20.0 / DT_S)) * DT_S
    return np.asarray(
        3.5 - 2.5 * np.cos(2 * np.pi * 0.25 * t) - 0.8 * np.cos(2 * np.pi * 4.0 * t) + 0.3 * np.sin(60 * t)
    )


def stretches(config: StageConfig, add_um: FloatArray | None = None) -> tuple[Stretch, Stretch]:
    u_V = drive()
    stage = Stage(config)
    y_um = stage.run(stage.initial_state(), u_V)[0]
    if add_um is not None:
        y_um = y_um + add_um
    t_s = np.arange(u_V.size) * DT_S
    motion = smooth_recording(y_um, SmootherConfig.for_rate(DT_S))
    change = round(CHANGE_S / DT_S)
    before, after = slice(2000, change - 50), slice(change - 4000, u_V.size - 50)
    scored = np.ones(u_V.size, dtype=np.bool_)
    late = t_s > CHANGE_S + 0.05
    return (
        Stretch(DT_S, t_s[before], u_V[before], motion[before], scored[before]),
        Stretch(DT_S, t_s[after], u_V[after], motion[after], late[after]),
    )


def found(model: InverseModel, **change: float) -> Comparison:
    config = preset("rich", dt_s=DT_S, seed=2)
    values = {name.replace("__", "."): value for name, value in change.items()}
    return compare(model, *stretches(replace(config, changes=((CHANGE_S, values),)) if values else config))


def test_nothing_has_changed_in_a_stage_that_did_not(model: InverseModel) -> None:
    told = found(model)
    assert (told.verdict, told.changes) == ("unchanged", ())
    assert told.as_dict()["effects"] == []


@pytest.mark.parametrize("gain", [-0.06, -0.019, 0.03])
def test_a_gain_is_named_with_its_size(model: InverseModel, gain: float) -> None:
    told = found(model, gain_drift__gain=gain)
    assert told.verdict == "changed"
    assert told.changes[0].name == "gain_drift"
    assert told.changes[0].numbers["gain"] == pytest.approx(gain, abs=0.006)
    assert told.text.startswith(f"the model's error grew: gain drift, {'-' if gain < 0 else '+'}")
    assert told.left_um < 0.5 * told.recent_um


def test_an_offset_and_a_lag_are_told_from_a_gain(model: InverseModel) -> None:
    offset = found(model, thermal_drift__offset_um=1.5)
    assert [c.name for c in offset.changes] == ["thermal_drift"]
    assert offset.changes[0].numbers["offset_um"] == pytest.approx(1.5, abs=0.4)
    lag = found(model, sensor_lag__tau_s=1.5e-3)
    assert lag.changes[0].name == "sensor_lag"
    assert lag.changes[0].numbers["tau_s"] == pytest.approx(1.2e-3, rel=0.2)
    assert {"amplifier_lag", "delay"} <= set(lag.changes[0].alternatives)


def test_mains_hum_is_seen_beside_the_motion(model: InverseModel) -> None:
    t = np.arange(round(20.0 / DT_S)) * DT_S
    hum = np.where(t > CHANGE_S, 0.3 * np.sin(2 * np.pi * 50.1 * t), 0.0)
    told = compare(model, *stretches(preset("rich", dt_s=DT_S, seed=2), hum))
    assert "mains_hum" in [c.name for c in told.changes]


def test_something_of_no_known_kind_is_called_that(model: InverseModel) -> None:
    t = np.arange(round(20.0 / DT_S)) * DT_S
    strange = np.where(t > CHANGE_S, 1.5 * np.sin(9.3 * t + 3.0 * np.sin(1.7 * t)), 0.0)
    told = compare(model, *stretches(preset("rich", dt_s=DT_S, seed=2), strange))
    assert told.verdict == "unexplained"
    assert "no known cause" in told.text


def test_too_little_is_refused_by_name(model: InverseModel) -> None:
    before, after = stretches(preset("rich", dt_s=DT_S, seed=2))
    none = replace(after, scored=np.zeros(after.u_V.size, dtype=np.bool_))
    with pytest.raises(InputError, match="recent"):
        compare(model, before, none)
    still = replace(before, motion=np.zeros_like(before.motion))
    with pytest.raises(InputError, match="without motion"):
        compare(model, still, after)
