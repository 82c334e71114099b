"""The stage: stepping and running, twins, changes, files, and the shape of the presets."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.sim.effects import EFFECTS, Chain
from dehyst.sim.signals.voltages import training_input, triangle
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.file import from_dict, load_stage, save_stage, to_dict
from dehyst.sim.stage.presets import preset, rich_chain
from dehyst.sim.stage.stage import Stage

DT = 1e-3
EVERYTHING = StageConfig(
    "everything",
    Chain(tuple(kind() for kind in EFFECTS.values() if kind.name not in ("linear_actuator", "generalised_play"))),
    rich_chain(),
    seed=4,
    changes=((0.05, {"creep.gain_per_decade": 0.03}), (0.1, {"axis2/resonance.payload_ratio": 1.0})),
)


def voltages(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.clip(4.0 + np.cumsum(rng.normal(size=n)) * 0.2, 0.0, 8.0)


@pytest.mark.parametrize("config", [preset("rich"), preset("bouc_wen"), EVERYTHING], ids=lambda c: c.name)
def test_step_is_run_to_the_last_bit(config: StageConfig) -> None:
    stage = Stage(config)
    u, u2 = voltages(400), voltages(400, 1)
    one, two, three = stage.initial_state(), stage.initial_state(), stage.initial_state()
    y, y2 = stage.run(one, u, u2)
    stepped = np.array([stage.step(two, float(a), float(b)) for a, b in zip(u, u2, strict=True)])
    np.testing.assert_array_equal(stepped, np.column_stack((y, y2)))
    pieces = [stage.run(three, u[a:b], u2[a:b])[0] for a, b in ((0, 1), (1, 60), (60, 61), (61, 400))]
    np.testing.assert_array_equal(np.concatenate(pieces), y)
    np.testing.assert_array_equal(one.s, two.s)
    assert one.k == two.k == three.k == 400
    assert stage.read(one) == stage.read(two)
    assert stage.true(one) == stage.true(two)


def test_a_reading_does_not_know_the_voltage_that_follows_it() -> None:
    stage = Stage(preset("rich"))
    state = stage.initial_state()
    stage.run(state, voltages(50))
    other = state.copy()
    seen = stage.read(state)
    assert stage.step(state, 0.0) == seen
    assert stage.step(other, 8.0) == seen
    assert stage.read(state) != stage.read(other)


def test_twins_share_noise_and_seeds_differ() -> None:
    u = voltages(300)
    a, b, c = (Stage(preset("rich", seed=s)) for s in (1, 1, 2))
    ya, yb, yc = (s.run(s.initial_state(), u)[0] for s in (a, b, c))
    np.testing.assert_array_equal(ya, yb)
    assert np.std(ya - yc) == pytest.approx(np.sqrt(2) * 0.005, rel=0.15)
    # driven by other voltages, twins still have the same noise
    trace = a.run_traced(a.initial_state(), u)
    quiet = b.run_traced(b.initial_state(), np.zeros(300))
    sensors = dataclasses.replace(
        preset("rich", seed=1), effects=rich_chain().without("quantisation").without("sensor_lag")
    )
    moving, still = Stage(sensors), Stage(sensors)
    noise = [
        (lambda tr: tr.y_um - tr.true_um)(s.run_traced(s.initial_state(), v))
        for s, v in ((moving, u), (still, np.zeros(300)))
    ]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
    assert trace.true_um.std() > 1.0 > quiet.true_um.std()


def test_commands_are_clamped_and_checked() -> None:
    stage = Stage(preset("rich", u_max_V=5.0))
    a, b = stage.initial_state(), stage.initial_state()
    ya, _ = stage.run(a, np.full(100, 9.0))
    yb, _ = stage.run(b, np.full(100, 5.0))
    np.testing.assert_array_equal(ya, yb)
    before = a.copy()
    with pytest.raises(InputError, match="finite"):
        stage.step(a, float("nan"))
    with pytest.raises(InputError, match="index 1"):
        stage.run(a, np.array([0.0, np.inf]))
    with pytest.raises(InputError, match="u2_V"):
        stage.run(a, np.zeros(3), np.zeros(4))
    assert a.k == before.k
    np.testing.assert_array_equal(a.s, before.s)


def test_scheduled_and_imperative_changes_agree() -> None:
    change = {"gain_drift.gain": -0.06, "resonance.payload_ratio": 1.0}
    u = voltages(200)
    scheduled = Stage(preset("rich", changes=((0.1, change),)))
    plain = Stage(preset("rich"))
    a = scheduled.initial_state()
    ya, _ = scheduled.run(a, u)
    b = plain.initial_state()
    # the change holds for the reading at 0.1 s, which the hundredth command leads to
    first, _ = plain.run(b, u[:99])
    b = plain.with_changes(b, change)
    second, _ = plain.run(b, u[99:])
    np.testing.assert_array_equal(ya, np.concatenate((first, second)))
    c = plain.initial_state()
    yc, _ = plain.run(c, u)
    np.testing.assert_array_equal(ya[:100], yc[:100])
    assert ya[100] != yc[100]
    with pytest.raises(InputError, match=r"gain_drift\.gian"):
        plain.with_changes(b, {"gain_drift.gian": 0.0})


@pytest.mark.parametrize("suffix", [".toml", ".json"])
@pytest.mark.parametrize("config", [preset("rich", seed=3), preset("bouc_wen"), EVERYTHING], ids=lambda c: c.name)
def test_round_trip(config: StageConfig, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"stage{suffix}"
    save_stage(config, path)
    again = load_stage(path)
    assert again == config
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


@settings(max_examples=25, deadline=None)
@given(values=st.lists(st.floats(0.0, 1.0), min_size=40, max_size=40), seed=st.integers(0, 2**31))
def test_round_trip_of_any_values(values: list[float], seed: int) -> None:
    chain = rich_chain()
    drawn = iter(values)
    changes = {
        f"{e.label}.{p.name}": p.low + next(drawn) * (min(p.high, 1e6) - p.low)
        for e in chain
        for p in e.kind.parameters
        if p.name != "bits"
    }
    config = StageConfig("drawn", chain.replace(changes), seed=seed)
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": "red"}, "unknown key 'color'"),
        ({"effects": [{"effect": "warp"}]}, r"effects\[0\].*'warp'"),
        ({"effects": [{"effect": "creep", "gain": 0.1}]}, r"effects\[0\].*creep\.gain.*gain_per_decade"),
        ({"effects": [{"effect": "creep", "t0_s": "soon"}]}, r"creep\.t0_s.*'soon'"),
        ({"effects": [{"effect": "creep", "t0_s": -1.0}]}, "from 0.005 to 1 s"),
        ({"effects": "creep"}, "effects: got 'creep', expected a list"),
        ({"effects": [3]}, r"effects\[0\]: got 3"),
        ({"dt_s": "1ms"}, "dt_s: got '1ms'"),
        ({"dt_s": 0.0}, "dt_s"),
        ({"seed": 1.5}, "seed"),
        ({"u_min_V": 9.0, "u_max_V": 1.0}, "u_min_V, u_max_V"),
        ({"u_min_V": 1.0}, "0 V"),
        ({"changes": [{"t_s": -1.0, "set": {}}]}, "changes"),
        ({"changes": [{"t_s": 1.0, "set": {"creep.gian": 0.0}}]}, r"creep\.gian"),
        ({"changes": [{"t_s": 1.0, "put": {}}]}, "unknown key 'put'"),
        ({"name": 3}, "name"),
    ],
)
def test_bad_configuration_is_refused_by_name(change: dict[str, object], message: str) -> None:
    data = {**to_dict(preset("rich")), **change}
    with pytest.raises(InputError, match=message):
        from_dict(data)


def loops(config: StageConfig, low_V: float, high_V: float, frequency_Hz: float) -> tuple[float, float]:
    """(height of the third loop relative to its stroke, stroke in µm), free of lag: voltage where it acts."""
    _, u = triangle(low_V, high_V, frequency_Hz, 3.0)
    u = np.concatenate((np.linspace(0.0, low_V, 1000), u))
    keep = tuple(e for e in config.effects if e.name in ("generalised_play", "duhem", "bouc_wen"))
    stage = Stage(dataclasses.replace(config, effects=Chain(keep), second_axis=None))
    y = stage.run(stage.initial_state(), np.append(u, u[-1]))[0][1:]
    per = round(1 / frequency_Hz / DT)
    u, y = u[-per:], y[-per:]
    top = int(np.argmax(u))
    grid = np.linspace(low_V, high_V, 41)[2:-2]
    gap = np.interp(grid, u[top:][::-1], y[top:][::-1]) - np.interp(grid, u[: top + 1], y[: top + 1])
    return float(gap.max() / np.ptp(y)), float(np.ptp(y))


def test_rich_has_the_chapters_range_and_loops() -> None:
    config = preset("rich")
    stage = Stage(config)
    _, u = training_input(DT)
    y, _ = stage.run(stage.initial_state(), u)
    assert u.max() == pytest.approx(7.85, abs=0.01)
    assert 88.0 < y.max() < 90.0
    full, _ = loops(config, 0.0, 7.85, 1.0)
    assert 0.10 < full < 0.15
    small, _ = loops(config, 3.9, 4.1, 1.0)
    assert 0.01 < small < 0.045
    slow, fast = loops(config, 0.0, 7.85, 0.1)[0], loops(config, 0.0, 7.85, 10.0)[0]
    assert 1.04 * slow < fast < 1.2 * slow
    heights = [loops(config, 0.0, v, 1.0)[0] * loops(config, 0.0, v, 1.0)[1] for v in (2.0, 4.0, 6.0, 8.0)]
    assert np.all(np.diff(heights) > 0.5)
