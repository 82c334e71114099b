"""One ordinary sample of each axis, in compiled loops over the axes: intake, then what it teaches.

The rules are the single learner's own functions, on records in place of its dataclasses (`adaptive.compiled.shared`).
What is written here is their order, as in `Intake.take`, `Track.advance` and `Learner.teach`. A sample that is not an
ordinary one changes nothing and is left to a single learner.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Final

import numpy as np

from dehyst.adaptive.compiled import compiled, dot
from dehyst.adaptive.features import FeatureArrays, advance, fill
from dehyst.adaptive.fleet.state import OUTCOMES, Fixed, Rows
from dehyst.adaptive.inverse_model import mean_of, track_memory, unpacked
from dehyst.adaptive.online import gates, intake, learner
from dehyst.adaptive.online.drift import RestCreep, update
from dehyst.adaptive.online.gates import AdmissionState
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED
from dehyst.adaptive.online.kernel_window import NOWHERE, KernelShare
from dehyst.adaptive.online.kernel_window import due as window_due
from dehyst.adaptive.online.learner import Judgement
from dehyst.adaptive.online.sensor_trust import CONFIRMED, STILL_STEPS, Following
from dehyst.adaptive.smoothing import smooth_one
from dehyst.adaptive.types import BoolArray, FloatArray, IntArray

#: In place of an outcome: no sample; the sample is due for learning; it is for a single learner from its intake on, or
#: from what it teaches on.
NO_SAMPLE: Final = -1
TEACHES: Final = -2
DOUBT: Final = -3
ODD: Final = -4

# Compiled code knows methods by plain names only. Fields of a record are read as attributes, as those of the single
# learner's dataclasses, and written as items.
_judge, _is_valid, _falls_back = Judgement.take, Judgement.decide, Judgement.choose
_follow, _rest_shift_um, _leave_rest = Following.take, RestCreep.shift_um, RestCreep.leave
_note_taken, _note_step, _count_again = AdmissionState.take, AdmissionState.step, Following.count_again
_forget_slopes, _weigh = Following.forget_slopes, KernelShare.take
_FROZEN, _OUTLIER, _NUMERICS, _SATURATED, _UNEXCITED, _LEARNT = (
    OUTCOMES.index(name)
    for name in (gates.FROZEN, gates.OUTLIER, gates.NUMERICS, gates.SATURATED, gates.UNEXCITED, gates.LEARNT)
)


#: A sample of an axis, and what is made of it. controls : whether the control trial of the axis may begin now.
#: outcome : of the sample, or a number from above. lets_go, learns : steps that the window is to make, of target_V.
SAMPLE: Final = np.dtype([
    ("seq", np.int64), ("t_s", np.float64), ("u_V", np.float64), ("y_um", np.float64), ("present", np.bool_),
    ("controls", np.bool_), ("outcome", np.int64), ("lets_go", np.bool_), ("learns", np.bool_),
    ("target_V", np.float64),
], align=True)  # fmt: skip


@compiled
def _number_of(outcome: str) -> int:
    for i in range(len(OUTCOMES)):
        if OUTCOMES[i] == outcome:
            return i
    return NO_SAMPLE


@compiled
def _map(c: Fixed, b: int, frames: FloatArray) -> FeatureArrays:
    """The feature map of an axis in a frame."""
    m = c.features
    return FeatureArrays(
        m.thresholds[b], m.arcs[b], m.retain[b], m.scale[b], m.kernel_plays[b], m.flags[b], frames[b],
    )  # fmt: skip


@compiled
def _remember_place(s: Rows, b: int, keep: bool) -> None:
    """The present place becomes the newest known one: after the last, or with ``keep`` in its stead."""
    r, slots, lag = s.numbers[b], s.voltages.shape[1], s.voltages.shape[1] - 2
    at = r.past_count - 1 if keep else min(r.past_count, 1)
    if r.past_count == 2:
        s.pasts[b, 0], s.past_from[b, 0] = s.pasts[b, 1], s.past_from[b, 1]
    past, first = s.pasts[b, at], r.front.track.smoother.count - lag
    past[:3], past[3], past[4 + 2 * lag :] = s.motion[b], s.voltages[b, (first - 1) % slots], s.memory[b]
    for i in range(lag):
        slot = (first + i) % slots
        past[4 + i], past[4 + lag + i] = s.voltages[b, slot], s.readings[b, slot]
    s.past_from[b, at], r["past_count"] = r.past_written, at + 1


@compiled
def _admit(s: Rows, c: Fixed, b: int, sample: Any) -> int:
    """`Intake.take` of an ordinary sample: TEACHES where it may go on, DOUBT, or the gate that refuses it."""
    front, f, a = s.numbers[b].front, c.axis[b], c.config[0].admission
    g, dt_s = front.gates, c.config[0].dt_s
    refused = gates.check_sample(a, g, sample, dt_s)
    if refused == "" and abs(sample.y_um - f.middle_um) > intake.FAR_OUT * f.range_um:
        refused = gates.OUT_OF_RANGE
    if refused != "":
        # A sample in its place whose reading cannot be used advances the place of the single learner.
        y_um, sample["y_um"] = sample.y_um, 0.0
        without = gates.check_sample(a, g, sample, dt_s)
        sample["y_um"] = y_um
        return DOUBT if without == "" else _number_of(refused)
    if sample.seq != g.seq + 1:
        return DOUBT
    gates.watch_voltage(g, sample.u_V)
    _note_taken(g, sample, 1)
    refused = gates.check_repeats(g, sample, f.span_V)
    innovation = (sample.y_um - s.x[b, 0]) / f.range_um
    slope, bend = s.drive_x[b, 1] * c.output_scale[1], s.drive_x[b, 2] * c.output_scale[2]
    known = g.since_start > a.settle and intake.is_known(s.known[b, 0], slope, bend)
    if refused != "" or (known and abs(innovation) > gates.surprise(a, g, f.span_V)):
        return DOUBT
    gates.watch_innovation(a, g, innovation)
    front["until_control"] -= 1
    return DOUBT if known and f.tells and front.until_control <= 0 and sample.controls else TEACHES


@compiled
def _advance(s: Rows, c: Fixed, b: int, u_V: float, y_um: float) -> None:
    """`Intake.advance`: one step of the smoother, and of the hysteresis memory in both frames."""
    r, slots = s.numbers[b], s.voltages.shape[1]
    front, smoother = r.front, r.front.track.smoother
    _note_step(front.gates)
    front["calm"] += 1
    s.past_voltages[b, r.past_written % s.past_voltages.shape[1]] = u_V
    r["past_written"] += 1
    if r.past_count > 0 and r.past_written - s.past_from[b, 0] > MOST_BRIDGED:
        # At rest nothing is checked, and the present place is as good as the past one.
        _remember_place(s, b, True)
    slot, motion = smoother.count % slots, s.motion[b]
    s.readings[b, slot], s.voltages[b, slot], s.good[b, slot] = y_um, u_V, True
    smooth_one(u_V, smoother.count, s.drive_x[b], s.drive_ring[b], c.transition, c.gain, c.lag_gains, motion)
    front.track["smooth_V"] = motion[0]
    s.rates[b, 0], s.rates[b, 1] = motion[1] * c.output_scale[1], motion[2] * c.output_scale[2]
    smooth_one(y_um, smoother.count, s.x[b], s.ring[b], c.transition, c.gain, c.lag_gains, motion)
    smoother["count"] += 1
    for i in range(3):
        motion[i] *= c.output_scale[i]
    advance(motion[0], s.memory[b], _map(c, b, s.frames))
    advance(motion[0], s.frozen_memory[b], _map(c, b, c.features.frame))


@compiled
def _instant(s: Rows, b: int) -> tuple[int, int, bool]:
    """The smoothed instant: its number and slot, and whether its readings are good."""
    slots = s.voltages.shape[1]
    now = s.numbers[b].front.track.smoother.count + 1 - slots
    return now, now % slots, s.good[b, now % slots] and s.good[b, (now - 1) % slots]


@compiled
def take(lo: int, hi: int, axes: IntArray, s: Rows, c: Fixed, w: Any) -> None:
    """Intake of one sample of each of ``axes``, in records as `SAMPLE`; the first gates of what it teaches."""
    config, slots = c.config[0], s.voltages.shape[1]
    for k in range(lo, hi):
        b = axes[k]
        kept, sample = s.numbers[b : b + 1].copy(), w[b]
        sample["outcome"] = _admit(s, c, b, sample)
        if sample.outcome != TEACHES:
            s.numbers[b] = kept[0]
            continue
        _advance(s, c, b, sample.u_V, sample.y_um)
        now, at, good = _instant(s, b)
        motion = s.motion[b]
        refused = gates.check_pair(config.admission, s.voltages[b, at], s.voltages[b, (now - 1) % slots], motion[0])
        if gates.settling(config.admission, s.numbers[b].front.gates):
            refused = gates.SETTLING
        elif not good:
            refused = gates.GLITCH
        if now % config.filter_every != 0 or (refused != "" and refused != gates.SATURATED):
            sample["outcome"] = _number_of(refused if refused != "" else gates.PASSED)
            continue
        fill(motion[0], motion[1], motion[2], s.memory[b], _map(c, b, s.frames), s.basis[b], s.point[b])


@compiled
def teach(lo: int, hi: int, axes: IntArray, kernel_V: FloatArray, s: Rows, c: Fixed, w: Any) -> None:
    """What the samples of ``axes`` teach, all but the steps of the windows; ``kernel_V`` : their predictions, V."""
    config, p, d = c.config[0], s.beta.shape[1], s.point.shape[1]
    basis, kernel, gain, row = np.empty(p), np.empty(d), np.empty(p), np.empty(p)
    for k in range(lo, hi):
        b = axes[k]
        t, r, f, h, motion = w[b], s.numbers[b], c.axis[b], s.basis[b], s.motion[b]
        now, at, _ = _instant(s, b)
        u, before = r.front.track.smooth_V, s.voltages[b, (now - 1) % s.voltages.shape[1]]
        saturated = gates.check_pair(config.admission, s.voltages[b, at], before, motion[0]) != ""
        kept = s.numbers[b : b + 1].copy()
        t["lets_go"] = t["learns"] = False
        t["outcome"] = _SATURATED if saturated else _number_of(gates.PASSED)
        served, count = r.front.track.served, r.front.track.smoother.count
        rests = gates.at_rest(config.admission, r.front.gates, motion[0], count, f.range_um, config.dt_s)
        target = u - r.window.share * kernel_V[k]
        if not isfinite(target):
            t["outcome"] = _NUMERICS
            continue
        fill(motion[0], motion[1], motion[2], s.frozen_memory[b], _map(c, b, c.features.frame), basis, kernel)
        _, beta, inverse_widths, alpha, scaled, _ = unpacked(c.models[f.model], c.sizes[f.model])
        frozen_V = mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)
        if _finds_fault(s, c, b, h, target, u, frozen_V, saturated, now % config.check_every == 0):
            s.numbers[b] = kept[0]
            t["outcome"] = ODD
            continue
        if saturated:
            continue
        if r.frozen:
            t["outcome"] = _FROZEN
            continue
        left_V = u - dot(h, s.beta[b], p)
        said = update(
            config.drift, r.filter, s.beta[b], s.covariance[b], c.walks[b], c.bursts[b], f.span_V, config.step_s, h,
            target, not rests, gain, row,
        )  # fmt: skip
        if said == "outlier":
            t["outcome"] = _OUTLIER
            continue
        if said == "burst":
            r.window["changed"], r.window["next"] = r.window.clock, 0
        t["lets_go"] = r.judgement.valid and r.window.next != NOWHERE
        if rests:
            shift_um = _rest_shift_um(r.rest, s.beta[b, 0], u, f.span_V, f.range_um, config.step_s, config.creep_s)
            served["offset_um"] += shift_um
            s.frames[b, 0] = served.offset_um
        else:
            _leave_rest(r.rest)
            _weigh(r.window, kernel_V[k], left_V, config.step_s)
        t["outcome"] = _UNEXCITED if rests else _LEARNT
        if not rests and r.judgement.valid:
            for i in range(2):
                s.known[b, 2, i] = max(s.known[b, 2, i], abs(s.rates[b, i]))
            for i in range(3):
                s.domain[b, 2 * i] = min(s.domain[b, 2 * i], motion[i])
                s.domain[b, 2 * i + 1] = max(s.domain[b, 2 * i + 1], motion[i])
        if not rests and window_due(now // config.filter_every, config.window_every):
            t["learns"], t["target_V"] = True, u - dot(h, s.beta[b], p)


@compiled
def _finds_fault(
    s: Rows, c: Fixed, b: int, h: FloatArray, target: float, u: float, frozen_V: float, saturated: bool, checks: bool
) -> bool:
    """Errors of the models as they were served, all checks, and marks (`Parts.judge`, `Learner._check`).

    True where the learner has to return to an earlier estimate, to the identified model, or to a trial of the sensor.
    """
    r, f, config, p = s.numbers[b], c.axis[b], c.config[0], h.size
    j, span_V, size = r.judgement, f.span_V, s.delay.shape[1]
    s.delay[b, r.delay_count % size] = s.beta[b]
    r["delay_count"] += 1
    served_V = dot(h, s.delay[b, max(r.delay_count - size + 1, 0) % size], p)
    _judge(j, target - served_V, u - frozen_V, config.step_s)
    _is_valid(j, config.valid_enter * span_V, config.valid_leave * span_V)
    before = j.fallback
    r.events["fallbacks"] += _falls_back(j, config.fallback_floor * span_V, config.step_s) and not before
    fault = j.fallen_s > learner.ROLLBACK_S
    confirmed = places = False
    if checks and f.tells and not saturated:
        follows, fastest_V_per_s = r.front.following, config.envelope.drift_per_s * f.drive_V
        known = intake.is_known(s.known[b, 0], s.rates[b, 0], s.rates[b, 1])
        judges = known and r.front.credit > 0
        p_V = u - target + dot(h, s.references[b, 0], p)
        odd = _follow(follows, u, p_V, f.drive_V, config.check_s, fastest_V_per_s)
        if not known:
            _forget_slopes(follows)
        fault = fault or (odd and judges) or follows.still >= STILL_STEPS
        confirmed = judges and (follows.good >= CONFIRMED or r.past_count == 0)
        # `Intake.follow`: a model that may not judge confirms nothing, but notes where the readings have moved.
        places = confirmed or (not judges and follows.steps == 0 and follows.still == 0)
    if fault:
        return True
    # A good estimate becomes the next mark, and the next reference; see `Parts.judge`.
    good = j.short_V2 < (0.5 * config.valid_enter * span_V) ** 2
    if good and j.judged % config.mark_every == 0:
        s.marks[b, 0] = s.marks[b, 1]
        s.marks[b, 1, 0], s.marks[b, 1, 1:] = s.beta[b], s.covariance[b]
    if good and j.judged % config.reference_every == 0:
        s.references[b, 0], s.references[b, 1] = s.references[b, 1], s.beta[b]
        s.known[b, 0], s.known[b, 1] = s.known[b, 1], s.known[b, 2]
    if places:
        if confirmed:
            _count_again(r.front.following)
        _remember_place(s, b, False)
    return False


@compiled
def memory_now(s: Rows, c: Fixed, frozen: BoolArray, out: FloatArray) -> None:
    """(B, m) memory at the last reading: the smoothed one, carried along the readings since; see `Track.memory_now`."""
    slots, lag = s.readings.shape[1], s.readings.shape[1] - 2
    readings = np.empty(lag)
    for b in range(out.shape[0]):
        for i in range(lag):
            readings[i] = s.readings[b, (s.numbers[b].front.track.smoother.count - lag + i) % slots]
        out[b] = s.frozen_memory[b] if frozen[b] else s.memory[b]
        track_memory(readings, out[b], _map(c, b, c.features.frame if frozen[b] else s.frames))
