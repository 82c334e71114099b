"""The learner: samples in, snapshots out. Deterministic, bounded in time and memory, never raises on data.

One sample's way: gates of ``admission``, fixed-lag smoother, hysteresis memory and features at that past instant,
then two learners of one model. The Kalman filter of ``drift`` follows the linear part; the sliding-window LSSVM of
``residual`` learns what is left, each new sample in the slot of its nearest neighbour. Each takes the voltage minus
the other's part as its target, so a change is taken up once, and the window's old samples stay true. A jump of the
reading that no voltage made moves the frame of the features, and with it everything that was learnt.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adaptive import admission
from adaptive.admission import AdmissionState, check_pair, check_reading, check_sample, new_counters, watch_voltage
from adaptive.drift import DriftFilter
from adaptive.errors import InputError, ModelFileError
from adaptive.features import FeatureMap
from adaptive.judgement import Delay, Judgement
from adaptive.learner_config import LearnerConfig, part_of
from adaptive.residual import ResidualWindow
from adaptive.smoothing import FixedLagSmoother, SmootherState
from adaptive.snapshot import LssvmInverse
from adaptive.types import FloatArray, Sample, StateDict

__all__ = ["Learner", "LearnerConfig"]

#: A jump of place that scales the displacement by less than this, or more than its inverse, is taken for an offset.
JUMP_RATIO = 0.85
#: A reading that surprises the smoother by more than this share of the range may be the first of a jump.
SURPRISE_SHARE = 0.002
#: Share of a jump by which it may be wrong to take it for a gain and not an offset, or the other way round.
JUMP_DOUBT = 0.3
#: A reading further from the middle of the identified range than this many ranges is none, however long it lasts.
FAR_OUT = 1.5
#: The filter goes back to its last good estimate after losing to the frozen model for this long, s; while all is
#: well, its estimate is marked this often, s.
ROLLBACK_S, MARK_S = 0.5, 1.0


def _mark(values: StateDict) -> tuple[FloatArray, FloatArray]:
    """A mark of the drift filter from its entries."""
    return np.array(values["beta"], dtype=np.float64), np.array(values["covariance"], dtype=np.float64)


class Learner:
    """Learns one axis online, from an identified model on. Implements ``adaptive.types.OnlineModel``.

    Not for several threads at once: one writer calls ``handle`` and ``snapshot``; snapshots may go anywhere.
    """

    def __init__(self, model: LssvmInverse, config: LearnerConfig | None = None) -> None:
        self.config = config or LearnerConfig()
        self.base = model
        self._dt = model.dt_s
        self._range_um = model.features.y_max_um - model.features.y_min_um
        self._middle_um = 0.5 * (model.features.y_max_um + model.features.y_min_um)
        self._admission = self.config.admission.at(self._dt)
        self._smoother = FixedLagSmoother(self.config.smoother(self._dt))
        slots = self._smoother.config.lag + 2
        self._u, self._good = np.zeros(slots), np.zeros(slots, dtype=np.bool_)
        self._state: SmootherState | None = None
        # The smoother before the first reading that surprised it: where a jump, once it is known for one, began.
        self._calm: SmootherState | None = None
        self._gates = AdmissionState()
        # Features of the instant that is being learnt, and those to serve with: they differ for a lag after a jump.
        self._features = self._served = model.features
        self._memory: FloatArray | None = None
        # The frozen model lives in its own frame: it knows of no jump.
        self._frozen_memory = np.empty(0)
        p = self._features.basis_size
        covariance = model.beta_covariance if model.beta_covariance.size else (0.01 * model.span_V) ** 2 * np.eye(p)
        step_s = self.config.filter_every * self._dt
        self._filter = DriftFilter(self.config.drift, model.beta, covariance, step_s, model.span_V)
        self._window = ResidualWindow.from_model(model, self.config.window, self.config.eviction)
        # The mark before the last one: the last may already hold some of what went wrong.
        self._mark = self._next_mark = self._filter.mark()
        self._domain = model.domain.copy()
        self._basis, self._kernel = np.empty(p), np.empty(self._features.kernel_size)
        self._frozen_basis, self._frozen_kernel = self._basis.copy(), self._kernel.copy()
        start_V2 = max(model.noise_variance, (1e-4 * model.span_V) ** 2)
        self._judgement = Judgement(start_V2, start_V2, start_V2, start_V2)
        self._delay = Delay(round(self.config.serving_age_s / step_s))
        self._counters = new_counters()
        self._events = {"restarts": 0, "jumps": 0, "fallbacks": 0, "rollbacks": 0}
        self._frozen = False
        self._cache: LssvmInverse | None = None

    @classmethod
    def from_model(cls, model: LssvmInverse, config: LearnerConfig | None = None) -> Learner:
        """A learner that starts from an identified model."""
        return cls(model, config)

    # ---- samples in

    @property
    def seq(self) -> int:
        """Sequence number of the last sample taken, -1 before any."""
        return self._gates.seq

    def handle(self, sample: Sample) -> str:
        """Take one sample. Returns "learnt", "passed" (no step was due), or the name of the gate that refused it."""
        outcome = self._handle(sample)
        self._counters[outcome] += 1
        return outcome

    def resync(self) -> None:
        """Forget the sequence: the next sample is taken whatever its number, after the stage itself began anew."""
        self._gates = AdmissionState()
        self._state = self._calm = None

    def _handle(self, sample: Sample) -> str:
        c, gates = self._admission, self._gates
        refused = check_sample(c, gates, sample, self._dt)
        if refused:
            return refused
        if abs(sample.y_um - self._middle_um) > FAR_OUT * self._range_um:
            return admission.OUT_OF_RANGE
        missing = sample.seq - gates.seq - 1 if gates.seq >= 0 else 0
        gates.seq, gates.t_s = sample.seq, sample.t_s
        watch_voltage(c, gates, sample.u_V, self.base.span_V)
        if self._state is None or missing > c.max_gap:
            self._restart(sample)
            return admission.GAP if missing else admission.SETTLING
        for _ in range(missing):
            self._advance(None, 0.0)
        innovation = (sample.y_um - float(self._state.x[0])) / self._range_um
        refused = check_reading(c, gates, innovation)
        if refused == admission.GAP:
            if gates.since_jump <= c.settle:
                self._restart(sample)
                return admission.GAP
            self._forget_surprise()
            self._take_jump(sample.y_um)
        elif refused:
            self._advance(None, sample.u_V)
            return refused
        elif abs(innovation) <= SURPRISE_SHARE:
            self._calm = self._state.copy()
        motion = self._advance(sample.y_um, sample.u_V)
        return admission.SETTLING if motion is None else self._teach(*motion)

    def _restart(self, sample: Sample) -> None:
        """Begin smoothing anew at a sample; the hysteresis memory follows to where the stage now is."""
        self._state, self._calm = self._smoother.initial_state(sample.y_um), None
        self._gates.since_start = self._gates.since_jump = 0
        self._gates.moved = 0
        self._features = self._served
        if self._memory is None:
            self._memory = self._features.rest_memory(sample.y_um)
            self._frozen_memory = self.base.rest_memory(sample.y_um)
        self._good[:] = False
        self._events["restarts"] += 1
        self._advance(sample.y_um, sample.u_V)

    def _forget_surprise(self) -> None:
        """Take the smoother back to before the jump's first readings, and on from there on its own prediction.

        The first may have been too small for a glitch; taken for motion, it throws velocity and acceleration off,
        and the place that the next readings are compared with.
        """
        calm, state, slots = self._calm, self._state, self._u.shape[0]
        assert state is not None
        if calm is None or state.count - calm.count > self._smoother.config.lag:
            return
        # What the smoother held before the last calm reading goes on through that reading's own prediction.
        while calm.count < state.count:
            self._good[calm.count % slots] = False
            self._smoother.skip(calm)
        self._state, self._calm = calm, None

    def _take_jump(self, y_um: float) -> None:
        """The reading has jumped for good: place and frame move, velocity and acceleration go on.

        No voltage made this jump, so it is none of the hysteresis'. One jump can't tell a gain from an offset; a
        gain is the likelier where there is displacement to scale. What is wrong about it the filter finds as the
        stage moves.
        """
        assert self._state is not None
        f, before = self._served, float(self._state.x[0])
        ratio = (y_um - f.offset_um) / (before - f.offset_um) if before != f.offset_um else 0.0
        if JUMP_RATIO < ratio < 1.0 / JUMP_RATIO:
            self._served = replace(f, gain=f.gain * ratio)
        else:
            self._served = replace(f, offset_um=f.offset_um + y_um - before)
        self._judgement.doubt_V2 += (JUMP_DOUBT * (y_um - before) / self._range_um * self.base.span_V) ** 2
        self._state.x[0] = y_um
        self._gates.since_jump = 0
        self._cache = None
        self._events["jumps"] += 1

    def _advance(self, y_um: float | None, u_V: float) -> tuple[float, float, float] | None:
        """One step of smoother and hysteresis memory; ``y_um`` None where there is no (good) reading."""
        assert self._state is not None
        assert self._memory is not None
        slot = self._state.count % self._u.shape[0]
        self._u[slot], self._good[slot] = u_V, y_um is not None
        motion = self._smoother.skip(self._state) if y_um is None else self._smoother.step(self._state, y_um)
        self._gates.since_start += 1
        self._gates.since_jump += 1
        if motion is not None:
            if self._features is not self._served and self._gates.since_jump > self._smoother.config.lag:
                self._features = self._served
                self._filter.expect_change()
            self._features.advance(motion[0], self._memory)
            self.base.features.advance(motion[0], self._frozen_memory)
        return motion

    # ---- what they teach

    def _teach(self, y: float, v: float, a: float) -> str:
        """Let the pair at the smoother's instant teach filter and window, where it may."""
        c, gates, slots = self.config, self._gates, self._u.shape[0]
        assert self._state is not None
        assert self._memory is not None
        now = self._state.count - 1 - self._smoother.config.lag
        u, before = float(self._u[now % slots]), float(self._u[(now - 1) % slots])
        if min(gates.since_start, gates.since_step) <= c.admission.settle:
            return admission.SETTLING
        if not (self._good[now % slots] and self._good[(now - 1) % slots]):
            return admission.GLITCH
        refused = check_pair(c.admission, u, before, y)
        if refused:
            return refused
        filter_due, window_due = now % c.filter_every == 0, now % c.learn_every == 0
        if not (filter_due or window_due):
            return admission.PASSED
        self._features.fill(y, v, a, self._memory, self._basis, self._kernel)
        # By place and not by speed: speed is noisy, and a slow scan is no rest, nor is a turning point.
        if abs(y - gates.anchor_um) > c.admission.rest_share * self._range_um:
            gates.anchor_um, gates.moved = y, self._state.count
        rest = (self._state.count - gates.moved) * self._dt > c.admission.rest_s
        outcome = admission.PASSED
        if filter_due:
            target = u - self._window.mean(self._kernel)
            beta = self._filter.beta
            if not np.isfinite(target):
                return admission.NUMERICS
            self._judge(target, u, beta, (y, v, a))
            if self._frozen:
                return admission.FROZEN
            if self._filter.update(self._basis, target, not rest) == "outlier":
                return admission.OUTLIER
            outcome = admission.UNEXCITED if rest else admission.LEARNT
        if window_due and not rest and not self._frozen and self._judgement.valid:
            outcome = self._window.learn(self._kernel, u - float(self._basis @ self._filter.beta))
            for i, x in enumerate((y, v, a)):
                self._domain[2 * i] = min(self._domain[2 * i], x)
                self._domain[2 * i + 1] = max(self._domain[2 * i + 1], x)
        self._cache = None
        return outcome

    def _judge(self, target_V: float, u_V: float, beta: FloatArray, motion: tuple[float, float, float]) -> None:
        """Error of the linear part as it was served for this instant, and of the model it all started from."""
        c, span = self.config, self.base.span_V
        error = target_V - float(self._basis @ self._delay.push(beta))
        self.base.features.fill(*motion, self._frozen_memory, self._frozen_basis, self._frozen_kernel)
        frozen_error = u_V - self.base.mean(self._frozen_basis, self._frozen_kernel)
        self._judgement.take(error, frozen_error, self._filter.step_s)
        self._judgement.decide(c.valid_enter * span, c.valid_leave * span)
        before, step_s = self._judgement.fallback, self._filter.step_s
        self._events["fallbacks"] += self._judgement.choose(c.fallback_floor * span, step_s) and not before
        if self._judgement.fallen_s > ROLLBACK_S:
            # Half a second of losing to the frozen model: what was learnt since all was well is wrong.
            self._judgement.fallen_s = 0.0
            self._filter.go_back(self._mark)
            self._events["rollbacks"] += 1
        elif (
            self._judgement.judged % round(MARK_S / step_s) == 0
            and self._judgement.short_V2 < (0.5 * c.valid_enter * span) ** 2
        ):
            self._mark, self._next_mark = self._next_mark, self._filter.mark()

    # ---- snapshots out

    def snapshot(self) -> LssvmInverse:
        """The model as it stands, immutable. The same object while nothing new was learnt."""
        if self._cache is None and self._judgement.fallback:
            self._cache = replace(
                self.base, noise_variance=self._judgement.frozen_short_V2, seq=self.seq, valid=self._judgement.valid
            )
        elif self._cache is None:
            support, alpha, bias = self._window.arrays()
            beta = self._filter.beta
            beta[0] += bias
            self._cache = replace(
                self.base,
                features=self._served,
                beta=beta,
                support=support,
                alpha=alpha,
                domain=self._domain,
                noise_variance=self._judgement.variance_V2,
                beta_covariance=np.empty((0, 0)),
                seq=self.seq,
                valid=self._judgement.valid,
            )
        return self._cache

    def memory(self) -> FloatArray:
        """(m,) hysteresis memory as tracked from the measured samples; where a caller without one begins.

        It is of the smoother's instant, ``lag`` samples before ``seq``.
        """
        if self._memory is None:
            return self.base.rest_memory(self.base.features.y_rest_um)
        return self._memory.copy()

    @property
    def features(self) -> FeatureMap:
        """The feature map that is served."""
        return self._served

    def warm_window(self) -> None:
        """Load (or compile) the window's steps on a copy: the first sample that teaches must not wait for them."""
        capacity = self.config.window
        window = ResidualWindow.from_model(self.base, capacity, self.config.eviction)
        if len(window) < capacity:
            window.learn(10.0 + np.zeros(self.base.features.kernel_size), 0.0)
        window.learn(window.arrays()[0][0], 0.0)

    def freeze(self) -> None:
        """Stop learning: samples go on moving smoother and memory, and are judged, but teach nothing."""
        self._frozen = True

    def thaw(self) -> None:
        """Learn again."""
        self._frozen = False

    @property
    def frozen(self) -> bool:
        """Whether learning is stopped."""
        return self._frozen

    # ---- looking in

    def counters(self) -> dict[str, int]:
        """Samples by outcome, and events. A copy."""
        drift = self._filter.state
        return {
            **self._counters,
            **self._events,
            "filter_updates": drift.updates,
            "bursts": drift.bursts,
            **{f"window_{name}": value for name, value in self._window.counters().items()},
        }

    def diagnostics(self) -> dict[str, Any]:
        """For a viewer: errors in V and in percent of the voltage span, gain and offset, the window's samples.

        ``gain`` is the stage's, relative to the identified model: that of the frame and of the linear part together.
        """
        j, percent = self._judgement, 100.0 / self.base.span_V
        now, before = self._filter.beta[1:], self.base.beta[1:]
        along = float(now @ before)
        window_y_um, window_v_um_per_s = self._features.motion_of(self._window.arrays()[0])
        return {
            "error_V": j.error_V,
            "rms_error_pct": float(np.sqrt(j.long_V2)) * percent,
            "recent_rms_error_pct": float(np.sqrt(j.short_V2)) * percent,
            "frozen_rms_error_pct": float(np.sqrt(j.frozen_V2)) * percent,
            "share_within_std": j.inside / max(1, j.judged),
            "gain": self._served.gain * (float(before @ before) / along if along > 0.0 else 1.0),
            "frame_gain": self._served.gain,
            "frame_offset_um": self._served.offset_um,
            "offset_V": float(self._filter.beta[0] - self.base.beta[0]),
            "u_V": self._gates.u_V,
            "std_V": float(np.sqrt(j.variance_V2)),
            "window_samples": float(len(self._window)),
            "window_residual_V": self._window.residual_V,
            "valid": float(j.valid),
            "fallback": float(j.fallback),
            "frozen": float(self._frozen),
            "lag_s": self._smoother.config.lag * self._dt,
            "window_y_um": window_y_um.tolist(),
            "window_v_um_per_s": window_v_um_per_s.tolist(),
        }

    def window_samples(self) -> tuple[FloatArray, FloatArray]:
        """(n, d) kernel inputs and (n,) dual weights, V, of the window's samples. Copies."""
        support, alpha, _ = self._window.arrays()
        return support, alpha

    # ---- keeping

    def state_dict(self) -> StateDict:
        """All of the state; ``from_state`` goes on from it with the same result to the last bit."""
        state: StateDict = {f"base.{k}": v for k, v in self.base.state_dict().items()}
        parts = {
            "gates": self._gates.state_dict(),
            "features": self._features.state_dict(),
            "served": self._served.state_dict(),
            "filter": self._filter.state_dict(),
            "window": self._window.state_dict(),
            "judgement": self._judgement.state_dict(),
            "counters": dict(self._counters),
            "events": dict(self._events),
            "config": self.config.state_dict(),
        }
        for part, smoother in (("smoother", self._state), ("calm", self._calm)):
            if smoother is not None:
                parts[part] = self._smoother.state_dict(smoother)
        for part, values in parts.items():
            state |= {f"{part}.{key}": value for key, value in values.items()}
        state |= {"u": self._u.copy(), "good": self._good.copy(), "domain": self._domain.copy()}
        state |= {"delay": self._delay.array(), "frozen": self._frozen}
        for name, mark in (("mark", self._mark), ("next_mark", self._next_mark)):
            state |= {f"{name}.beta": mark[0].copy(), f"{name}.covariance": mark[1].copy()}
        if self._memory is not None:
            state |= {"memory": self._memory.copy(), "frozen_memory": self._frozen_memory.copy()}
        return state

    @classmethod
    def from_state(cls, state: StateDict) -> Learner:
        """Inverse of ``state_dict``. Raises ModelFileError where entries are missing or do not fit together."""
        try:
            made = cls(
                LssvmInverse.from_state(part_of(state, "base")), LearnerConfig.from_state(part_of(state, "config"))
            )
            u = np.array(state["u"], dtype=np.float64)
            if u.shape != made._u.shape:
                raise InputError(f"u: got {u.shape[0]} slots, expected {made._u.shape[0]}; the smoother's lag differs")
            made._u, made._good = u, np.array(state["good"], dtype=np.bool_)
            made._gates = AdmissionState.from_state(part_of(state, "gates"))
            made._served = FeatureMap.from_state(part_of(state, "served"))
            features = FeatureMap.from_state(part_of(state, "features"))
            made._features = made._served if features == made._served else features
            made._filter = DriftFilter.from_state(
                made.config.drift, made._filter.step_s, made.base.span_V, part_of(state, "filter")
            )
            made._window.restore(part_of(state, "window"))
            made._judgement = Judgement.from_state(part_of(state, "judgement"))
            made._counters |= {key: int(value) for key, value in part_of(state, "counters").items()}
            made._events |= {key: int(value) for key, value in part_of(state, "events").items()}
            smoother = part_of(state, "smoother")
            made._state = made._smoother.from_state(smoother) if smoother else None
            calm = part_of(state, "calm")
            made._calm = made._smoother.from_state(calm) if calm else None
            if "memory" in state:
                made._memory = np.array(state["memory"], dtype=np.float64)
                made._frozen_memory = np.array(state["frozen_memory"], dtype=np.float64)
            made._domain = np.array(state["domain"], dtype=np.float64)
            made._delay.restore(np.asarray(state["delay"], dtype=np.float64))
            made._frozen = bool(state["frozen"])
            made._mark, made._next_mark = (_mark(part_of(state, name)) for name in ("mark", "next_mark"))
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(
                f"learner state: entry missing or damaged: {error}; start from the model instead"
            ) from error
        return made
