"""The learner: samples in, snapshots out. Deterministic, bounded in time and memory, never raises on data.

A sample passes the intake (``adaptive.online.intake``): gates, fixed-lag smoother, and hysteresis memory and features
at the smoothed instant. Then two learners share one model. The Kalman filter (``drift``) follows the linear part, the
sliding-window LSSVM (``kernel_window``) learns the rest. Each takes the voltage minus the other's part as its target,
so that a change is learnt once and the old samples of the window stay valid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import inf, sqrt
from typing import Annotated, Any, Final, NamedTuple

import numpy as np

from dehyst.adaptive.errors import DehystError, ModelFileError
from dehyst.adaptive.features import ACCELERATION, VELOCITY, FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates as admission
from dehyst.adaptive.online import step as order
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.drift import DriftFilter, Mark, RestCreep
from dehyst.adaptive.online.gates import OUTCOMES, Judgement
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED, level_of
from dehyst.adaptive.online.intake import Intake
from dehyst.adaptive.online.kernel_window import KernelShare, ResidualWindow
from dehyst.adaptive.online.row import Row
from dehyst.adaptive.online.step import SAMPLE
from dehyst.adaptive.online.track import MissingMotion, Reckoning, Step, answers, drive_V
from dehyst.adaptive.smoothing import smoother_of
from dehyst.adaptive.state import Entry, Numbers, record_of, restore, save, within
from dehyst.adaptive.types import (
    FloatArray,
    Hyperparameters,
    IntArray,
    InverseModel,
    MovingPart,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
    joined,
    parted,
    prefixed,
    under,
)
from dehyst.adaptive.window.arrays import WindowArrays, handle_of

#: Names of the events that are counted beside the samples.
EVENTS = ("fallbacks", "rollbacks", "distrusts", "adoptions", "adoptions_refused")

#: Error, as a share of a jump, where a gain is taken for an offset or the other way round.
JUMP_DOUBT = 0.3
#: Time between two checks of the sensor, s; at least a step of the filter.
CHECK_S = 0.004
#: Number of newest samples on which old and new hyper-parameters are compared.
NEWEST = 100
#: Largest move of the output at an adoption, in its stated standard deviations (rms over the newest samples).
MOST_MOVED = 2.0


# --- The arrays and numbers of an axis, for the compiled order (`adaptive.online.step`).


def _structured(numbers: StateDict) -> Any:
    """The structured type of flat numbers, nested by their names."""
    fields = parted(numbers).items()
    return np.dtype([(name, type(of[""]) if "" in of else _structured(of)) for name, of in fields], align=True)


def _nested(numbers: StateDict) -> Any:
    return tuple(of[""] if "" in of else _nested(of) for of in parted(numbers).values())


def _numbers(state: StateDict) -> StateDict:
    return {name: value for name, value in state.items() if isinstance(value, bool | int | float)}


def config_record(config: LearnerConfig, dt_s: float) -> Any:
    """(1,) the configuration and what follows from it and the sample time, for compiled code."""
    step_s = config.filter_every * dt_s
    checks = max(1, round(CHECK_S / step_s))
    steps = {
        "dt_s": float(dt_s), "step_s": float(step_s), "check_s": float(checks * step_s),
        "check_every": checks * config.filter_every, "mark_every": max(1, round(order.MARK_S / step_s)),
        "reference_every": max(1, round(order.REFERENCE_S / step_s)), "window_every": config.window_every,
        "fifo": config.eviction == "fifo", "lag": config.smoother(dt_s).lag,
    }  # fmt: skip
    given = replace(config, admission=config.admission.at(dt_s)).state_dict() | steps
    kinds = _numbers(LearnerConfig().state_dict() | steps)
    return np.array([_nested({name: type(kind)(given[name]) for name, kind in kinds.items()})], _structured(kinds))


class Home(NamedTuple):
    """Where a learner keeps its numbers and arrays: of its own, or the row of a fleet.

    numbers : (1,) record of `NUMBERS`. config : see `config_record`. row : its arrays. window : what the window begins
    as, and is to be stepped in; None: made from the model.
    """

    numbers: Any
    config: Any
    row: Row
    window: WindowArrays | None = None


def allocate(count: int, base: LssvmInverse, config: LearnerConfig) -> dict[str, Any]:
    """The arrays of ``count`` rows by name, but for constants: the first index is the axis."""
    f, smoother = base.features, config.smoother(base.dt_s)
    p, d, m, lag, order = f.basis_size, f.kernel_size, f.memory_size, smoother.lag, smoother.order
    ages = round(config.serving_age_s / (config.filter_every * base.dt_s)) + 1
    shapes: dict[str, tuple[int, ...]] = {
        "x": (order,), "ring": (lag + 1, 4), "drive_x": (order,), "drive_ring": (lag + 1, 4), "voltages": (lag + 2,),
        "readings": (lag + 2,), "good": (lag + 2,), "motion": (3,), "rates": (2,), "known": (3, 2), "memory": (m,),
        "frozen_memory": (m,), "frames": (2, 4), "beta": (p,), "covariance": (p, p), "mark_beta": (2, p),
        "mark_covariance": (2 * p, p), "references": (2, p), "delay": (ages, p), "domain": (6,), "basis": (p,),
        "point": (d,), "born": (config.window,), "past_motion": (2, 4), "past_V": (2, lag), "past_um": (2, lag),
        "past_memory": (2, m), "past_ring": (MOST_BRIDGED + 2,), "past_from": (2,), "counters": (len(OUTCOMES),),
    }  # fmt: skip
    whole = ("good", "born", "past_from", "counters")
    return {n: np.zeros((count, *shape), np.int64 if n in whole else np.float64) for n, shape in shapes.items()}


def row_in(arrays: Mapping[str, Any], axis: int, base: LssvmInverse, config: LearnerConfig) -> Row:
    """The row of an axis in what `allocate` gave."""
    model, sizes = base.packed
    smoother = smoother_of(config.smoother(base.dt_s))
    p = base.features.basis_size
    return Row(
        **{name: array[axis] for name, array in arrays.items()}, walks=np.empty(p), bursts=np.empty(p), model=model,
        sizes=sizes, transition=smoother.transition, gain=smoother.gain, lag_gains=smoother.lag_gains,
        scale=smoother.scale,
    )  # fmt: skip


class Parts(Numbers):
    """The changing state of a learner, and the operations on several of its parts.

    first : the filter's estimate of the identified model.
    window : the kernel part, whose state is among the entries ``window``.
    allowed_V : largest difference of the model from the identified linear part, V; 0 for no bound.
    """

    intake: Annotated[Intake, Entry("gates, smoother, frame and hysteresis memory", name="front")]
    filter: Annotated[DriftFilter, Entry("filter of the linear part")]
    rest: Annotated[RestCreep, Entry("creep at rest")]
    judgement: Annotated[Judgement, Entry("errors at the age of serving")]
    share: Annotated[KernelShare, Entry("numbers of the window")]
    frozen: Annotated[bool, Entry("whether learning is stopped")]
    delay: Annotated[FloatArray, Entry("ring of linear parts of late", "V", "ages,p")]
    delayed: Annotated[int, Entry("linear parts so far", low=0)]
    domain: Annotated[FloatArray, Entry("learnt range, as of the snapshot", "µm, µm/s, µm/s²", "6")]
    point: Annotated[FloatArray, Entry("kernel inputs of the last instant due for learning", "", "d", finite=False)]
    counters: Annotated[IntArray, Entry("samples by outcome", "", "outcomes", low=0)]
    fallbacks: Annotated[int, Entry("times that the identified model came to be served", low=0)]
    rollbacks: Annotated[int, Entry("returns to an earlier estimate because of them", low=0)]
    distrusts: Annotated[int, Entry("returns because the readings do not follow", low=0)]
    adoptions: Annotated[int, Entry("hyper-parameters adopted", low=0)]
    adoptions_refused: Annotated[int, Entry("and refused", low=0)]
    # The good estimate before the last and the last one, because that may already contain a beginning fault.
    mark_beta: Annotated[FloatArray, Entry("good estimates of the filter, the older first", "V", "2,p")]
    mark_covariance: Annotated[FloatArray, Entry("their covariances, one below the other", "V²", "2p,p")]
    references: Annotated[FloatArray, Entry("good estimates that judge the readings, the older first", "V", "2,p")]

    def __init__(self, base: LssvmInverse, config: LearnerConfig, home: Home | None = None) -> None:
        self.config = config
        if home is None:
            row = row_in(allocate(1, base, config), 0, base, config)
            home = Home(np.zeros(1, NUMBERS), config_record(config, base.dt_s), row)
        self.home, row = home, home.row
        numbers = home.numbers.reshape(())
        self.record, self.sample, self.handle = numbers, numbers["sample"], handle_of(row)
        p = base.features.basis_size
        covariance = base.beta_covariance if base.beta_covariance.size else (0.01 * base.span_V) ** 2 * np.eye(p)
        step_s = config.filter_every * base.dt_s
        self.intake = Intake(self.record["intake"], row, base, config)
        self.filter = DriftFilter(
            config.drift, base.beta, covariance, step_s, base.span_V, numbers["filter"], (row.beta, row.covariance)
        )
        row.walks[:], row.bursts[:] = self.filter.variances
        self.first = self.filter.mark()
        c, share = config, self.share
        own = home.window, share, row.born
        self.window = ResidualWindow.from_model(base, c.window, c.eviction, c.solver, *own)
        self.mark_beta, self.mark_covariance, self.references = row.mark_beta, row.mark_covariance, row.references
        self._mark_now()
        self.domain, self.point, self.delay, self.counters = row.domain, row.point, row.delay, row.counters
        self.domain[:], self.point[:] = base.domain, np.nan
        start_V2 = max(base.noise_variance, (1e-4 * base.span_V) ** 2)
        self.judgement = Judgement(start_V2, start_V2, start_V2, start_V2)
        self.rest = RestCreep()
        # Without a linear part there is nothing to bound the kernel by. The identified kernel part is allowed on top.
        self.allowed_V = c.envelope.shape * drive_V(base) + self.window.reach_V if base.features.linear else 0.0
        f, fixed = base.features, numbers["fixed"]
        fixed["middle_um"], fixed["range_um"] = 0.5 * (f.y_max_um + f.y_min_um), f.y_max_um - f.y_min_um
        fixed["span_V"], fixed["drive_V"], fixed["tells"] = base.span_V, drive_V(base), answers(base)
        fixed["allowed_V"], self.intake.judgement = self.allowed_V, self.judgement

    def roll_back(self) -> None:
        """The identified model was better for long: take back what was learnt since the last good estimate, and jumps
        that the identified model does not have."""
        self.judgement.rolled_back()
        self.intake.to_base_frame()
        self.filter.go_back(self.mark)
        # If that estimate does not end it either, the next to return to is the identified one.
        self._mark(self.first)
        self.rollbacks += 1

    @property
    def mark(self) -> Mark:
        """The good estimate to return to; a view."""
        return Mark(self.mark_beta[0], self.mark_covariance[: self.mark_beta.shape[1]])

    def go_back(self) -> None:
        """The readings do not follow the drive: return to the older good estimate, or to a jump after it."""
        self.filter.restore(self.mark)
        self.distrusts += 1

    def take_jump(self, jump_um: float, first: bool) -> None:
        """The frame has moved by ``jump_um``, µm; ``first``: see ``Taken``."""
        intake = self.intake
        self.judgement.add_doubt((JUMP_DOUBT * jump_um / intake.range_um * intake.base.span_V) ** 2)
        if first:
            self._mark_now()

    def _mark_now(self) -> None:
        """The present estimate is the one to return to."""
        self._mark(self.filter.mark())

    def _mark(self, mark: Mark) -> None:
        self.mark_beta[:], self.references[:] = mark.beta, mark.beta
        self.mark_covariance[:] = np.tile(mark.covariance, (2, 1))

    def shift_constant(self, by_V: float) -> None:
        """Add to the constant of the linear part: now, in all marks, and in the delayed estimates."""
        self.filter.shift_constant(by_V)
        for kept in (self.mark_beta, self.references, self.delay):
            kept[:, 0] += by_V

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
        window.become(challenger)
        self.shift_constant(shift_V)
        return ""

    # ---- keeping

    def state_dict(self) -> StateDict:
        """The whole changing state under flat names."""
        return save(self) | prefixed("window.", self.window.state_dict())

    def restore(self, state: StateDict) -> None:
        """Inverse of ``state_dict``. Raises ModelFileError where it does not fit; then nothing is changed."""
        own = {name: value for name, value in state.items() if not name.startswith("window.")}
        with within("window."):
            window = self.window.read(under("window.", state))
        p, ages = self.delay.shape[::-1]
        sizes = {"ages": ages, "2p": 2 * p, "outcomes": len(OUTCOMES)}
        restore(self, own, self.intake.sizes | sizes, {"intake": self.intake.given})
        self.window.take(window)
        self.note_healing()

    def note_healing(self) -> None:
        """Tell the compiled order whether the window is healing: then its steps are made in Python."""
        self.sample["heals"] = self.window.heals


#: Numbers of an axis: its state, its sample, and what does not change.
NUMBERS: Final = np.dtype([
    *((name, kind) for name, (kind, *_) in record_of(Parts).fields.items()), ("sample", SAMPLE),
    ("fixed", np.dtype([("middle_um", "f8"), ("range_um", "f8"), ("span_V", "f8"), ("drive_V", "f8"), ("tells", "?"),
                        ("allowed_V", "f8")], align=True)),
], align=True)  # fmt: skip


def _warm(base: LssvmInverse, config: LearnerConfig) -> None:
    """Load or compile every step of a learner, on parts that are thrown away."""
    parts = Parts(base, config)
    window, kernel = parts.window, np.zeros(base.features.kernel_size)
    window.predict(kernel)
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
    parts.filter.expect_change()
    Learner(base, config).handle(Sample(0, 0.0, 0.0, y))


_NO_SAMPLE: Final = Sample(0, 0.0, 0.0, 0.0)


class Learner:
    """Learns one axis online, starting from an identified model. Implements ``adaptive.types.OnlineModel``.

    Not for several threads at once: one thread calls ``handle`` and ``snapshot``; snapshots may be used anywhere.
    """

    def __init__(self, model: LssvmInverse, config: LearnerConfig | None = None, home: Home | None = None) -> None:
        """``home`` : where its state is kept; of its own unless given."""
        self.config = config = config or LearnerConfig()
        self.base = model
        self.parts = Parts(model, config, home)
        self._cache: LssvmInverse | None = None

    def __reduce__(self) -> Any:
        # Addresses are valid for one object only: a copy makes its own.
        return type(self).from_state, (self.state_dict(),)

    @classmethod
    def from_model(cls, model: LssvmInverse, config: LearnerConfig | None = None) -> Learner:
        """A learner that starts from an identified model."""
        return cls(model, config)

    # ---- samples in

    @property
    def seq(self) -> int:
        """Sequence number of the last sample taken, -1 before any."""
        return self.parts.intake.gates.seq

    def handle(self, sample: Sample) -> str:
        """Take one sample. Returns "learnt", "passed" (no step was due), or the name of the gate that refused it."""
        parts = self.parts
        stage = self._run(order.TAKE, sample)
        if stage != order.DONE:
            self.go_on(stage)
        if parts.sample["due"]:
            self._cache = None
        return OUTCOMES[parts.sample["outcome"]]

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
        if not its.track.begun:
            self.resync()
            return
        mine.go_on_as(its)

    def go_on(self, stage: int) -> None:
        """What is rare about a sample that the compiled order has left at ``stage``, and the rest of its way."""
        parts = self.parts
        parts.sample["rare"] = True
        if stage <= order.CONTROLLED:
            stage = self._take(stage)
        self._go_on(stage)
        parts.counters[parts.sample["outcome"]] += 1

    def _take(self, stage: int) -> int:
        """The intake of a sample. Returns the stage at which it goes on."""
        parts, intake, t = self.parts, self.parts.intake, self.parts.sample
        sample = Sample(t["seq"].item(), t["t_s"].item(), t["u_V"].item(), t["y_um"].item())
        before_V, missing = t["before_V"].item(), t["missing"].item()
        refused = OUTCOMES[t["refused"]] if t["refused"] >= 0 else ""
        if stage == order.CONTROLLED:
            intake.check_model(sample, self.snapshot)
            return order.ADVANCE
        if stage == order.TRIED:
            taken = intake.take_tried(sample, before_V, missing, refused)
        elif stage == order.GAPPED:
            taken = intake.after_gap(sample, missing, self.snapshot)
        else:
            taken = intake.take_held(sample, before_V, missing, refused, t["limit"].item(), self.snapshot)
        if taken.distrusted:
            self._go_on_without_readings()
        if taken.jump_um:
            parts.take_jump(taken.jump_um, taken.first)
            if not intake.track.jumps:
                parts.filter.expect_change()  # of a trial: no instant in the frame from before is still to be learnt
        if taken.jump_um or taken.distrusted or taken.renamed or taken.refused == admission.GAP:
            self._cache = None
        t["outcome"] = OUTCOMES.index(taken.refused) if taken.refused else -1
        for step in taken.steps[:-1]:
            self._go_on(self._begin(step, not taken.refused))
        if not taken.steps:
            return order.DONE
        return self._begin(taken.steps[-1], not taken.refused)

    def _begin(self, step: Step, teaches: bool) -> int:
        t = self.parts.sample
        t["y_um"], t["u_V"], t["good"], t["teaches"] = *step, teaches
        return order.ADVANCE

    def _go_on(self, stage: int) -> None:
        """From ``stage`` on to the end."""
        parts, intake = self.parts, self.parts.intake
        while stage != order.DONE:
            if stage == order.ADVANCED:
                stage = self._beside_the_smoother()
            elif stage == order.ROLLED_BACK:
                parts.roll_back()
                stage = order.CHECK
            elif stage == order.DISTRUSTED:
                stage = order.LEARN
                if intake.distrust(self.snapshot):
                    self._go_on_without_readings()
                    stage = self._end(admission.UNTRUSTED)
            elif stage == order.FORGET:
                intake.forget()
                stage = order.LEARN
            elif stage == order.HEALING:
                stage = self._end(parts.window.learn(parts.point, parts.sample["target_V"].item()))
                parts.note_healing()
            elif stage == order.ILL:
                parts.window.begin_healing()
                parts.note_healing()
                stage = order.DONE
            else:
                stage = self._run(stage)

    def _run(self, stage: int, sample: Sample = _NO_SAMPLE) -> int:
        parts, home = self.parts, self.parts.home
        # Plain numbers: each other type would be compiled for, which takes a minute.
        given = int(sample.seq), float(sample.t_s), float(sample.u_V), float(sample.y_um)
        return int(order.go_on(parts.handle, parts.window.handle, home.numbers, home.config, stage, *given))

    def _end(self, outcome: str) -> int:
        self.parts.sample["outcome"] = OUTCOMES.index(outcome)
        return order.DONE

    def _beside_the_smoother(self) -> int:
        """The smoother has made a step beside something rare. Returns the stage at which the sample goes on."""
        intake, t = self.parts.intake, self.parts.sample
        intake.go_along(t["u_V"].item())
        if not t["teaches"]:
            return order.DONE
        pair = intake.track.pair()
        if pair is None:
            return self._end(admission.SETTLING)
        if intake.missing is not None:
            missing = intake.recall(pair, self.snapshot, self.config.filter_every)
            self._cache = None
            if missing:
                return self._end(admission.GAP)
        return order.TEACH

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

    def look_again(self) -> None:
        """The state may have changed in a fleet: the next snapshot is a new one."""
        self._cache = None

    def moving(self) -> MovingPart | None:
        """What has moved since the last snapshot; None where something else than the learnt model is served."""
        parts, intake, j = self.parts, self.parts.intake, self.parts.judgement
        if j.fallback or not intake.track.begun or self.trouble or self.distrusts:
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
        return track.memory.copy() if track.begun else self.base.rest_memory(self.base.features.y_rest_um)

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """(m,) hysteresis memory with which ``model``, a snapshot of this learner, goes on from the last sample.

        The model was learnt with this memory. One that is tracked over readings that were not trusted would make its
        answers wrong until the motion has wiped out the difference. None before the first sample.
        ``smoothed`` : from the smoother's instant, ``lag`` samples ago; None while readings are held back.
        """
        intake = self.parts.intake
        # Of two memories in one frame, the learner's has not followed untrusted readings.
        if not intake.track.begun or (smoothed and intake.holds) or not isinstance(model, LssvmInverse):
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
        self.parts.frozen = True

    def thaw(self) -> None:
        """Learn again."""
        self.parts.frozen = False

    @property
    def frozen(self) -> bool:
        """Whether learning is stopped."""
        return self.parts.frozen

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
        if reason:
            self.parts.adoptions_refused += 1
        else:
            self.parts.adoptions += 1
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
            **{name: getattr(parts, name) for name in EVENTS},
        }
        return {
            **dict(zip(OUTCOMES, parts.counters.tolist(), strict=True)),
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
            "frozen": float(parts.frozen),
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
        return {**made_from, **self.parts.state_dict()}

    def resume(self, state: StateDict) -> None:
        """Continue from the changing part of a state."""
        self.parts.restore({n: value for n, value in state.items() if not n.startswith(("base.", "config."))})
        self._cache = None

    def restored(self, state: StateDict) -> Learner:
        """A learner with ``state``. Raises ModelFileError where entries are missing or do not fit together."""
        return self.from_state(state)

    @classmethod
    def from_state(cls, state: StateDict) -> Learner:
        """Inverse of ``state_dict``. Raises ModelFileError where entries are missing or do not fit together."""
        with within("base."):
            base = LssvmInverse.from_state(under("base.", state))
        try:
            made = cls(base, LearnerConfig.from_state(under("config.", state)))
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f"learner state: setting missing or damaged: {error}; start from the model") from error
        made.resume(state)
        return made
