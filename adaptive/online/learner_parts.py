"""The parts that a learner is made of, and their state as flat entries of a file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.errors import ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.creep import Rest
from adaptive.online.dead_reckoning import Reckoning, drive_V
from adaptive.online.drift import DriftFilter
from adaptive.online.gates import new_counters
from adaptive.online.glitch_or_jump import level_of
from adaptive.online.intake import Front
from adaptive.online.kernel_window import ResidualWindow
from adaptive.online.validity import Delay, Judgement
from adaptive.state_codec import joined, under
from adaptive.types import FloatArray, StateDict

#: Names of what is counted beside the samples.
EVENTS = ("fallbacks", "rollbacks", "distrusts", "begun_again", "adoptions", "adoptions_refused")

#: The filter goes back to its last good estimate after losing to the frozen model for this long, s; while all is
#: well, its estimate is marked this often, s.
ROLLBACK_S, MARK_S = 0.5, 1.0

#: Share of a jump by which it may be wrong to take it for a gain and not an offset, or the other way round.
JUMP_DOUBT = 0.3
#: Time between two looks at the envelope, the rails and the sensor, s; a step of the filter at least.
CHECK_S = 0.004
#: A voltage at a limit for this long, s, where the model is wrong by this share of the span, is the model's doing.
RAIL_S, RAIL_SHARE = 0.1, 0.05
#: Time inside the envelope after which a model that had left it is no trouble any more, s.
LEFT_S = 1.0
#: Time on trial from which on the identified model may be served, s, and how large its own recent error may be for
#: that, rms, as a share of the span for each second on trial, and at most. The last estimate is exact where the stage
#: was when readings were last believed; the longer that is ago, the less it is worth.
ALONE_S, ALONE_SHARE_PER_S, ALONE_SHARE = 0.3, 0.05, 0.05

Mark = tuple[FloatArray, FloatArray]


class Parts:
    """Everything of a learner that changes.

    Attributes
    ----------
    front : gates, smoother, frame and hysteresis memory. filter : of the linear part. window : the kernel part.
    rest : what a rest has taught. judgement, delay : errors at the age of serving.
    domain : (6,) learnt range, as of the snapshot.
    point : (d,) kernel inputs of the last instant that was due to teach, NaN before any.
    first : the filter's estimate of the identified model.
    check_every, check_s : samples between two looks at envelope, rails and sensor, and the time between them, s.
    allowed_V : by how much the model may leave the identified linear part, V; 0 for no bound.
    left_s, left : see ``watch_shape``; time outside, or inside where negative, s.
    alone : whether readings have been on trial for so long that the identified model, if it is good, is the better.
    rail_s, railed : see ``watch_rail``; time at a limit, or off it where negative, s.
    confirmed : estimates from before readings that certainly followed the drive, the older one first. mark_ages,
    confirmed_ages : at which judgement the marks were made.
    mark, next_mark : good estimates of the filter; ``mark`` is the one before the last, as the last may already hold
    some of what went wrong. jump_mark, proven_mark : those before the last jump, and before the first that is open.
    counters : samples by outcome. events : by name.
    """

    def __init__(self, base: LssvmInverse, config: LearnerConfig) -> None:
        self.config = config
        self.front = Front(base, config)
        p = base.features.basis_size
        covariance = base.beta_covariance if base.beta_covariance.size else (0.01 * base.span_V) ** 2 * np.eye(p)
        step_s = config.filter_every * base.dt_s
        self.filter = DriftFilter(config.drift, base.beta, covariance, step_s, base.span_V)
        self.first = self.filter.mark()
        self.window = ResidualWindow.from_model(base, config.window, config.eviction, config.solver)
        self.mark: Mark = self.filter.mark()
        self.next_mark: Mark = self.mark
        self.jump_mark: Mark = self.mark
        self.proven_mark: Mark = self.mark
        self.confirmed: tuple[Mark, Mark] = (self.mark, self.mark)
        self.mark_ages = self.confirmed_ages = (0, 0)
        self.domain = base.domain.copy()
        self.point = np.full(base.features.kernel_size, np.nan)
        start_V2 = max(base.noise_variance, (1e-4 * base.span_V) ** 2)
        self.judgement = Judgement(start_V2, start_V2, start_V2, start_V2)
        self.rest = Rest()
        self.delay = Delay(round(config.serving_age_s / step_s))
        steps = max(1, round(CHECK_S / self.filter.step_s))
        self.check_every, self.check_s = steps * config.filter_every, steps * self.filter.step_s
        # A model without a linear part has nothing that the kernel could be held to; what the kernel of the identified
        # one adds to its linear part is allowed beside the bound.
        self.allowed_V = config.envelope.shape * drive_V(base) + self.window.reach_V if base.features.linear else 0.0
        self.rail_s = 0.0
        self.railed = False
        self.left_s = 0.0
        self.left = False
        self.alone = False
        self.counters = new_counters()
        self.events = dict.fromkeys(EVENTS, 0)

    def expect_change(self) -> None:
        """The stage has changed: the filter follows faster, and what the window has from before will count less."""
        self.filter.expect_change()
        self.window.expect_change()

    def follow(self, basis: FloatArray, target_V: float, u_V: float, weight: float, rest: bool) -> bool:
        """A step of the filter towards ``target_V`` at basis (p,); False for an outlier, which teaches nothing.

        ``u_V`` : the voltage there. ``rest`` : whether the stage is at rest.
        """
        said = self.filter.update(basis, target_V, not rest, weight)
        if said == "outlier":
            return False
        if said == "burst":
            self.window.expect_change()
        if self.judgement.valid and not self.front.on_probation:
            self.window.let_go(self.config.weights.before_change)
        self.take_rest(u_V, moving=not rest)
        return True

    def take_rest(self, u_V: float, moving: bool) -> None:
        """After a step of the filter: at rest, let what the constant has gained go over to the frame."""
        front, f = self.front, self.filter
        if moving:
            self.rest.leave()
            return
        constant_V, creep_s = float(f.beta[0]), self.config.creep_s
        shift_um = self.rest.shift_um(constant_V, u_V, f.span_V, front.range_um, f.step_s, creep_s)
        if shift_um:
            front.creep(shift_um)

    def judge(self, error_V: float, frozen_error_V: float) -> None:
        """Take the errors at one instant: of the linear part as it was served for it, and of the frozen model."""
        c, j, step_s = self.config, self.judgement, self.filter.step_s
        span_V = self.filter.span_V
        j.take(error_V, frozen_error_V, step_s)
        j.decide(c.valid_enter * span_V, c.valid_leave * span_V)
        before = j.fallback
        self.events["fallbacks"] += j.choose(c.fallback_floor * span_V, step_s) and not before
        if j.fallen_s > ROLLBACK_S:
            # Half a second of losing to the frozen model: what was learnt since all was well is wrong, and so is a
            # jump that the frozen model knows nothing of.
            j.fallen_s = 0.0
            self.front.to_base_frame()
            self.filter.go_back(self.mark)
            self.events["rollbacks"] += 1
        elif j.judged % max(1, round(MARK_S / step_s)) == 0 and j.short_V2 < (0.5 * c.valid_enter * span_V) ** 2:
            self.mark, self.next_mark = self.next_mark, self.filter.mark()
            self.mark_ages = (self.mark_ages[1], j.judged)
            if self.confirmed_ages[0] < self.mark_ages[0]:
                # Where the stage moves little, nothing is confirmed for long: what was good for a second is as good.
                self.confirmed = (self.mark, self.confirmed[1])
                self.confirmed_ages = (self.mark_ages[0], self.confirmed_ages[1])

    def watch_rail(self, saturated: bool) -> None:
        """After ``judge``: a voltage that stays at a limit by the model's fault ends in the identified model.

        ``railed`` is True from then until the voltage has been off the limits for as long.
        """
        limit_V = RAIL_SHARE * self.filter.span_V
        step_s = self.check_s
        if saturated:
            self.rail_s = min(max(self.rail_s, 0.0) + step_s, RAIL_S)
            if self.rail_s >= RAIL_S and self.judgement.short_V2 > limit_V * limit_V and not self.railed:
                self.railed = True
                self.begin_again()
        else:
            self.rail_s = max(min(self.rail_s, 0.0) - step_s, -RAIL_S)
            self.railed = self.railed and self.rail_s > -RAIL_S

    def watch_shape(self, away_V: float) -> None:
        """How far the model is from the identified linear part, V. One that stays outside ends in the identified one.

        ``left`` is True from then until it has been inside for a second.
        """
        step_s = self.check_s
        if self.allowed_V and abs(away_V) > self.allowed_V:
            self.left_s = max(self.left_s, 0.0) + step_s
            if self.left_s >= RAIL_S:
                self.left, self.left_s = True, 0.0
                self.begin_again()
        else:
            self.left_s = max(min(self.left_s, 0.0) - step_s, -LEFT_S)
            self.left = self.left and self.left_s > -LEFT_S

    def watch_trial(self) -> bool:
        """At each sample: returns whether ``alone`` has changed."""
        on_trial_s, before = self.front.distrusted_s, self.alone
        if on_trial_s or before:
            limit_V = min(ALONE_SHARE_PER_S * on_trial_s, ALONE_SHARE) * self.filter.span_V
            self.alone = on_trial_s >= ALONE_S and self.judgement.frozen_V2 <= limit_V * limit_V
        if self.alone and not before:
            self.front.reckon_by(self.front.base)
        return self.alone != before

    def confirm(self) -> None:
        """The readings follow the drive: what was learnt from those before them is right."""
        newer = int(self.confirmed_ages[1] >= self.confirmed_ages[0])
        self.confirmed = (self.confirmed[newer], self.filter.mark())
        self.confirmed_ages = (self.confirmed_ages[newer], self.judgement.judged)

    def go_back(self, undone: bool) -> None:
        """The readings do not follow the drive: forget what was learnt since they certainly did.

        ``undone``: jumps are taken back with them; all since the first of them is forgotten.
        """
        self.filter.restore(self.proven_mark if undone else self.confirmed[0])
        self.window.keep()
        self.events["distrusts"] += 1

    def begin_again(self) -> None:
        """Forget all that was learnt: the identified model is the one that is known to be right."""
        base, c = self.front.base, self.config
        self.front.to_base_frame()
        self.filter.go_back(self.first)
        self.window = ResidualWindow.from_model(base, c.window, c.eviction, c.solver)
        self.mark = self.next_mark = self.jump_mark = self.proven_mark = self.filter.mark()
        self.confirmed = (self.mark, self.mark)
        self.mark_ages = self.confirmed_ages = (self.judgement.judged,) * 2
        self.domain = base.domain.copy()
        self.events["begun_again"] += 1

    def take_jump(self, jump_um: float, fresh: bool, first: bool) -> None:
        """The reading has jumped by so much, µm; ``fresh``: and did not only undo a jump; ``first``: see ``Taken``."""
        front = self.front
        self.judgement.doubt_V2 += (JUMP_DOUBT * jump_um / front.range_um * front.base.span_V) ** 2
        if fresh:
            self.jump_mark = self.filter.mark()
        if first:
            self.proven_mark = self.jump_mark
        self.confirmed, self.confirmed_ages = (self.filter.mark(),) * 2, (self.judgement.judged,) * 2

    def undo_jump(self) -> None:
        """Forget what was learnt since the last jump: it was learnt of a stage that never was."""
        self.filter.restore(self.jump_mark)
        self.window.keep()

    def widen_domain(self, motion: tuple[float, float, float]) -> None:
        """Take a learnt instant (µm, µm/s, µm/s²) into the domain."""
        ends = self.domain.tolist()
        for i, x in enumerate(motion):
            if x < ends[2 * i]:
                self.domain[2 * i] = x
            if x > ends[2 * i + 1]:
                self.domain[2 * i + 1] = x

    def shift_constant(self, by_V: float) -> None:
        """Add to the constant of the linear part, now, in its marks, and as it was served."""
        self.filter.shift_constant(by_V)
        marks = (self.mark, self.next_mark, self.jump_mark, self.proven_mark, *self.confirmed)
        for beta, _ in {id(m): m for m in marks}.values():
            beta[0] += by_V
        self.delay.shift(by_V)


def model_of(base: LssvmInverse, parts: Parts) -> LssvmInverse:
    """What is learnt, as an immutable model; the identified one while learning is worse than it."""
    j, window, seq = parts.judgement, parts.window, parts.front.gates.seq
    valid = j.valid and not parts.front.fault
    if j.fallback or parts.alone:
        return replace(base, noise_variance=j.frozen_short_V2, seq=seq, valid=valid)
    support, alpha, bias = window.arrays()
    beta = parts.filter.beta
    beta[0] += bias
    return replace(
        base,
        features=parts.front.served,
        beta=beta,
        support=support,
        alpha=alpha,
        widths=np.array(window.hyper.widths),
        gamma=window.hyper.gamma,
        domain=parts.domain,
        noise_variance=j.variance_V2,
        kernel_variance=window.kernel_variance,
        beta_covariance=np.empty((0, 0)),
        seq=seq,
        valid=valid,
        anchor=base.beta if parts.allowed_V else np.empty(0),
        allowed_V=parts.allowed_V,
    )


def warm(base: LssvmInverse, config: LearnerConfig) -> None:
    """Load, or compile, every step of a learner, on parts that nobody keeps."""
    parts = Parts(base, config)
    basis, kernel = np.empty(base.features.basis_size), np.empty(base.features.kernel_size)
    base.features.fill(0.0, 0.0, 0.0, base.rest_memory(0.0), basis, kernel)
    base.mean(basis, kernel)
    window = parts.window
    if len(window) < config.window:
        window.learn(10.0 + np.zeros_like(kernel), 0.0)
    window.learn(window.arrays()[0][0], 0.0)
    y = base.features.y_rest_um
    readings = np.array([y, y])
    reckoning = Reckoning.begin(base, (y, 0.0, 0.0), 0.0, np.zeros(2), readings, base.rest_memory(y))
    reckoning.advance(0.0)
    for drifts in (False, True):
        level_of(np.arange(8.0) % 3.0, 1.0, drifts)
    window.with_hyperparameters(window.hyper).newest_error_V(1)
    for moving in (True, False):
        parts.filter.update(basis, 0.0, moving)
    parts.expect_change()
    window.let_go(0.5)


def state_of(base: LssvmInverse, config: LearnerConfig, parts: Parts, frozen: bool) -> StateDict:
    """All of a learner's state; ``restored`` goes on from it with the same result to the last bit."""
    groups = {
        "base": base.state_dict(),
        "config": config.state_dict(),
        "front": parts.front.state_dict(),
        "filter": parts.filter.state_dict(),
        "window": parts.window.state_dict(),
        "rest": parts.rest.state_dict(),
        "judgement": parts.judgement.state_dict(),
        "counters": dict(parts.counters),
        "events": dict(parts.events),
        "mark": {"beta": parts.mark[0].copy(), "covariance": parts.mark[1].copy()},
        "next_mark": {"beta": parts.next_mark[0].copy(), "covariance": parts.next_mark[1].copy()},
        "jump_mark": {"beta": parts.jump_mark[0].copy(), "covariance": parts.jump_mark[1].copy()},
        "proven_mark": {"beta": parts.proven_mark[0].copy(), "covariance": parts.proven_mark[1].copy()},
        "confirmed0": {"beta": parts.confirmed[0][0].copy(), "covariance": parts.confirmed[0][1].copy()},
        "confirmed1": {"beta": parts.confirmed[1][0].copy(), "covariance": parts.confirmed[1][1].copy()},
    }
    state = joined(groups)
    return state | {
        "domain": parts.domain.copy(),
        "point": parts.point.copy(),
        "delay": parts.delay.array(),
        "frozen": frozen,
        "rail_s": parts.rail_s,
        "railed": parts.railed,
        "left_s": parts.left_s,
        "left": parts.left,
        "alone": parts.alone,
        "mark_ages": np.array(parts.mark_ages),
        "confirmed_ages": np.array(parts.confirmed_ages),
    }


def restored(state: StateDict) -> tuple[LssvmInverse, LearnerConfig, Parts, bool]:
    """Inverse of ``state_of``. Raises ModelFileError where entries are missing or do not fit together."""
    try:
        base = LssvmInverse.from_state(under("base.", state))
        config = LearnerConfig.from_state(under("config.", state))
        parts = Parts(base, config)
        parts.front.restore(under("front.", state))
        parts.filter = DriftFilter.from_state(config.drift, parts.filter.step_s, base.span_V, under("filter.", state))
        parts.window.restore(under("window.", state))
        parts.rest = Rest.from_state(under("rest.", state))
        parts.judgement = Judgement.from_state(under("judgement.", state))
        parts.counters |= {key: int(value) for key, value in under("counters.", state).items()}
        parts.events |= {key: int(value) for key, value in under("events.", state).items()}
        parts.domain = np.array(state["domain"], dtype=np.float64)
        parts.point = np.array(state["point"], dtype=np.float64)
        parts.rail_s, parts.railed = float(state.get("rail_s", 0.0)), bool(state.get("railed", False))
        parts.left_s, parts.left = float(state.get("left_s", 0.0)), bool(state.get("left", False))
        parts.alone = bool(state.get("alone", False))
        parts.mark_ages, parts.confirmed_ages = (_ages(state.get(f"{name}_ages")) for name in ("mark", "confirmed"))
        parts.delay.restore(np.asarray(state["delay"], dtype=np.float64))
        names = ("mark", "next_mark", "jump_mark")
        parts.mark, parts.next_mark, parts.jump_mark = (_mark(under(f"{name}.", state)) for name in names)
        proven = under("proven_mark.", state)
        parts.proven_mark = _mark(proven) if proven else parts.jump_mark
        kept = [under(f"confirmed{i}.", state) for i in range(2)]
        parts.confirmed = (_mark(kept[0]), _mark(kept[1])) if all(kept) else (parts.mark, parts.next_mark)
        return base, config, parts, bool(state["frozen"])
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(
            f"learner state: entry missing or damaged: {error}; start from the model instead"
        ) from error


def _ages(values: object) -> tuple[int, int]:
    """Two counts; a state from before there were any knows none."""
    first, second = (0, 0) if values is None else np.asarray(values).tolist()
    return int(first), int(second)


def _mark(values: StateDict) -> Mark:
    """A mark of the drift filter from its entries."""
    return np.array(values["beta"], dtype=np.float64), np.array(values["covariance"], dtype=np.float64)
