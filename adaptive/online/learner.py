"""The learner: samples in, snapshots out. Deterministic, bounded in time and memory, never raises on data.

One sample's way: gates of ``admission``, fixed-lag smoother, hysteresis memory and features at that past instant
(``front``), then two learners of one model. The Kalman filter of ``drift`` follows the linear part; the sliding-window
LSSVM of ``residual`` learns what is left, each new sample in the slot of its nearest neighbour. Each takes the voltage
minus the other's part as its target, so a change is taken up once, and the window's old samples stay true.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import Any

import numpy as np

from adaptive.features import FeatureMap
from adaptive.inverse_model import LssvmInverse
from adaptive.online import gates as admission
from adaptive.online.config import LearnerConfig
from adaptive.online.gates import check_pair
from adaptive.online.learner_parts import RAIL_S, RAIL_SHARE, Parts, model_of, restored, state_of, warm
from adaptive.online.track import Pair
from adaptive.state_codec import prefixed
from adaptive.tuning.adoption import adopt
from adaptive.types import FloatArray, Hyperparameters, InverseModel, OnlineModel, Sample, StateDict, WindowData

# --- What a learner tells of itself: counters, and what a viewer draws.


def counters(learner: Learner) -> dict[str, int]:
    """Samples by outcome, and events. A copy."""
    parts = learner.parts
    drift = parts.filter.state
    events = {
        "restarts": parts.front.restarts,
        "jumps": parts.front.jumps,
        "jumps_undone": parts.front.undone,
        "trials": parts.front.trials,
        **parts.events,
    }
    return {
        **parts.counters,
        **events,
        "filter_updates": drift.updates,
        "bursts": drift.bursts,
        **prefixed("window_", parts.window.counters()),
    }


def diagnostics(learner: Learner) -> dict[str, Any]:
    """Errors in V and in percent of the voltage span, gain and offset, the window's samples.

    ``gain`` is the stage's, relative to the identified model: that of the frame and of the linear part together.
    """
    parts, base = learner.parts, learner.base
    j, front, percent = parts.judgement, parts.front, 100.0 / base.span_V
    estimate = parts.filter.beta
    now, before = estimate[1:], base.beta[1:]
    along = float(now @ before)
    window_y_um, window_v_um_per_s = front.served.motion_of(parts.window.arrays()[0])
    return {
        "error_V": j.error_V,
        "rms_error_pct": float(np.sqrt(j.long_V2)) * percent,
        "recent_rms_error_pct": float(np.sqrt(j.short_V2)) * percent,
        "frozen_rms_error_pct": float(np.sqrt(j.frozen_V2)) * percent,
        "share_within_std": j.inside / max(1, j.judged),
        "gain": front.served.gain * (float(before @ before) / along if along > 0.0 else 1.0),
        "frame_gain": front.served.gain,
        "frame_offset_um": front.served.offset_um,
        "offset_V": float(estimate[0] - base.beta[0]),
        "u_V": front.gates.u_V,
        "std_V": float(np.sqrt(j.variance_V2)),
        "window_samples": float(len(parts.window)),
        "window_residual_V": parts.window.residual_V,
        "window_cholesky": float(parts.window.form == "cholesky"),
        "valid": float(j.valid),
        "fallback": float(j.fallback),
        "frozen": float(learner.frozen),
        "lag_s": front.smoother.config.lag * base.dt_s,
        "window_y_um": window_y_um.tolist(),
        "window_v_um_per_s": window_v_um_per_s.tolist(),
    }


#: Troubles of the model, after which the identified one is served.
RAIL, MODEL_LEFT_ENVELOPE = "rail", "model_left_envelope"


class Learner:
    """Learns one axis online, from an identified model on. Implements ``adaptive.types.OnlineModel``.

    Not for several threads at once: one writer calls ``handle`` and ``snapshot``; snapshots may go anywhere.
    """

    def __init__(self, model: LssvmInverse, config: LearnerConfig | None = None) -> None:
        self._begin(model, config or LearnerConfig(), None)

    def _begin(self, model: LssvmInverse, config: LearnerConfig, parts: Parts | None) -> None:
        self.config = config
        self.base = model
        self.parts = parts or Parts(model, config)
        features = model.features
        self._basis = np.empty(features.basis_size)
        self._frozen_basis, self._frozen_kernel = self._basis.copy(), np.empty(features.kernel_size)
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
        return self.parts.front.gates.seq

    def handle(self, sample: Sample) -> str:
        """Take one sample. Returns "learnt", "passed" (no step was due), or the name of the gate that refused it."""
        outcome = self._handle(sample)
        self.parts.counters[outcome] += 1
        return outcome

    def resync(self) -> None:
        """Forget the sequence: the next sample is taken whatever its number, after the stage itself began anew."""
        self.parts.front.resync()

    def take_place_of(self, other: OnlineModel) -> None:
        """Go on where ``other`` is, with what this one knows: after samples that ``other`` should not have believed.

        Where the stage is and has been ``other`` knows still, and in what frame its readings are.
        """
        if not isinstance(other, Learner):
            self.resync()
            return
        mine, its = self.parts.front, other.parts.front
        if its.track is None:
            self.resync()
            return
        mine.restore(its.state_dict())

    def _handle(self, sample: Sample) -> str:
        parts, front = self.parts, self.parts.front
        front.doubt_V = sqrt(max(parts.judgement.long_V2, parts.judgement.short_V2))
        taken = front.take(sample, self.snapshot)
        if taken.distrusted:
            self._go_on_without_readings(taken.undone)
        elif taken.undone:
            parts.undo_jump()
        if taken.jump_um:
            parts.take_jump(taken.jump_um, fresh=not taken.undone, first=taken.first)
        moved = taken.undone or taken.jump_um or taken.distrusted or taken.renamed
        # An ordinary sample neither begins nor ends a trial.
        if (taken.refused or taken.jump_um) and (parts.watch_trial() or moved):
            self._cache = None
        outcome = taken.refused
        for step in taken.steps:
            pair, switched = front.advance(step)
            if switched:
                parts.expect_change()
            if not taken.refused:
                outcome = admission.SETTLING if pair is None else self._teach(pair)
        return outcome

    def _teach(self, pair: Pair) -> str:
        """Let the pair at the smoother's instant teach filter and window, where it may."""
        c, parts, front = self.config, self.parts, self.parts.front
        gates, track = front.gates, front.track
        assert track is not None
        if min(gates.since_start, gates.since_step) <= c.admission.settle:
            return admission.SETTLING
        if not pair.good:
            return admission.GLITCH
        refused = check_pair(c.admission, pair.u_V, pair.u_before_V, pair.y_um)
        # A saturated sample teaches nothing, but it tells where the stage is, and so whether the model is right.
        if refused and refused != admission.SATURATED:
            return refused
        filter_due, window_due = pair.now % c.filter_every == 0, pair.now % c.learn_every == 0
        if not (filter_due or window_due):
            return refused or admission.PASSED
        motion = (pair.y_um, pair.v_um_per_s, pair.a_um_per_s2)
        track.features.fill(*motion, track.memory, self._basis, parts.point)
        rest = front.rests(pair.y_um)
        a_share = pair.a_um_per_s2 / self.base.features.a_scale_um_per_s2
        weight = c.weights.of(pair.near_bad, front.on_probation, a_share)
        outcome = refused or admission.PASSED
        if filter_due:
            target = pair.u_V - parts.window.mean(parts.point)
            beta = parts.filter.beta
            if not isfinite(target):
                return admission.NUMERICS
            self.base.features.fill(*motion, track.frozen_memory, self._frozen_basis, self._frozen_kernel)
            frozen_V = self.base.mean(self._frozen_basis, self._frozen_kernel)
            served_V = float(self._basis.dot(parts.delay.push(beta)))
            parts.judge(target - served_V, pair.u_V - frozen_V)
            if pair.now % parts.check_every == 0:
                found = self._check(pair, beta, target, frozen_V, bool(refused))
                if found:
                    return found
            if refused:
                self._cache = None
                return refused
            if self._frozen:
                return admission.FROZEN
            if not parts.follow(self._basis, target, pair.u_V, weight, rest):
                return admission.OUTLIER
            outcome = admission.UNEXCITED if rest else admission.LEARNT
        if refused:
            return refused
        if window_due and not rest and not self._frozen and parts.judgement.valid and not front.on_probation:
            outcome = parts.window.learn(parts.point, pair.u_V - float(self._basis.dot(parts.filter.beta)), weight)
            parts.window.fade(c.weights, c.learn_every * self.base.dt_s)
            parts.widen_domain(motion)
        self._cache = None
        return outcome

    def _check(self, pair: Pair, beta: FloatArray, target_V: float, frozen_V: float, saturated: bool) -> str:
        """Now and then: is the model inside its envelope, does the sensor follow? Returns why nothing may be taught."""
        parts, front = self.parts, self.parts.front
        parts.watch_shape(pair.u_V - target_V + float(self._basis.dot(beta)) - float(self._basis.dot(self.base.beta)))
        parts.watch_rail(saturated)
        if saturated or not front.follow(pair, frozen_V, parts.check_s):
            if front.confirmed:
                parts.confirm()
            return ""
        taken = front.distrust(self.snapshot)
        if taken is None:
            return ""
        self._go_on_without_readings(taken.undone)
        return admission.UNTRUSTED

    def _go_on_without_readings(self, undone: bool) -> None:
        """The readings are on trial. ``undone``: and jumps were taken back with them."""
        self.parts.go_back(undone)
        self._cache = None
        self.parts.front.reckon_by(self.snapshot())

    @property
    def trouble(self) -> str:
        """Name of what keeps the learner from learning, "" while nothing does.

        Of the sensor: ``sensor_stuck``, ``sensor_gain``, ``sensor_sign``, ``sensor_foreign``, ``out_of_envelope``.
        ``rail`` : the voltage was at a limit although the model was wrong there. ``model_left_envelope`` : what was
        learnt was further from the identified model than a stage can be. In both the identified model is served.
        """
        parts = self.parts
        return parts.front.fault or (RAIL if parts.railed else MODEL_LEFT_ENVELOPE if parts.left else "")

    @property
    def distrusts(self) -> bool:
        """Whether the readings are on trial: what is served is from before them."""
        return self.parts.front.distrusted_s > 0.0

    @property
    def why(self) -> str:
        """The reason for ``trouble`` in words, with numbers."""
        parts = self.parts
        if parts.front.fault:
            return parts.front.why
        if parts.railed:
            return f"the voltage was at a limit for {RAIL_S} s with the model off by more than {100 * RAIL_SHARE:.0f} %"
        return f"more than {parts.allowed_V:.3g} V from the identified model for {RAIL_S} s" if parts.left else ""

    # ---- snapshots out

    def snapshot(self) -> LssvmInverse:
        """The model as it stands, immutable. The same object while nothing new was learnt."""
        if self._cache is None:
            self._cache = model_of(self.base, self.parts)
        return self._cache

    def memory(self) -> FloatArray:
        """(m,) hysteresis memory as tracked from the measured samples; where a caller without one begins.

        It is of the smoother's instant, ``lag`` samples before ``seq``.
        """
        track = self.parts.front.track
        return self.base.rest_memory(self.base.features.y_rest_um) if track is None else track.memory.copy()

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """(m,) hysteresis memory with which ``model``, a snapshot of this learner, goes on from the last sample.

        What was learnt was learnt with it: one that is tracked otherwise, over readings that were not believed, would
        make the model wrong until the stage has wiped the difference out. None before the first sample.
        ``smoothed`` : from the smoother's instant, ``lag`` samples ago; None while readings are held back.
        """
        front = self.parts.front
        # Of two memories in one frame, that of the learner has seen no reading that was not believed.
        if front.track is None or (smoothed and front.holds) or not isinstance(model, LssvmInverse):
            return None
        frozen = model.features != front.served and model.features == self.base.features
        if smoothed:
            return (front.track.frozen_memory if frozen else front.track.memory).copy()
        return front.memory_now(frozen)

    @property
    def features(self) -> FeatureMap:
        """The feature map that is served."""
        return self.parts.front.served

    def warm(self) -> None:
        """Load (or compile) every step on a copy: no sample that teaches, no change of the stage and no other
        hyper-parameters must wait for one, which takes seconds where it was never compiled before."""
        warm(self.base, self.config)

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

    # ---- hyper-parameters from elsewhere

    @property
    def hyper(self) -> Hyperparameters:
        """Regularisation and kernel widths that the window works with."""
        return self.parts.window.hyper

    def adopt(self, hyper: Hyperparameters) -> str:
        """Go on with other hyper-parameters, from the present sample on. Returns "", or why they were refused.

        Atomic, and without a jump of what is served; refused unless it foretells better. See
        ``adaptive.tuning.adoption``.
        """
        reason = adopt(self.parts, hyper)
        self.parts.events["adoptions_refused" if reason else "adoptions"] += 1
        if not reason:
            self._cache = None
        return reason

    def window_data(self) -> WindowData:
        """A copy of the window's samples and hyper-parameters, to tune on elsewhere; see ``adopt``."""
        return self.parts.window.data()

    def window_samples(self) -> tuple[FloatArray, FloatArray]:
        """(n, d) kernel inputs and (n,) dual weights, V, of the window's samples. Copies."""
        support, alpha, _ = self.parts.window.arrays()
        return support, alpha

    # ---- looking in, and keeping

    def counters(self) -> dict[str, int]:
        """Samples by outcome, and events. A copy."""
        return counters(self)

    def diagnostics(self) -> dict[str, Any]:
        """For a viewer; see ``adaptive.online.learner``."""
        return diagnostics(self)

    def take_events(self) -> list[tuple[str, str]]:
        """None: what happens to a learner shows in ``counters`` and ``trouble``."""
        return []

    def state_dict(self) -> StateDict:
        """All of the state; ``from_state`` goes on from it with the same result to the last bit."""
        return state_of(self.base, self.config, self.parts, self._frozen)

    def restored(self, state: StateDict) -> Learner:
        """A learner with ``state``. Raises ModelFileError where entries are missing or do not fit together."""
        return self.from_state(state)

    @classmethod
    def from_state(cls, state: StateDict) -> Learner:
        """Inverse of ``state_dict``. Raises ModelFileError where entries are missing or do not fit together."""
        made = cls.__new__(cls)
        base, config, parts, frozen = restored(state)
        made._begin(base, config, parts)
        made._frozen = frozen
        return made
