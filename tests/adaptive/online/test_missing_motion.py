"""After a gap: the error, the stated deviation, and what is learnt while the hysteresis memory is not known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from dehyst.adaptive.inverse_model import LssvmInverse, track_memory
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.track import TURNS, MissingMotion
from dehyst.adaptive.types import FloatArray, Sample, StateDict
from dehyst.baselines.prandtl_ishlinskii.model import MpiParameters
from dehyst.service.identification.identifying import motion_of
from dehyst.sim.recordings import Recording
from dehyst.sim.signals.voltages import multitone

DT = 1e-3
#: A stage that is none of those that the models here are identified from: its hysteresis is one of plays alone.
PLAYS = MpiParameters(
    tuple(float(r) for r in np.arange(7) * 0.6), (7.0, 1.5, 1.0, 0.5, 0.5, 0.2, 0.1), (0.0, 30.0), (1.0, -0.1)
)
#: Samples from one answer to the next, which answers for as many.
EVERY = 5


@dataclass
class Course:
    """Voltages, readings, and the zero-phase motion (n, 3) of a stage; ``state``: of a learner after ``learnt``."""

    u: FloatArray
    y: FloatArray
    motion: FloatArray
    state: StateDict
    learnt: int

    def sample(self, k: int) -> Sample:
        return Sample(k, k * DT, float(self.u[k]), float(self.y[k]))


@pytest.fixture(scope="module")
def course(model: LssvmInverse) -> Course:
    """Nine seconds in motion, the first 4.7 of them learnt."""
    u = multitone(9.0, DT, seed=4)[1]
    u[:500] *= np.linspace(0.0, 1.0, 500)
    y = PLAYS.simulate(u, DT) + 0.002 * np.random.default_rng(1).normal(size=u.size)
    learner, learnt = Learner.from_model(model), 4700
    made = Course(u, y, motion_of(Recording(np.arange(u.size) * DT, u, y, DT)), {}, learnt)
    for k in range(learnt):
        learner.handle(made.sample(k))
    made.state = learner.state_dict()
    return made


def answers(course: Course, learner: Learner, first: int, count: int) -> tuple[FloatArray, FloatArray]:
    """(errors, deviations) in % of the span: every five points are asked for at the sample before them."""
    error, std = np.full((2, count), np.nan)
    for k in range(first, first + count):
        learner.handle(course.sample(k))
        if (k - first) % EVERY == 0:
            served, memory = learner.snapshot(), learner.memory_for(learner.snapshot())
            assert memory is not None
            due = slice(k + 1, k + 1 + EVERY)
            y, v, a = (np.ascontiguousarray(course.motion[due, i]) for i in range(3))
            forward = served.feedforward(y, v, a, memory)
            kept = slice(due.start - first, min(due.stop - first, count))
            error[kept] = (forward.u_V - course.u[due])[: kept.stop - kept.start]
            std[kept] = forward.std_V[: kept.stop - kept.start]
    percent = 100.0 / float(np.ptp(course.u))
    return np.abs(error) * percent, std * percent


@pytest.mark.parametrize("missing", [60, 300, 500, 720, 1000])
def test_after_a_gap_the_error_is_small_and_within_what_is_stated(course: Course, missing: int) -> None:
    """The first answers used to be wrong by 2 to 5 % of the span, and the deviation did not say so."""
    whole, gapped = Learner.from_state(course.state), Learner.from_state(course.state)
    first = course.learnt + missing
    usual = answers(course, whole, course.learnt, missing + 1800)[0][missing:]
    error, std = answers(course, gapped, first, 1800)
    asked = np.isfinite(error)
    assert (error <= std)[asked & (np.arange(error.size) < 200)].mean() > 0.97
    assert error[1] <= std[1]
    assert np.nanmean(error[:200]) < 0.8
    assert np.nanmax(error) < 1.6
    assert np.nanmean(error[1000:]) < 1.5 * np.nanmean(usual[1000:])


def test_the_deviation_is_wide_at_first_and_narrow_when_the_memory_is_known(course: Course) -> None:
    learner = Learner.from_state(course.state)
    before_V2 = learner.snapshot().noise_variance
    outcomes = [learner.handle(course.sample(course.learnt + 700))]
    at_first_V2 = learner.snapshot().noise_variance
    moving = learner.moving()
    assert moving is not None
    assert moving.noise_variance == at_first_V2  # what followers get
    for k in range(course.learnt + 701, course.learnt + 2400):
        outcomes.append(learner.handle(course.sample(k)))
    assert at_first_V2 > 9.0 * before_V2
    assert learner.snapshot().noise_variance < 2.0 * before_V2
    # Nothing is learnt of a motion whose memory is not known; then all is again.
    assert "learnt" not in outcomes[:50]
    assert 20 < outcomes.count("gap") < 1100
    assert outcomes[-100:].count("learnt") >= 40


def test_an_open_gap_is_part_of_the_state(course: Course) -> None:
    one = Learner.from_state(course.state)
    for k in range(course.learnt + 700, course.learnt + 730):
        one.handle(course.sample(k))
    assert one.parts.intake.missing is not None
    other = Learner.from_state(one.state_dict())
    for k in range(course.learnt + 730, course.learnt + 900):
        assert one.handle(course.sample(k)) == other.handle(course.sample(k))
    a, b = one.state_dict(), other.state_dict()
    assert a.keys() == b.keys()
    assert [key for key in a if repr(np.asarray(a[key]).tolist()) != repr(np.asarray(b[key]).tolist())] == []


def test_a_second_gap_soon_after_widens_what_is_stated_again(course: Course) -> None:
    learner = Learner.from_state(course.state)
    for k in range(course.learnt + 400, course.learnt + 600):
        learner.handle(course.sample(k))
    narrow_V2 = learner.snapshot().noise_variance
    error, std = answers(course, learner, course.learnt + 1100, 300)
    asked = np.isfinite(error)
    assert std[1] > 1.2 * 100.0 * narrow_V2**0.5 / np.ptp(course.u)
    assert (error <= std)[asked].mean() > 0.97


def test_at_rest_the_zero_is_followed_while_the_memory_stays_open(course: Course) -> None:
    """The stage stands still before, in and after the gap, and creeps by half a percent of the span a second."""
    learner, last = Learner.from_state(course.state), course.learnt - 1
    u_V, y_um = float(course.u[last]), float(course.y[last])
    for i in range(1, 3000):
        if not 400 <= i < 900:
            creep_um = 0.1 * i * DT
            learner.handle(Sample(last + i, (last + i) * DT, u_V, y_um + creep_um))
    assert learner.parts.intake.missing is not None
    served = learner.snapshot()
    memory = learner.memory_for(served)
    assert memory is not None
    answer = served.feedforward(np.array([y_um + 0.3]), np.zeros(1), np.zeros(1), memory)
    assert abs(answer.u_V[0] - u_V) < 0.002 * np.ptp(course.u)


def test_members_are_memories_of_the_place_and_hold_the_true_one(model: LssvmInverse) -> None:
    """Random motions within the gap: the voltage of the true memory is within the spread nearly always."""
    rng, f = np.random.default_rng(3), model.features
    low, high = model.domain[:2]
    inside = 0
    for _ in range(40):
        from_um, to_um, *turns = rng.uniform(low, high, 5)
        memory = f.rest_memory(from_um)
        u_V = 0.0
        true = memory.copy()
        corners = np.array([from_um, *turns, to_um])
        track_memory(np.interp(np.linspace(0.0, 4.0, 800), np.arange(5), corners), true, f.arrays)
        u_V, _, _ = model.evaluate_point(to_um, 0.0, 0.0, true.copy())
        gap = MissingMotion.begin(model, memory, from_um, to_um, u_V, 0.8, 1e-3 * model.span_V)
        assert gap.members.shape == (2 * len(TURNS) ** 2, f.memory_size)
        mean_V, _, _ = model.evaluate_point(to_um, 0.0, 0.0, gap.memory)
        assert abs(mean_V - u_V) < 0.02 * model.span_V
        away = to_um + (0.1 if to_um < 0.5 * (low + high) else -0.1) * (high - low)
        expected_V, _, _ = model.evaluate_point(away, 0.0, 0.0, gap.memory)
        true_V, _, _ = model.evaluate_point(away, 0.0, 0.0, true)
        inside += abs(expected_V - true_V) <= gap.std_V
    assert inside >= 36


def test_where_nothing_can_have_moved_nothing_is_added(model: LssvmInverse) -> None:
    """A gap as short as the straight way needs at full speed leaves no room for a turn."""
    f = model.features
    from_um, to_um = 20.0, 50.0
    seconds = (to_um - from_um) / float(np.max(np.abs(model.domain[2:4])))
    u_V, _, _ = model.evaluate_point(to_um, 0.0, 0.0, f.rest_memory(from_um))
    gap = MissingMotion.begin(model, f.rest_memory(from_um), from_um, to_um, u_V, seconds, 1e-3 * model.span_V)
    assert gap.closed
    assert gap.std_V < 1e-3 * model.span_V
