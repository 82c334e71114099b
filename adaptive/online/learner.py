"""The learner: samples in, snapshots out. Deterministic, bounded in time and memory, never raises on data.

A sample passes the intake (``adaptive.online.intake``): gates, fixed-lag smoother, and hysteresis memory and features
at the smoothed instant. Then two learners share one model. The Kalman filter (``drift``) follows the linear part, the
sliding-window LSSVM (``kernel_window``) learns the rest. Each takes the voltage minus the other's part as its target,
so that a change is learnt once and the old samples of the window stay valid.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from math import inf, isfinite, sqrt
from typing import Annotated, Any

import numpy as np

from dehyst.adaptive.compiled import shared
from dehyst.adaptive.errors import DehystError, ModelFileError
from dehyst.adaptive.features import ACCELERATION, VELOCITY, FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates as admission
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.drift import DriftFilter, Mark, RestCreep
from dehyst.adaptive.online.gates import LEARNT, PASSED, REASONS, check_pair, new_counters
from dehyst.adaptive.online.glitch_or_jump import level_of
from dehyst.adaptive.online.intake import Intake
from dehyst.adaptive.online.kernel_window import ResidualWindow, due
from dehyst.adaptive.online.track import MissingMotion, Pair, Reckoning, drive_V
from dehyst.adaptive.state import Entry, Refused, restore, save, within
from dehyst.adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    MovingPart,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
    joined,
    prefixed,
    under,
)

# --- Errors of the served model: whether it is valid, and whether the identified one predicts better.
#
# The error is the measured voltage minus the voltage that the model gives for the measured motion, before the sample is
# learnt, with the model as old as an answer is when it takes effect. The identified (frozen) model is judged likewise.


#: Time constants of the mean square errors, s: long for reports and stated uncertainty, short to detect trouble.
LONG_S, SHORT_S = 2.0, 0.1

#: The frozen model is served where the learner's short-term rms exceeds its own by this factor plus a floor.
FALLBACK_RATIO = 1.3


@dataclass(slots=True)
class Judgement:
    """Mean square prediction errors, V², over long and short time, of the learner and of the frozen model."""

    long_V2: Annotated[float, Entry("mean square error of the learner over long time", "V²", low=0.0)]
    short_V2: Annotated[float, Entry("the same over short time", "V²", low=0.0)]
    frozen_V2: Annotated[float, Entry("mean square error of the identified model over long time", "V²", low=0.0)]
    frozen_short_V2: Annotated[float, Entry("the same over short time", "V²", low=0.0)]
    error_V: Annotated[float, Entry("the learner's last error", "V")] = 0.0
    judged: Annotated[int, Entry("errors", low=0)] = 0
    inside: Annotated[int, Entry("errors within one stated standard deviation", low=0)] = 0
    valid: Annotated[bool, Entry("whether the learnt model is valid")] = True
    fallback: Annotated[bool, Entry("whether the identified model is served because it predicts better")] = False
    fallen_s: Annotated[float, Entry("for how long", "s", low=0.0)] = 0.0
    doubt_V2: Annotated[float, Entry("extra variance after a jump of open cause; it decays", "V²", low=0.0)] = 0.0

    @shared
    def take(self, error_V: float, frozen_error_V: float, step_s: float) -> None:
        """Take one error of the learnt and of the frozen model, V."""
        squared = error_V * error_V
        slow, fast = min(1.0, step_s / LONG_S), min(1.0, step_s / SHORT_S)
        if self.judged > 0 and squared <= max(self.long_V2, self.short_V2) + self.doubt_V2:
            self.inside += 1
        self.error_V = error_V
        self.judged += 1
        self.long_V2 += (squared - self.long_V2) * slow
        self.short_V2 += (squared - self.short_V2) * fast
        self.doubt_V2 *= 1.0 - fast
        frozen = frozen_error_V * frozen_error_V
        self.frozen_V2 += (frozen - self.frozen_V2) * slow
        self.frozen_short_V2 += (frozen - self.frozen_short_V2) * fast

    @shared
    def decide(self, enter_V: float, leave_V: float) -> bool:
        """Validity with hysteresis: lost when the short-term rms exceeds ``leave_V``, regained below ``enter_V``."""
        rms = sqrt(self.short_V2)
        if self.valid and rms > leave_V:
            self.valid = False
        elif not self.valid and rms < enter_V:
            self.valid = True
        return self.valid

    @shared
    def choose(self, floor_V: float, step_s: float) -> bool:
        """Whether to serve the frozen model: taken when clearly better, left when worse."""
        learnt, frozen = sqrt(self.short_V2), sqrt(self.frozen_short_V2)
        if not self.fallback and learnt > FALLBACK_RATIO * frozen + floor_V:
            self.fallback = True
        elif self.fallback and learnt < frozen:
            self.fallback = False
        self.fallen_s = self.fallen_s + step_s if self.fallback else 0.0
        return self.fallback

    def rolled_back(self) -> None:
        """The learner has returned to an earlier estimate: count the time of the frozen model from zero."""
        self.fallen_s = 0.0

    def add_doubt(self, variance_V2: float) -> None:
        """Add to the stated variance for a jump whose cause is open, V²."""
        self.doubt_V2 += variance_V2

    @property
    def std_V(self) -> float:
        """Standard deviation of the learner's predictions, V: the larger of long and short term."""
        return sqrt(max(self.long_V2, self.short_V2))

    @property
    def recent_V(self) -> float:
        """Rms error over the short term, V."""
        return sqrt(self.short_V2)

    @property
    def variance_V2(self) -> float:
        """Variance behind the stated uncertainty: the larger of long and short term, plus ``doubt_V2``."""
        return max(self.long_V2, self.short_V2) + self.doubt_V2


class Delay:
    """The last ``steps`` + 1 coefficient vectors: errors are those of the model as it was ``steps`` ago."""

    _past: Annotated[deque[FloatArray], Entry("linear parts of late, oldest first", "V", "*,p|0", name="delay")]

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._past = deque(maxlen=steps + 1)

    def push(self, vector: FloatArray) -> FloatArray:
        """Take the newest, return the oldest kept."""
        self._past.append(vector)
        return self._past[0]

    def shift(self, by: float) -> None:
        """Add to the first entry of all kept."""
        for vector in self._past:
            vector[0] += by


# --- The learner.

#: Names of the events that are counted beside the samples.
EVENTS = ("fallbacks", "rollbacks", "distrusts", "adoptions", "adoptions_refused")

#: The filter returns to its last good estimate after the frozen model was better for this long, s; a good estimate is
#: marked this often, s. The readings are judged by one that is older, between one and two such times: a newer one has
#: already taken in a part of what has begun to go wrong.
ROLLBACK_S, MARK_S, REFERENCE_S = 0.5, 0.1, 1.0

#: Error, as a share of a jump, where a gain is taken for an offset or the other way round.
JUMP_DOUBT = 0.3
#: Time between two checks of the sensor, s; at least a step of the filter.
CHECK_S = 0.004
#: Number of newest samples on which old and new hyper-parameters are compared.
NEWEST = 100
#: Largest move of the output at an adoption, in its stated standard deviations (rms over the newest samples).
MOST_MOVED = 2.0


class Parts:
    """The changing state of a learner, and the operations on several of its parts.

    first : the filter's estimate of the identified model.
    window : the kernel part, whose state is among the entries ``window``.
    check_every, check_s : samples between two checks of the sensor, and the time between them, s.
    allowed_V : largest difference of the model from the identified linear part, V; 0 for no bound.
    """

    intake: Annotated[Intake, Entry("gates, smoother, frame and hysteresis memory", name="front")]
    filter: Annotated[DriftFilter, Entry("filter of the linear part")]
    rest: Annotated[RestCreep, Entry("creep at rest")]
    judgement: Annotated[Judgement, Entry("errors at the age of serving")]
    delay: Annotated[Delay, Entry("estimates of late", name="")]
    domain: Annotated[FloatArray, Entry("learnt range, as of the snapshot", "µm, µm/s, µm/s²", "6")]
    point: Annotated[FloatArray, Entry("kernel inputs of the last instant due for learning", "", "d", finite=False)]
    counters: Annotated[dict[str, int], Entry("samples by outcome", low=0, among=(LEARNT, PASSED, *REASONS))]
    events: Annotated[dict[str, int], Entry("events by name", low=0, among=EVENTS)]
    # ``mark`` is the good estimate before the last, because the last may already contain a beginning fault.
    mark: Annotated[Mark, Entry("a good estimate of the filter")]
    next_mark: Annotated[Mark, Entry("a newer one")]
    references: Annotated[FloatArray, Entry("good estimates that judge the readings, the older first", "V", "2,p")]

    def __init__(
        self,
        base: LssvmInverse,
        config: LearnerConfig,
        window: ResidualWindow | None = None,
        allowed_V: float | None = None,
    ) -> None:
        self.config = config
        self.intake = Intake(base, config)
        p = base.features.basis_size
        covariance = base.beta_covariance if base.beta_covariance.size else (0.01 * base.span_V) ** 2 * np.eye(p)
        step_s = config.filter_every * base.dt_s
        self.filter = DriftFilter(config.drift, base.beta, covariance, step_s, base.span_V)
        self.first = self.filter.mark()
        self.window = window or ResidualWindow.from_model(base, config.window, config.eviction, config.solver)
        self.mark = self.filter.mark()
        self.next_mark = self.mark
        self.references = np.stack([base.beta, base.beta])
        self.domain = base.domain.copy()
        self.point = np.full(base.features.kernel_size, np.nan)
        start_V2 = max(base.noise_variance, (1e-4 * base.span_V) ** 2)
        self.judgement = Judgement(start_V2, start_V2, start_V2, start_V2)
        self.rest = RestCreep()
        self.delay = Delay(round(config.serving_age_s / step_s))
        steps = max(1, round(CHECK_S / self.filter.step_s))
        self.check_every, self.check_s = steps * config.filter_every, steps * self.filter.step_s
        # Without a linear part there is nothing to bound the kernel by. The identified kernel part is allowed on top.
        if allowed_V is None:
            allowed_V = config.envelope.shape * drive_V(base) + self.window.reach_V if base.features.linear else 0.0
        self.allowed_V = allowed_V
        self.counters = new_counters()
        self.events = dict.fromkeys(EVENTS, 0)

    def follow(self, basis: FloatArray, kernel_V: float, pair: Pair, rest: bool) -> bool:
        """One step of the filter at basis (p,) of ``pair``; False for an outlier, not learnt then.

        ``kernel_V`` : the whole kernel part there. ``rest`` : whether the stage is at rest.
        """
        left_V = pair.u_V - float(basis.dot(self.filter.beta))
        if self.filter.update(basis, pair.u_V - self.window.share * kernel_V, not rest) == "outlier":
            return False
        if not rest:
            self.window.weigh(kernel_V, left_V, self.filter.step_s)
        self.take_rest(pair.u_V, moving=not rest)
        if self.judgement.valid and not rest:
            self.widen_domain((pair.y_um, pair.v_um_per_s, pair.a_um_per_s2))
            self.intake.learn_rates(pair.rates)
        return True

    def take_rest(self, u_V: float, moving: bool) -> None:
        """After a step of the filter at rest: move the gain of the constant to the frame."""
        intake, f = self.intake, self.filter
        if moving:
            self.rest.leave()
            return
        constant_V, creep_s = float(f.beta[0]), self.config.creep_s
        shift_um = self.rest.shift_um(constant_V, u_V, f.span_V, intake.range_um, f.step_s, creep_s)
        if shift_um:
            intake.creep(shift_um)

    def judge(self, error_V: float, frozen_error_V: float) -> None:
        """Take the errors of the model as it was served at this instant, and of the frozen model, V."""
        c, j, step_s = self.config, self.judgement, self.filter.step_s
        span_V = self.filter.span_V
        j.take(error_V, frozen_error_V, step_s)
        j.decide(c.valid_enter * span_V, c.valid_leave * span_V)
        before = j.fallback
        self.events["fallbacks"] += j.choose(c.fallback_floor * span_V, step_s) and not before
        if j.fallen_s > ROLLBACK_S:
            # The frozen model was better for half a second: take back what was learnt since the last good estimate,
            # and jumps that the frozen model does not have.
            j.rolled_back()
            self.intake.to_base_frame()
            self.filter.go_back(self.mark)
            # If that estimate does not end it either, the next to return to is the identified one.
            self.mark = self.next_mark = self.first
            self.references[:] = self.first.beta
            self.events["rollbacks"] += 1
        elif j.short_V2 < (0.5 * c.valid_enter * span_V) ** 2:
            if j.judged % max(1, round(MARK_S / step_s)) == 0:
                self.mark, self.next_mark = self.next_mark, self.filter.mark()
            if j.judged % max(1, round(REFERENCE_S / step_s)) == 0:
                self.references[0], self.references[1] = self.references[1], self.filter.beta
                self.intake.mark_rates()

    def go_back(self) -> None:
        """The readings do not follow the drive: return to the older good estimate, or to a jump after it."""
        self.filter.restore(self.mark)
        self.events["distrusts"] += 1

    def take_jump(self, jump_um: float, first: bool) -> None:
        """The frame has moved by ``jump_um``, µm; ``first``: see ``Taken``."""
        intake = self.intake
        self.judgement.add_doubt((JUMP_DOUBT * jump_um / intake.range_um * intake.base.span_V) ** 2)
        if first:
            self._mark_now()

    def _mark_now(self) -> None:
        """The present estimate is the one to return to."""
        self.mark = self.next_mark = self.filter.mark()
        self.references[:] = self.mark.beta

    def widen_domain(self, motion: tuple[float, float, float]) -> None:
        """Extend the domain to a learnt instant (µm, µm/s, µm/s²)."""
        ends = self.domain.tolist()
        for i, x in enumerate(motion):
            if x < ends[2 * i]:
                self.domain[2 * i] = x
            if x > ends[2 * i + 1]:
                self.domain[2 * i + 1] = x

    def shift_constant(self, by_V: float) -> None:
        """Add to the constant of the linear part: now, in all marks, and in the delayed estimates."""
        self.filter.shift_constant(by_V)
        marks = (self.mark, self.next_mark)
        for beta, _ in {id(m): m for m in marks}.values():
            beta[0] += by_V
        self.references[:, 0] += by_V
        self.delay.shift(by_V)

    @property
    def missing_V2(self) -> float:
        """Variance that the motion of missing samples leaves in the voltages, V²; 0 while none is open."""
        missing = self.intake.missing
        return 0.0 if missing is None else missing.std_V**2

    @property
    def variance_V2(self) -> float:
        """Variance behind the stated uncertainty, V²."""
        return self.judgement.variance_V2 + self.missing_V2

    def model(self) -> LssvmInverse:
        """The learnt model, immutable; the identified one while that predicts better."""
        base = self.intake.base
        j, window, seq = self.judgement, self.window, self.intake.gates.seq
        valid = j.valid and not self.intake.fault
        if j.fallback:
            return replace(base, noise_variance=j.frozen_short_V2 + self.missing_V2, seq=seq, valid=valid)
        support, alpha, bias = window.arrays()
        beta = self.filter.beta
        beta[0] += bias
        return replace(
            base,
            features=self.intake.served,
            beta=beta,
            support=support,
            alpha=alpha,
            widths=np.array(window.hyper.widths),
            gamma=window.hyper.gamma,
            domain=self.domain,
            noise_variance=self.variance_V2,
            kernel_variance=window.kernel_variance,
            beta_covariance=np.empty((0, 0)),
            seq=seq,
            valid=valid,
            anchor=base.beta if self.allowed_V else np.empty(0),
            allowed_V=self.allowed_V,
        )

    def adopt(self, hyper: Hyperparameters) -> str:
        """Let the window continue with other hyper-parameters. Returns "", or why they are refused.

        The window is factored anew over its own samples: O(N³), once. The constant of the linear part takes up the
        difference at the last point that was learnt, so that the output there does not jump. Refused without a change
        where the kernel matrix cannot be factored, where the leave-one-out errors of the newest samples (rms) are not
        smaller, or where the output would move too far.
        """
        window = self.window
        try:
            challenger = window.with_hyperparameters(hyper)
            now_V, then_V = challenger.newest_error_V(NEWEST), window.newest_error_V(NEWEST)
        except DehystError as error:
            return f"numerics: {error}"
        if not now_V <= then_V:
            return f"worse: {now_V:.3g} V rms on the newest samples, {then_V:.3g} V as it is"
        point = self.point
        shift_V = window.mean(point) - challenger.mean(point) if np.all(np.isfinite(point)) else 0.0
        moves_V = np.array([challenger.mean(x) + shift_V - window.mean(x) for x in window.newest(NEWEST)])
        moved_V = max(abs(shift_V), sqrt(float(np.mean(moves_V**2))) if moves_V.size else 0.0)
        limit_V = MOST_MOVED * sqrt(self.judgement.variance_V2)
        if not moved_V <= limit_V:
            return f"jump: the output would move by {moved_V:.3g} V, {limit_V:.3g} V is the most"
        self.window = challenger
        self.shift_constant(shift_V)
        return ""

    @property
    def ordinary(self) -> bool:
        """Whether samples are learnt in the ordinary way: nothing is in doubt, and nothing is being repaired."""
        return self.intake.ordinary and not self.window.heals

    # ---- keeping

    def state_dict(self, arrays: bool = True) -> StateDict:
        """The whole changing state under flat names; ``arrays=False``: without the arrays of the window's solver."""
        return save(self) | prefixed("window.", self.window.state_dict(arrays))

    def restore(self, state: StateDict, arrays: bool = True) -> None:
        """Inverse of ``state_dict``. Raises ModelFileError where it does not fit; then nothing is changed."""
        own = {name: value for name, value in state.items() if not name.startswith("window.")}
        with within("window."):
            window = self.window.read(under("window.", state), arrays)
        restore(self, own, self.intake.sizes, {"intake": self.intake.given})
        self.window.take(window)


def _warm(base: LssvmInverse, config: LearnerConfig) -> None:
    """Load or compile every step of a learner, on parts that are thrown away."""
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
    gap = MissingMotion.begin(base, base.rest_memory(y), y, y, 0.0, 1.0, 0.0)
    gap.advance(y)
    gap.correct((y, 0.0, 0.0), 0.0, 1.0)
    level_of(np.arange(8.0) % 3.0, 1.0)
    window.with_hyperparameters(window.hyper).newest_error_V(1)
    for moving in (True, False):
        parts.filter.update(basis, 0.0, moving)
    parts.filter.expect_change()


class Learner:
    """Learns one axis online, starting from an identified model. Implements ``adaptive.types.OnlineModel``.

    Not for several threads at once: one thread calls ``handle`` and ``snapshot``; snapshots may be used anywhere.
    """

    def __init__(self, model: LssvmInverse, config: LearnerConfig | None = None) -> None:
        self._begin(model, config or LearnerConfig())

    def _begin(
        self,
        model: LssvmInverse,
        config: LearnerConfig,
        window: ResidualWindow | None = None,
        allowed_V: float | None = None,
    ) -> None:
        self.config = config
        self.base = model
        self.parts = Parts(model, config, window, allowed_V)
        features = model.features
        self._basis = np.empty(features.basis_size)
        self._frozen_basis, self._frozen_kernel = self._basis.copy(), np.empty(features.kernel_size)
        self._frozen = False
        self._cache: LssvmInverse | None = None

    @classmethod
    def from_model(cls, model: LssvmInverse, config: LearnerConfig | None = None) -> Learner:
        """A learner that starts from an identified model."""
        return cls(model, config)

    @classmethod
    def around(cls, model: LssvmInverse, config: LearnerConfig, window: ResidualWindow, allowed_V: float) -> Learner:
        """A learner that steps a window which another owns, with the bound of a learner of the same model, V.

        `resume` gives it a state.
        """
        made = cls.__new__(cls)
        made._begin(model, config, window, allowed_V)
        return made

    # ---- samples in

    @property
    def seq(self) -> int:
        """Sequence number of the last sample taken, -1 before any."""
        return self.parts.intake.gates.seq

    def handle(self, sample: Sample) -> str:
        """Take one sample. Returns "learnt", "passed" (no step was due), or the name of the gate that refused it."""
        outcome = self._handle(sample)
        self.parts.counters[outcome] += 1
        return outcome

    def resync(self) -> None:
        """Forget the sequence: the next sample is taken whatever its number, after the stage itself began anew."""
        self.parts.intake.resync()

    def take_place_of(self, other: OnlineModel) -> None:
        """Continue at the position of ``other`` with the parameters of this learner.

        For when ``other`` has learnt from bad samples: its track and frame of the stage are still right.
        """
        if not isinstance(other, Learner):
            self.resync()
            return
        mine, its = self.parts.intake, other.parts.intake
        if its.track is None:
            self.resync()
            return
        mine.go_on_as(its)

    def _handle(self, sample: Sample) -> str:
        parts, intake = self.parts, self.parts.intake
        taken = intake.take(sample, self.snapshot, parts.judgement.std_V, parts.judgement.recent_V)
        if taken.distrusted:
            self._go_on_without_readings()
        if taken.jump_um:
            parts.take_jump(taken.jump_um, taken.first)
            if intake.track is not None and intake.track.features is intake.track.served:
                parts.filter.expect_change()  # of a trial: no instant in the frame from before is still to be learnt
        moved = taken.jump_um or taken.distrusted or taken.renamed
        if moved or taken.refused == admission.GAP:
            self._cache = None
        outcome = taken.refused
        for step in taken.steps:
            pair, switched = intake.advance(step)
            if switched:
                parts.filter.expect_change()
            if not taken.refused:
                outcome = admission.SETTLING if pair is None else self.teach(pair)
        return outcome

    def teach(self, pair: Pair) -> str:
        """Learn the pair at the smoothed instant, in filter and window, if the gates allow it."""
        c, parts, intake = self.config, self.parts, self.parts.intake
        track = intake.track
        assert track is not None
        waits = self._waits(pair)
        if waits:
            return waits
        refused = check_pair(c.admission, *pair.applied_V, pair.y_um)
        # A saturated sample is not learnt, but it shows where the stage is, and so the error of the model.
        if refused and refused != admission.SATURATED:
            return refused
        if pair.now % c.filter_every:
            return refused or admission.PASSED
        motion = (pair.y_um, pair.v_um_per_s, pair.a_um_per_s2)
        track.features.fill(*motion, track.memory, self._basis, parts.point)
        rest = intake.rests(pair.y_um)
        kernel_V = parts.window.predict(parts.point)
        target = pair.u_V - parts.window.share * kernel_V
        beta = parts.filter.beta
        if not isfinite(target):
            return admission.NUMERICS
        self.base.features.fill(*motion, track.frozen_memory, self._frozen_basis, self._frozen_kernel)
        frozen_V = self.base.mean(self._frozen_basis, self._frozen_kernel)
        served_V = float(self._basis.dot(parts.delay.push(beta)))
        parts.judge(target - served_V, pair.u_V - frozen_V)
        if pair.now % parts.check_every == 0:
            found = self._check(pair, target, bool(refused))
            if found:
                return found
        # Where nothing is learnt, the stated deviation is of the errors until now all the same.
        self._cache = None
        if refused:
            return refused
        if self._frozen:
            return admission.FROZEN
        if not parts.follow(self._basis, kernel_V, pair, rest):
            return admission.OUTLIER
        if rest:
            return admission.UNEXCITED
        # The window learns only what the filter has just taken, and what that left. Alone it would take the first
        # samples of a changed stage, which the filter still refuses, and the change would become local for good.
        if due(pair.now // c.filter_every, c.window_every):
            return parts.window.learn(parts.point, pair.u_V - float(self._basis.dot(parts.filter.beta)))
        return admission.LEARNT

    def _waits(self, pair: Pair) -> str:
        """The gate for which the pair is no measure of the model, or ""."""
        c, intake = self.config, self.parts.intake
        if intake.missing is not None:
            missing = intake.recall(pair, self.snapshot, c.filter_every)
            self._cache = None
            if missing:
                return admission.GAP
        if admission.settling(c.admission, intake.gates):
            return admission.SETTLING
        return "" if pair.good else admission.GLITCH

    def _check(self, pair: Pair, target_V: float, saturated: bool) -> str:
        """Check the sensor. Returns the gate that forbids learning, or ""."""
        parts, intake = self.parts, self.parts.intake
        kernel_V = pair.u_V - target_V
        p_V = kernel_V + float(self._basis.dot(parts.references[0]))
        if saturated or not intake.follow(pair, p_V, parts.check_s):
            return ""
        if not intake.distrust(self.snapshot):
            return ""
        self._go_on_without_readings()
        return admission.UNTRUSTED

    def _go_on_without_readings(self) -> None:
        """The readings are on trial from now on."""
        self.parts.go_back()
        self._cache = None
        self.parts.intake.reckon_by(self.snapshot())

    @property
    def trouble(self) -> str:
        """Name of what prevents learning, "" while nothing does.

        Of the sensor: ``sensor_stuck``, ``sensor_gain``, ``sensor_sign``, ``sensor_foreign``, ``out_of_envelope``.
        """
        return self.parts.intake.fault

    @property
    def distrusts(self) -> bool:
        """Whether the readings are on trial: what is served is from before them."""
        return self.parts.intake.on_trial

    @property
    def why(self) -> str:
        """The reason for ``trouble`` in words, with numbers."""
        return self.parts.intake.why if self.parts.intake.fault else ""

    # ---- snapshots out

    def snapshot(self) -> LssvmInverse:
        """The model as it stands, immutable. The same object while nothing new was learnt."""
        if self._cache is None:
            self._cache = self.parts.model()
        return self._cache

    def moving(self) -> MovingPart | None:
        """What has moved since the last snapshot; None where something else than the learnt model is served."""
        parts, intake, j = self.parts, self.parts.intake, self.parts.judgement
        if j.fallback or intake.track is None or self.trouble or self.distrusts:
            return None
        frame = intake.served
        return MovingPart(
            frame.gain, frame.offset_um, parts.filter.beta, parts.domain.copy(), parts.variance_V2, intake.memory_now(),
            parts.window,
        )  # fmt: skip

    def memory(self) -> FloatArray:
        """(m,) hysteresis memory as tracked from the measured samples; where a caller without one begins.

        It is of the smoother's instant, ``lag`` samples before ``seq``.
        """
        track = self.parts.intake.track
        return self.base.rest_memory(self.base.features.y_rest_um) if track is None else track.memory.copy()

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """(m,) hysteresis memory with which ``model``, a snapshot of this learner, goes on from the last sample.

        The model was learnt with this memory. One that is tracked over readings that were not trusted would make its
        answers wrong until the motion has wiped out the difference. None before the first sample.
        ``smoothed`` : from the smoother's instant, ``lag`` samples ago; None while readings are held back.
        """
        intake = self.parts.intake
        # Of two memories in one frame, the learner's has not followed untrusted readings.
        if intake.track is None or (smoothed and intake.holds) or not isinstance(model, LssvmInverse):
            return None
        frozen = model.features != intake.served and model.features == self.base.features
        if smoothed:
            return (intake.track.frozen_memory if frozen else intake.track.memory).copy()
        return intake.memory_now(frozen)

    @property
    def features(self) -> FeatureMap:
        """The feature map that is served."""
        return self.parts.intake.served

    @property
    def extrapolation_V(self) -> float:
        """Standard deviation that an answer gains one learnt span outside the learnt velocity or acceleration, V.

        By the covariance of the filter; infinite for a model without a linear part.
        """
        f, parts = self.base.features, self.parts
        if not f.linear:
            return inf
        variances = parts.filter.covariance.diagonal()[VELOCITY : ACCELERATION + 1]
        spans = (parts.domain[3::2] - parts.domain[2::2]) / (f.v_scale_um_per_s, f.a_scale_um_per_s2)
        return float(np.max(np.sqrt(np.maximum(variances, 0.0)) * spans))

    def warm(self) -> None:
        """Load or compile every step on a copy, so that no sample waits seconds for the compiler."""
        _warm(self.base, self.config)

    def freeze(self) -> None:
        """Stop learning. Samples still advance smoother, memory and error statistics."""
        self._frozen = True

    def thaw(self) -> None:
        """Learn again."""
        self._frozen = False

    @property
    def frozen(self) -> bool:
        """Whether learning is stopped."""
        return self._frozen

    # ---- hyper-parameters from elsewhere

    @property
    def hyper(self) -> Hyperparameters:
        """Regularisation and kernel widths that the window works with."""
        return self.parts.window.hyper

    def adopt(self, hyper: Hyperparameters) -> str:
        """Continue with other hyper-parameters from the present sample on. Returns "", or why they were refused.

        Atomic, and without a jump of the output; refused unless it predicts the newest samples better.
        """
        reason = self.parts.adopt(hyper)
        self.parts.events["adoptions_refused" if reason else "adoptions"] += 1
        if not reason:
            self._cache = None
        return reason

    def window_data(self) -> WindowData:
        """A copy of the window's samples and hyper-parameters, to tune them elsewhere; see ``adopt``."""
        return self.parts.window.data()

    def window_samples(self) -> tuple[FloatArray, FloatArray]:
        """(n, d) kernel inputs and (n,) dual weights, V, of the window's samples. Copies."""
        support, alpha, _ = self.parts.window.arrays()
        return support, alpha

    # ---- looking in, and keeping

    def counters(self) -> dict[str, int]:
        """Samples by outcome, and events. A copy."""
        parts = self.parts
        drift = parts.filter.state
        events = {
            "restarts": parts.intake.restarts,
            "jumps": parts.intake.jumps,
            "jumps_undone": parts.intake.undone,
            "trials": parts.intake.trials,
            **parts.events,
        }
        return {
            **parts.counters,
            **events,
            "filter_updates": drift.updates,
            "bursts": drift.bursts,
            **prefixed("window_", parts.window.counters()),
        }

    def diagnostics(self) -> dict[str, Any]:
        """Errors in V and in percent of the voltage span, gain and offset, the window's samples.

        ``gain`` is the stage's, relative to the identified model: that of the frame and of the linear part together.
        """
        parts, base = self.parts, self.base
        j, intake, percent = parts.judgement, parts.intake, 100.0 / base.span_V
        estimate = parts.filter.beta
        now, before = estimate[1:], base.beta[1:]
        along = float(now @ before)
        window_y_um, window_v_um_per_s = intake.served.motion_of(parts.window.arrays()[0])
        return {
            "error_V": j.error_V,
            "rms_error_pct": float(np.sqrt(j.long_V2)) * percent,
            "recent_rms_error_pct": float(np.sqrt(j.short_V2)) * percent,
            "frozen_rms_error_pct": float(np.sqrt(j.frozen_V2)) * percent,
            "share_within_std": j.inside / max(1, j.judged),
            "gain": intake.served.gain * (float(before @ before) / along if along > 0.0 else 1.0),
            "frame_gain": intake.served.gain,
            "frame_offset_um": intake.served.offset_um,
            "offset_V": float(estimate[0] - base.beta[0]),
            "u_V": intake.gates.u_V,
            "std_V": float(np.sqrt(j.variance_V2)),
            "window_samples": float(len(parts.window)),
            "window_residual_V": parts.window.residual_V,
            "window_cholesky": float(parts.window.form == "cholesky"),
            "valid": float(j.valid),
            "fallback": float(j.fallback),
            "frozen": float(self._frozen),
            "lag_s": intake.smoother.config.lag * base.dt_s,
            "window_y_um": window_y_um.tolist(),
            "window_v_um_per_s": window_v_um_per_s.tolist(),
        }

    def take_events(self) -> list[tuple[str, str]]:
        """Always empty: the events of a learner are in ``counters`` and ``trouble``."""
        return []

    def state_dict(self) -> StateDict:
        """The whole state; ``from_state`` continues from it with the same result to the last bit."""
        made_from = joined({"base": self.base.state_dict(), "config": self.config.state_dict()})
        return {**made_from, **self.parts.state_dict(), "frozen": self._frozen}

    def resume(self, state: StateDict, arrays: bool = True) -> None:
        """Continue from the changing part of a state; ``arrays=False``: the solver's arrays hold theirs already."""
        changing = {n: value for n, value in state.items() if not n.startswith(("base.", "config.", "frozen"))}
        if type(state.get("frozen")) is not bool:
            raise Refused("frozen", repr(state.get("frozen"))[:80], "a truth value")
        self.parts.restore(changing, arrays)
        self._frozen = state["frozen"]
        self._cache = None

    def restored(self, state: StateDict) -> Learner:
        """A learner with ``state``. Raises ModelFileError where entries are missing or do not fit together."""
        return self.from_state(state)

    @classmethod
    def from_state(cls, state: StateDict) -> Learner:
        """Inverse of ``state_dict``. Raises ModelFileError where entries are missing or do not fit together."""
        made = cls.__new__(cls)
        with within("base."):
            base = LssvmInverse.from_state(under("base.", state))
        try:
            made._begin(base, LearnerConfig.from_state(under("config.", state)))
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f"learner state: setting missing or damaged: {error}; start from the model") from error
        made.resume(state)
        return made
