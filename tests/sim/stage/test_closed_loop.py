"""Feedback (2.46), feedforward, both, and Ziegler and Nichols' experiment."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dehyst.adaptive.errors import NumericsError
from dehyst.sim.effects import Chain, effect
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.stage.closed_loop import PID, PIDState, track, ultimate_gain
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

DT = 1e-3


def test_pid_is_the_increment_of_the_chapter() -> None:
    pid = PID(k_p=0.1, k_i=20.0, k_d=1e-4)
    state = PIDState()
    errors = [0.3, -0.2, 0.5, 0.1]
    outputs = [pid.step(state, e) for e in errors]
    e = np.array([0.0, 0.0, *errors])
    expected = np.cumsum(0.1 * (e[2:] - e[1:-1]) + 20.0 * DT * e[2:] + 1e-4 / DT * (e[2:] - 2 * e[1:-1] + e[:-2]))
    np.testing.assert_allclose(outputs, expected, rtol=1e-12)
    # a constant error integrates at the continuous gain, whatever the sample time
    for dt in (1e-3, 1e-4):
        p = PID(k_p=0.0, k_i=20.0, dt_s=dt)
        s = PIDState()
        for _ in range(round(0.5 / dt)):
            p.step(s, 0.1)
        assert s.u_V == pytest.approx(20.0 * 0.1 * 0.5)


def test_no_wind_up_at_the_limits() -> None:
    """A reference out of reach for a second is forgotten within tens of milliseconds."""
    reference = demo_reference(2.0, DT, (5.0, 60.0), seed=1)
    y = np.where(np.arange(2000) < 1000, 200.0, 40.0)
    beyond = dataclasses.replace(reference, y_um=y)
    run = track(Stage(preset("bouc_wen")), beyond, pid=PID(k_p=0.0, k_i=20.0))
    assert run.u_V.max() == 10.0
    assert abs(run.error_um[1150:]).max() < 1.0


def test_ultimate_gain_of_a_known_plant() -> None:
    """First-order lag and a whole sample of delay: the edge of stability is in closed form.

    ``y' = a y + (1 - a) g u`` with ``u = -K y`` of the sample before: poles of ``z² - a z + (1 - a) g K``; on the unit
    circle where ``(1 - a) g K = 1``, at the angle with cosine ``a/2``.
    """
    tau, gain = 3e-3, 10.0
    a = np.exp(-DT / tau)
    chain = Chain(
        (
            effect("amplifier_lag", tau_s=tau),
            effect("linear_actuator", gain_um_per_V=gain),
            effect("delay", delay_s=DT),
        )
    )
    found = ultimate_gain(Stage(StageConfig("lag", chain)), level_um=40.0)
    assert found.gain_V_per_um == pytest.approx(1.0 / ((1.0 - a) * gain), rel=0.02)
    assert found.period_s == pytest.approx(2 * np.pi * DT / np.arccos(a / 2.0), rel=0.01)


def test_ziegler_nichols_gains_stabilise_the_rich_stage() -> None:
    stage = Stage(preset("rich"))
    found = ultimate_gain(stage)
    assert 1.9e-3 < found.period_s < 4e-3
    pid = found.pi_gains(DT)
    assert pid.k_p == pytest.approx(0.45 * found.gain_V_per_um)
    assert pid.k_i == pytest.approx(pid.k_p * 1.2 / found.period_s)
    reference = demo_reference(3.0, DT, (5.0, 60.0), seed=1)
    run = track(stage, reference, pid=pid)
    assert np.abs(run.error_um).mean() < 0.03 * 89.0
    # and the edge is an edge: half as much again is unstable
    wild = track(stage, reference, pid=PID(k_p=1.5 * found.gain_V_per_um, k_i=0.0))
    assert np.abs(wild.error_um).max() > 50.0


def test_a_plant_that_never_oscillates_is_reported() -> None:
    """Half a picometre a volt: no gain within reason brings it to the edge."""
    chain = Chain((effect("linear_actuator", gain_um_per_V=5e-3),))
    with pytest.raises(NumericsError, match="ultimate gain"):
        ultimate_gain(Stage(StageConfig("faint", chain)), level_um=0.02, kick_um=0.01)
