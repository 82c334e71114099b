"""The baselines that learn online: they follow a stage that changes, keep their signs, and refuse bad samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray, Sample
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse
from dehyst.baselines.bouc_wen.online import BoucWenOnline, TrackingConfig
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse, LinearOnline, LinearParameters
from dehyst.baselines.online_baseline import LeastSquaresConfig
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline

DT = 1e-3
SEEN = Domain(0.0, 80.0, 2000.0)
R = tuple(float(value) for value in np.arange(7) * 0.6)
MPI = MpiParameters(R, (7.0, 1.5, 1.0, 0.5, 0.5, 0.2, 0.1), (0.0, 30.0), (1.0, -0.1))
Online = LinearOnline | MpiOnline | BoucWenOnline


def build(kind: str) -> Online:
    if kind == "linear":
        return LinearOnline(LinearInverse(LinearParameters(11.0), DT, SEEN, 0.1))
    if kind == "mpi":
        return MpiOnline(MpiInverse(MPI, DT, SEEN, 0.01))
    return BoucWenOnline(BoucWenInverse(TABLE_2_1, DT, SEEN, 0.01))


every = pytest.mark.parametrize("kind", ["linear", "mpi", "bouc_wen"])


def drive(n: int, seed: int = 0) -> FloatArray:
    """Voltages of several tones between 0.5 and 5 Hz within 0.3 to 6.7 V."""
    t, rng = np.arange(n) * DT, np.random.default_rng(seed)
    u = sum(np.sin(2 * np.pi * f * t + p) for f, p in zip((0.5, 1.3, 2.9, 5.0), rng.uniform(0, 6, 4), strict=True))
    return np.asarray(3.5 + 0.8 * u * (1 - np.exp(-t)))


def feed(model: Online, u: FloatArray, y: FloatArray, first: int = 0) -> list[str]:
    return [model.handle(Sample(first + k, (first + k) * DT, float(u[k]), float(y[k]))) for k in range(u.size)]


def stage(kind: str, gain: float, offset: float) -> LinearParameters | MpiParameters:
    """The truth: the identified model with its displacement scaled and shifted."""
    if kind == "linear":
        return LinearParameters(11.0 * gain, offset)
    w_s = tuple(gain * w for w in MPI.w_s)
    return replace(MPI, w_s=w_s, y_ref_um=offset)


@every
def test_follows_gain_and_offset(kind: str) -> None:
    u = drive(20_000)
    if kind == "bouc_wen":
        y = TABLE_2_1.with_gain(0.94 * TABLE_2_1.d_um_per_V, -1.5).simulate(u, DT)
    else:
        y = stage(kind, 0.94, -1.5).simulate(u, DT)
    y = y + np.random.default_rng(1).normal(0.0, 0.005, u.size)
    model = build(kind)
    before = model.snapshot()
    outcomes = feed(model, u, y)
    assert outcomes.count("learnt") > 1000
    zero = np.zeros(u.size)
    v = np.gradient(y, DT)
    memory = before.track(y[:1], zero[:1], zero[:1], u[:1], np.zeros(before.memory_size))

    def error_V(inverse: LinearInverse | MpiInverse | BoucWenInverse) -> float:
        answer = inverse.feedforward(y, v if kind == "bouc_wen" else zero, zero, memory).u_V
        return float(np.mean(np.abs(answer - u)[-5000:]))

    assert error_V(before) > 0.2
    assert error_V(model.snapshot()) < 0.02
    assert model.snapshot().voltage_std_V < 0.05


def test_bouc_wen_follows_the_shape_too() -> None:
    truth = replace(TABLE_2_1, alpha=0.40, d_um_per_V=11.0)
    u = drive(30_000)
    model = build("bouc_wen")
    feed(model, u, truth.simulate(u, DT))
    now = model.snapshot().parameters
    assert now.alpha == pytest.approx(0.40, abs=0.02)
    assert now.d_um_per_V == pytest.approx(11.0, rel=0.02)


def test_mpi_neither_overshoots_a_change_of_gain_nor_deflates() -> None:
    """Slow small motion that never sees the top of the range, then the gain falls: the error falls at once, for good.

    The scale of an MPI model is free but for a constraint; held where nobody goes, all else would shrink to nothing.
    """
    t = np.arange(24_000) * DT
    u = 3.0 + 1.2 * np.sin(2 * np.pi * 1.1 * t) + 0.8 * np.sin(2 * np.pi * 2.3 * t + 1.0)
    # Another class of hysteresis: no weights are right, and each stretch of motion asks for other ones.
    y = TABLE_2_1.simulate(u, DT)
    changed = y.copy()
    changed[12_000:] *= 0.94
    model = build("mpi")
    slopes, worst = [], 0.0
    memory = model.snapshot().rest_memory(float(changed[0]))
    zero = np.zeros(20)
    for k in range(0, t.size, 20):
        part = slice(k, k + 20)
        said = model.snapshot().feedforward(changed[part], zero, zero, memory)
        memory = said.memory
        if k >= 13_000:
            worst = max(worst, float(np.mean(np.abs(said.u_V - u[part]))))
        feed(model, u[part], changed[part], first=k)
        slopes.append(float(np.sum(model._shape.w_h_)))
    assert worst < 0.12
    assert min(slopes[100:]) > 0.95 * max(slopes[100:])


@every
def test_identified_model_stays_on_its_own_stage(kind: str) -> None:
    u = drive(6_000)
    y = TABLE_2_1.simulate(u, DT) if kind == "bouc_wen" else stage(kind, 1.0, 0.0).simulate(u, DT)
    model = build(kind)
    before = model.snapshot()
    feed(model, u, y)
    probe = np.linspace(5.0, 60.0, 200)
    zero = np.zeros(200)
    old, new = (m.feedforward(probe, zero, zero, m.rest_memory(5.0)).u_V for m in (before, model.snapshot()))
    assert np.max(np.abs(old - new)) < 2e-3


@every
def test_bad_samples_are_counted_and_change_nothing(kind: str) -> None:
    u = drive(1500)
    y = 11.0 * u
    clean, dirty = build(kind), build(kind)
    feed(clean, u, y)
    feed(dirty, u[:700], y[:700])
    assert dirty.handle(Sample(700, 0.7, float("nan"), 1.0)) == "not_finite"
    assert dirty.handle(Sample(700, 0.7, 1.0, float("inf"))) == "not_finite"
    assert dirty.handle(Sample(700, float("nan"), 1.0, 1.0)) == "not_finite"
    assert dirty.handle(Sample(700, 0.7, 1e300, 1.0)) == "not_finite"
    assert dirty.handle(Sample(699, 0.699, 1.0, 1.0)) == "duplicate"
    assert dirty.handle(Sample(500, 0.5, 1.0, 1.0)) == "out_of_order"
    assert dirty.handle(Sample(700, 5.0, 1.0, 1.0)) == "timing"
    feed(dirty, u[700:], y[700:], first=700)
    assert dirty.snapshot() == clean.snapshot()
    counted = dirty.counters()
    assert (counted["not_finite"], counted["duplicate"], counted["out_of_order"], counted["timing"]) == (4, 1, 1, 1)
    assert sum(counted.values()) == 1500 + 7
    assert dirty.seq == 1499


@every
def test_a_gap_settles_before_it_teaches(kind: str) -> None:
    u = drive(2000)
    model = build(kind)
    feed(model, u[:1000], 11.0 * u[:1000])
    outcomes = feed(model, u[1100:], 11.0 * u[1100:], first=1100)
    assert outcomes[0] == "gap"
    assert set(outcomes[1:50]) == {"settling"}
    assert "learnt" in outcomes


@every
def test_rest_teaches_nothing(kind: str) -> None:
    u = np.concatenate([drive(2000), np.full(3000, drive(2000)[-1])])
    model = build(kind)
    feed(model, u[:2100], 11.0 * u[:2100])
    before = model.snapshot()
    outcomes = feed(model, u[2100:], 11.0 * u[2100:], first=2100)
    assert "learnt" not in outcomes
    assert "unexcited" in outcomes
    assert model.snapshot() == before


@pytest.mark.parametrize(
    "bad", [{"learn_every": 1}, {"solve_every": 0}, {"remember": 1.0}, {"trust": 0.0}, {"excitation": -1.0}]
)
def test_bad_least_squares_settings_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError):
        LeastSquaresConfig(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [{"learn_every": 0}, {"walk_std": (1.0, -1.0, 0, 0, 0)}, {"model_error": 0.0}])
def test_bad_tracking_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(InputError):
        TrackingConfig(**bad)  # type: ignore[arg-type]
