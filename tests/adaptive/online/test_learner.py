"""The learner: snapshots, states, jumps and weights of samples."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.drift import DriftFilter
from dehyst.adaptive.online.gates import AdmissionConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import FloatArray, Sample
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

# --- The learner in the loop with the simulated stage, at the delays at which it is served.

DT, BLOCK = 1e-3, 20
#: An answer asked for block b was computed from samples at least this much older than its first point.
AGE = 60


@dataclass
class Run:
    """u, y, reference, and the learner at the end; errors in percent of the commanded range."""

    u: FloatArray
    y: FloatArray
    y_d: FloatArray
    learner: Learner

    def mae(self, start_s: float, end_s: float) -> float:
        part = slice(round(start_s / DT), round(end_s / DT))
        return float(100 * np.mean(np.abs(self.y - self.y_d)[part]) / np.ptp(self.y_d))


def run(
    model: LssvmInverse,
    seconds: float,
    changes: dict[str, float] | None = None,
    at_s: float = 0.0,
    learn: bool = True,
    disturb: FloatArray | None = None,
    motion: tuple[FloatArray, FloatArray, FloatArray] | None = None,
    config: LearnerConfig | None = None,
) -> Run:
    """Open loop: feedforward in blocks of 20 points by a snapshot of 60 to 80 ms of age."""
    stage = Stage(preset("rich", seed=3, changes=((at_s, changes),) if changes else ()))
    state = stage.initial_state()
    if motion is None:
        reference = demo_reference(seconds, DT)
        motion = (reference.y_um, reference.v_um_per_s, reference.a_um_per_s2)
    y_d, v_d, a_d = motion
    n = y_d.size
    learner = Learner.from_model(model, config)
    snapshots = [(-1, learner.snapshot())]
    memory, u, y = learner.memory(), np.empty(n), np.empty(n)
    for b in range(0, n, BLOCK):
        part = slice(b, b + BLOCK)
        old_enough = [m for seq, m in snapshots if seq < b - AGE]
        answer = (old_enough[-1] if old_enough else snapshots[0][1]).feedforward(
            y_d[part], v_d[part], a_d[part], memory
        )
        memory, u[part] = answer.memory, np.clip(answer.u_V, -2.0, 10.0)
        y[part], _ = stage.run(state, u[part])
        if learn:
            for k in range(b, min(b + BLOCK, n)):
                reading = y[k] + (0.0 if disturb is None else disturb[k])
                learner.handle(Sample(k, k * DT, float(u[k]), float(reading)))
            snapshots = [*snapshots[-8:], (b + BLOCK - 1, learner.snapshot())]
    return Run(u, y, y_d, learner)


@pytest.fixture(scope="module")
def quiet(model: LssvmInverse) -> Run:
    """Eight seconds without a change."""
    return run(model, 8.0)


def test_settles_far_below_the_frozen_model(model: LssvmInverse, quiet: Run) -> None:
    frozen = run(model, 8.0, learn=False)
    assert quiet.mae(4, 8) < 0.05
    assert quiet.mae(4, 8) < 0.6 * frozen.mae(4, 8)


def test_catches_a_gain_drop_and_a_payload(model: LssvmInverse) -> None:
    change = {"gain_drift.gain": -0.06, "resonance.payload_ratio": 1.0}
    learnt, frozen = (run(model, 8.0, change, 4.0, learn=flag) for flag in (True, False))
    assert learnt.mae(4, 5) < 0.35 * frozen.mae(4, 5)
    assert learnt.mae(5, 8) < 0.06
    assert learnt.learner.features.gain == pytest.approx(0.94, abs=0.004)
    for start in np.arange(1.0, 7.6, 0.5):
        assert learnt.mae(start, start + 0.5) <= 1.1 * frozen.mae(start, start + 0.5) + 3 * 0.006


def test_a_glitch_burst_of_the_sensor_teaches_nothing(model: LssvmInverse, quiet: Run) -> None:
    disturb = np.zeros(8000)
    rng = np.random.default_rng(0)
    for start in rng.integers(2000, 7000, 30):
        disturb[start : start + 2] += rng.choice([-1, 1]) * rng.uniform(2, 30)
    glitched = run(model, 8.0, disturb=disturb)
    assert glitched.learner.counters()["glitch"] >= 55
    assert glitched.mae(4, 8) < 1.2 * quiet.mae(4, 8) + 0.005


def test_rest_does_not_flush_what_is_known(model: LssvmInverse) -> None:
    """Half a minute at rest, then the same full strokes as before: once it moves, the error is as before."""
    t = np.arange(3000) * DT
    w = 2 * np.pi * 1.0
    stroke = (40 - 35 * np.cos(w * t), 35 * w * np.sin(w * t), 35 * w * w * np.cos(w * t))
    still = 30_000
    rest = (np.full(still, 5.0), np.zeros(still), np.zeros(still))
    motion = tuple(np.concatenate([s, r, s]) for s, r in zip(stroke, rest, strict=True))
    got = run(model, 0.0, motion=motion)  # type: ignore[arg-type]
    before, after = got.mae(1, 3), got.mae(34, 36)
    assert after < 1.3 * before + 0.01
    assert got.mae(33, 34) < 0.2
    assert got.learner.counters()["unexcited"] > 10_000


def test_a_replay_gives_the_same_snapshots_to_the_last_bit(model: LssvmInverse, quiet: Run) -> None:
    again = Learner.from_model(model)
    for k in range(quiet.u.size):
        again.handle(Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k])))
    for name, value in quiet.learner.snapshot().state_dict().items():
        np.testing.assert_array_equal(again.snapshot().state_dict()[name], value, err_msg=name)
    assert again.counters() == quiet.learner.counters()


def test_snapshots_are_cheap_immutable_and_numbered(model: LssvmInverse, quiet: Run) -> None:
    learner = Learner.from_state(quiet.learner.state_dict())
    first = learner.snapshot()
    assert learner.snapshot() is first
    assert first.seq == learner.seq == 7999
    beta = first.beta.copy()
    for k in range(8000, 8100):
        learner.handle(Sample(k, k * DT, float(quiet.u[-1]), float(quiet.y[-1])))
    np.testing.assert_array_equal(first.beta, beta)
    assert learner.snapshot().seq > 7999


def test_frozen_learns_nothing_and_thaws(model: LssvmInverse, quiet: Run) -> None:
    learner = Learner.from_model(model)
    learner.freeze()
    for k in range(2000):
        learner.handle(Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k])))
    assert learner.counters()["frozen"] > 0
    assert learner.counters()["learnt"] == 0
    np.testing.assert_array_equal(learner.snapshot().beta[1:], model.beta[1:])
    learner.thaw()
    for k in range(2000, 3000):
        learner.handle(Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k])))
    assert learner.counters()["learnt"] > 0


def test_state_goes_on_to_the_last_bit(model: LssvmInverse, quiet: Run) -> None:
    one = Learner.from_model(model, LearnerConfig(learn_every=5, window=200))
    for k in range(3000):
        one.handle(Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k])))
    two = Learner.from_state(one.state_dict())
    assert two.config == one.config
    for k in range(3000, 4000):
        sample = Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k]))
        assert one.handle(sample) == two.handle(sample)
    np.testing.assert_array_equal(one.snapshot().beta, two.snapshot().beta)
    np.testing.assert_array_equal(one.snapshot().alpha, two.snapshot().alpha)
    np.testing.assert_array_equal(one.memory(), two.memory())


def test_a_damaged_state_is_refused(quiet: Run) -> None:
    state = quiet.learner.state_dict()
    del state["window.PR"]
    with pytest.raises(ModelFileError, match=r"window\.PR: got P and R: False, False"):
        Learner.from_state(state)


def test_short_gaps_are_bridged_and_long_ones_start_again(model: LssvmInverse, quiet: Run) -> None:
    learner = Learner.from_model(model)
    for k in range(4000):
        if k in (1000, 1001) or 2000 <= k < 2100:
            continue
        learner.handle(Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k])))
        if k == 1999:
            # After two lost samples the next ones wait for a moment.
            bridged = learner.counters()
    counters = learner.counters()
    assert 1 <= bridged["gap"] <= bridged["gap"] + bridged["glitch"] <= 8
    # After a hundred the smoother begins anew, and nothing is learnt until the memory is known: a second at most.
    assert bridged["gap"] + 20 < counters["gap"] <= bridged["gap"] + 1100
    assert counters["restarts"] == 2
    assert learner.diagnostics()["rms_error_pct"] < 0.15


def test_uncertainty_holds_its_share(quiet: Run) -> None:
    """One stated standard deviation holds about two thirds of the prediction errors, and not nearly all."""
    assert 0.6 < quiet.learner.diagnostics()["share_within_std"] < 0.9


def test_bad_seconds_are_noticed_fallen_back_from_and_rolled_back(model: LssvmInverse, quiet: Run) -> None:
    learner = Learner.from_model(model)
    seen = set()
    for k in range(5000):
        # A voltage that the motion has not answered to: no model of this stage can predict it.
        u = float(quiet.u[k]) + (0.6 * np.sin(0.05 * (k - 2000)) if 2000 <= k < 3000 else 0.0)
        learner.handle(Sample(k, k * DT, u, float(quiet.y[k])))
        if k > 2000:
            seen.add(learner.snapshot().valid)
    assert seen == {True, False}
    assert learner.snapshot().valid
    assert learner.counters()["distrusts"] >= 1
    assert learner.diagnostics()["recent_rms_error_pct"] < 0.15


def test_a_rollback_takes_the_estimate_back_and_not_the_place(
    model: LssvmInverse, quiet: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """beta is that of a good time, to the last bit; the count of samples and the stage's turning points go on."""
    learner, bystander = Learner.from_model(model), Learner.from_model(model)
    bystander.freeze()
    betas: list[FloatArray] = []
    went_back: list[tuple[FloatArray, FloatArray]] = []
    go_back = DriftFilter.restore

    def seen(self: DriftFilter, mark: tuple[FloatArray, FloatArray]) -> None:
        before = self.beta
        go_back(self, mark)
        if self is learner.parts.filter:
            went_back.append((before, self.beta))

    monkeypatch.setattr(DriftFilter, "restore", seen)
    k = -1
    while not went_back and k < 7000:
        k += 1
        # For a second a voltage that the motion has not answered to; the twin that learns nothing sees it too.
        u = float(quiet.u[k]) + (0.6 * math.sin(0.05 * (k - 3500)) if 3500 <= k < 4500 else 0.0)
        sample = Sample(k, k * DT, u, float(quiet.y[k]))
        learner.handle(sample)
        bystander.handle(sample)
        betas.append(learner.parts.filter.beta)
    ((before, after),) = went_back
    assert learner.counters()["distrusts"] == 1
    # What it went back to it once was, while all was well and after it had learnt something.
    once = [i for i, beta in enumerate(betas[:-1]) if np.array_equal(beta, after)]
    assert once
    assert 1000 < once[-1] < 3500
    assert not np.array_equal(after, model.beta)
    assert np.abs(before - after).max() > 1e-4 * model.span_V
    # The place is that of one that learns nothing, but for what their models reckon differently.
    mine, its = learner.parts.intake.track, bystander.parts.intake.track
    assert mine is not None
    assert its is not None
    assert learner.seq == bystander.seq == k
    assert np.abs(mine.frozen_memory - its.frozen_memory).max() < 4.0
    assert learner.handle(Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k]))) == "duplicate"
    learner.handle(Sample(k + 1, (k + 1) * DT, float(quiet.u[k + 1]), float(quiet.y[k + 1])))
    assert learner.seq == k + 1


def test_fifo_is_selectable(model: LssvmInverse, quiet: Run) -> None:
    nearest, fifo = (Learner.from_model(model, LearnerConfig(eviction=e, window=300)) for e in ("nearest", "fifo"))
    for k in range(4000):
        sample = Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k]))
        nearest.handle(sample)
        fifo.handle(sample)
    old = model.support[:, 0]
    kept = [np.isin(learner.window_samples()[0][:, 0], old).sum() for learner in (nearest, fifo)]
    assert kept[0] > kept[1]


def test_bad_configuration_is_named() -> None:
    with pytest.raises(InputError, match="window"):
        LearnerConfig(window=3)
    with pytest.raises(InputError, match="eviction"):
        LearnerConfig(eviction="random")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="valid_enter"):
        LearnerConfig(valid_enter=0.5)


@pytest.mark.parametrize("dt_s", [0.5, 2.0, 5.0])
def test_a_stage_that_is_read_every_few_seconds_is_learnt_too(dt_s: float) -> None:
    """A second, or half of one, of which something is done every so often may be less than a step."""
    features = FeatureMap(dt_s, 0.0, 1.0, 1.0, 1.0, (0.1, 0.2), (0.3,), (0.1,), (0,), asymmetric=True)
    p, d = features.basis_size, features.kernel_size
    model = LssvmInverse(
        "slow", features, np.zeros(p), np.linspace(0.0, 1.0, 12 * d).reshape(12, d), np.zeros(12), np.ones(d), 10.0,
        np.array([0.0, 1.0] * 3),
    )  # fmt: skip
    learner = Learner(model, LearnerConfig(window=10))
    said = [
        learner.handle(Sample(k, k * dt_s, 0.1 + 0.1 * math.sin(0.3 * k), 0.2 + 0.1 * math.sin(0.3 * k)))
        for k in range(400)
    ]
    assert said.count("learnt") > 100
    assert np.isfinite(learner.snapshot().feedforward(*np.full((3, 1), 0.2), learner.memory()).u_V).all()


# --- A jump that begins with a reading too small for a glitch must not be taken for motion.

STEP_S = 1e-3
SHARE = AdmissionConfig().glitch_share


@pytest.mark.parametrize("first", [0.2, 0.5, 0.9, 1.5])
def test_the_frame_moves_by_the_jump_and_no_further(
    model: LssvmInverse, recording: tuple[np.ndarray, np.ndarray], first: float
) -> None:
    """The first reading of the jump is off by ``first`` glitch shares, all later ones by 1.5."""
    u, clean = recording
    span = model.features.y_max_um - model.features.y_min_um
    at = 3000
    y = clean.copy()
    y[at] -= first * SHARE * span
    y[at + 1 :] -= 1.5 * SHARE * span
    learner = Learner.from_model(model)
    for k in range(at + 24):
        learner.handle(Sample(k, k * STEP_S, float(u[k]), float(y[k])))
    assert learner.counters()["jumps"] == 1
    frame = learner.features
    for k in (at + 18, at + 23):
        in_frame = frame.offset_um + frame.gain * (clean[k] - frame.offset_um)
        assert in_frame == pytest.approx(y[k], abs=0.15)


def test_what_is_known_of_a_jump_is_part_of_the_state(
    model: LssvmInverse, recording: tuple[np.ndarray, np.ndarray]
) -> None:
    """Saved between the first surprising reading and the one that makes it a jump: the same to the last bit."""
    u, y = (column.copy() for column in recording)
    span = model.features.y_max_um - model.features.y_min_um
    at = 3000
    y[at] -= 0.9 * SHARE * span
    y[at + 1 :] -= 1.8 * SHARE * span
    learner = Learner.from_model(model)
    for k in range(at + 3):
        learner.handle(Sample(k, k * STEP_S, float(u[k]), float(y[k])))
    twin = Learner.from_state(learner.state_dict())
    for k in range(at + 3, at + 200):
        sample = Sample(k, k * STEP_S, float(u[k]), float(y[k]))
        assert learner.handle(sample) == twin.handle(sample)
    assert learner.counters()["jumps"] == 1
    assert np.array_equal(learner.snapshot().beta, twin.snapshot().beta)


def test_a_kernel_part_of_other_motion_is_given_up_and_a_good_one_kept(model: LssvmInverse) -> None:
    """The same stage and linear part; the kernel part is narrow and drawn at random."""
    drawn = 0.01 * model.span_V * np.random.default_rng(8).standard_normal(model.alpha.size)
    own, other = (run(m, 6.0) for m in (model, replace(model, widths=np.full(model.widths.size, 0.1), alpha=drawn)))
    assert other.learner.parts.window.share < 0.2 < 0.9 < own.learner.parts.window.share
    assert other.mae(2.0, 3.0) > 10.0 * own.mae(2.0, 3.0)
    assert other.mae(5.0, 6.0) < 2.0 * own.mae(5.0, 6.0)


def test_a_missing_reading_leaves_the_others_as_an_anchor(model: LssvmInverse, quiet: Run) -> None:
    """Only a hold with a wrong reading puts those before the next one in doubt; else dead reckoning would begin again
    at a place that grows older with every missing reading."""
    learner, lag = Learner.from_model(model), 0
    for k in range(1200):
        missing = k > 1000 and k % 2 == 0
        y_um = math.nan if missing else float(quiet.y[k]) + 6.0 * (k == 900)
        learner.handle(Sample(k, k * DT, float(quiet.u[k]), y_um))
        lag = learner.parts.intake.track.lag
        if k == 905:
            assert learner.parts.intake.calm < 10
    assert learner.counters()["not_finite"] == 99
    assert learner.parts.intake.calm > 2 * lag


def test_a_copy_is_independent_and_goes_on_to_the_last_bit(model: LssvmInverse, quiet: Run) -> None:
    learner = Learner.from_model(model)
    rows = [Sample(k, k * DT, float(quiet.u[k]), float(quiet.y[k])) for k in range(900)]
    for sample in rows[:700]:
        learner.handle(sample)
    twins = copy.deepcopy(learner), pickle.loads(pickle.dumps(learner))
    for one in (learner, *twins):
        said = [one.handle(sample) for sample in rows[700:]]
        assert said.count("learnt") > 50
    for twin in twins:
        np.testing.assert_array_equal(twin.snapshot().packed[0], learner.snapshot().packed[0])
        assert twin.counters() == learner.counters()
