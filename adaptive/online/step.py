"""The order of a sample, compiled, for one axis or many: intake, smoother, errors, checks, filter, window.

A sample goes through stages. What is ordinary is here. Where a sample needs what is rare, the order stops at a stage
of its own, `adaptive.online.learner` does that in Python on the same state, and the order goes on from there. The rules
are functions of the modules that declare their state.
"""

from __future__ import annotations

from math import isfinite, nan
from typing import Any, Final

import numpy as np

from dehyst.adaptive.compiled import compiled, dot
from dehyst.adaptive.features import FeatureArrays, advance, fill
from dehyst.adaptive.inverse_model import mean_of, unpacked
from dehyst.adaptive.online import gates
from dehyst.adaptive.online import kernel_window as window
from dehyst.adaptive.online.drift import RestCreep, expect_change, update
from dehyst.adaptive.online.gates import OUTCOMES, AdmissionState, Judgement
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED
from dehyst.adaptive.online.intake import FAR_OUT, is_known
from dehyst.adaptive.online.kernel_window import KernelShare
from dehyst.adaptive.online.row import Row, row_of
from dehyst.adaptive.online.sensor_trust import CONFIRMED, STILL_STEPS, Following
from dehyst.adaptive.smoothing import smooth_one
from dehyst.adaptive.types import BoolArray, FloatArray, IntArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import WindowArrays, arrays_of

#: The filter returns to its last good estimate after the frozen model was better for this long, s; a good estimate is
#: marked this often, s. The readings are judged by one that is older, between one and two such times: a newer one has
#: already taken in a part of what has begun to go wrong.
ROLLBACK_S, MARK_S, REFERENCE_S = 0.5, 0.1, 1.0

# --- The stages.

#: Stages of a sample, in order. ADVANCE takes the voltage and reading of one step of the smoother.
TAKE, ADVANCE, TEACH, PREDICT, JUDGE, CHECK, LEARN, WINDOW, DONE = range(9)
#: Stages in Python: the sample is on trial; is the first one, or comes after a gap; is held back; a control trial
#: judges it; the smoother has advanced beside something rare; the identified model has been better for long; the
#: readings do not follow the drive; motion from before a jump cannot be compared; the window is healing, or has to.
TRIED, GAPPED, HELD, CONTROLLED, ADVANCED, ROLLED_BACK, DISTRUSTED, FORGET, HEALING, ILL = range(16, 26)

#: The sample of an axis, and what is made of it. present : in a fleet. checks : whether a control trial may begin.
#: stage, outcome : where it is, and its number in ``OUTCOMES``. refused : the gate of its reading, -1 for none.
#: missing, before_V : samples that are missing before it, and the voltage before them. limit : of a surprise, ranges.
#: good, teaches : of a step. rare : whether Python has had it. due : whether it was due for learning. heals : of the
#: window.
SAMPLE: Final = np.dtype([
    ("seq", np.int64), ("t_s", np.float64), ("u_V", np.float64), ("y_um", np.float64), ("present", np.bool_),
    ("checks", np.bool_), ("stage", np.int64), ("outcome", np.int64), ("refused", np.int64), ("missing", np.int64),
    ("before_V", np.float64), ("limit", np.float64), ("good", np.bool_), ("teaches", np.bool_), ("rare", np.bool_),
    ("due", np.bool_), ("saturated", np.bool_), ("rests", np.bool_), ("kernel_V", np.float64),
    ("target_V", np.float64), ("heals", np.bool_),
], align=True)  # fmt: skip

# Compiled code knows methods by plain names only. Fields of a record are read as attributes and written as items.
_judge, _is_valid, _falls_back = Judgement.take, Judgement.decide, Judgement.choose
_follow, _rest_shift_um, _leave_rest = Following.take, RestCreep.shift_um, RestCreep.leave
_note_taken, _note_step, _count_again = AdmissionState.take, AdmissionState.step, Following.count_again
_forget_slopes, _weigh = Following.forget_slopes, KernelShare.take


@compiled
def _number_of(outcome: str) -> int:
    for i in range(len(OUTCOMES)):
        if OUTCOMES[i] == outcome:
            return i
    return -1


@compiled
def _end(r: Any, outcome: str) -> int:
    r.sample["outcome"] = _number_of(outcome)
    return DONE


@compiled
def _map(m: FeatureArrays, frame: FloatArray) -> FeatureArrays:
    """A feature map in another frame."""
    return FeatureArrays(m.thresholds, m.arcs, m.retain, m.scale, m.kernel_plays, m.flags, frame)


# --- Intake.


@compiled
def _refusal(r: Any, c: Any) -> str:
    """The gate that refuses a sample for what it is, or ""."""
    t, f = r.sample, r.fixed
    refused = gates.check_sample(c.admission, r.intake.gates, t, c.dt_s)
    if refused == "" and t.seq <= r.intake.reckoned_seq:
        # A sample without a reading has come in its place already, or in that of a later one.
        refused = gates.DUPLICATE if t.seq == r.intake.reckoned_seq else gates.OUT_OF_ORDER
    if refused == "" and abs(t.y_um - f.middle_um) > FAR_OUT * f.range_um:
        refused = gates.OUT_OF_RANGE
    return refused


@compiled
def _take(A: Row, r: Any, c: Any) -> int:
    """Judge a sample, and note it."""
    t, front, f, a = r.sample, r.intake, r.fixed, c.admission
    g = front.gates
    t["rare"], t["due"], t["good"], t["teaches"] = False, False, True, True
    refused = _refusal(r, c)
    if refused != "":
        t["y_um"] = f.middle_um
        if g.seq < 0 or _refusal(r, c) != "":
            return _end(r, refused)
        # Only the reading is wrong. The stage moves all the same: the sample is one without a reading.
        t["y_um"] = nan
    missing = t.seq - front.reckoned_seq - 1 if g.seq >= 0 else 0
    before_V = g.u_V
    slope_V = (t.u_V - before_V) / (missing + 1)
    for i in range(min(missing, MOST_BRIDGED)):
        gates.watch_voltage(g, before_V + slope_V * (i + 1))
    gates.watch_voltage(g, t.u_V)
    if refused == "":
        _note_taken(g, t, t.seq - g.seq if g.seq >= 0 else 1)
    front["reckoned_seq"] = t.seq
    t["missing"], t["before_V"] = missing, before_V
    if not front.trial and refused == "":
        refused = gates.check_repeats(g, t, f.span_V)
    t["refused"] = _number_of(refused)
    if front.trial:
        return TRIED
    moves = front.track.count > c.lag
    if not front.track.begun or front.lost or missing > a.max_gap or ((missing > 0 or refused != "") and not moves):
        if refused != "":
            front["lost"] = True
            return _end(r, refused)
        return GAPPED
    if refused != "":
        return HELD
    innovation = (t.y_um - A.x[0]) / f.range_um
    slope, bend = A.drive_x[1] * A.scale[1], A.drive_x[2] * A.scale[2]
    known = moves and g.since_start > a.settle and is_known(A.known[0], slope, bend)
    limit = gates.surprise(a, g, f.span_V)
    # Held readings count too, except while they ring: an error that repeats becomes the usual error.
    if not (front.hold and front.rings):
        gates.watch_innovation(a, g, innovation)
    if front.hold or missing > 0 or (known and abs(innovation) > limit):
        # Dead reckoning knows the motion that a kink of the voltage causes; only the smoother does not.
        t["limit"] = limit - gates.KINK_SHARE * g.kink_V / f.span_V
        return HELD
    front["until_control"] -= 1
    begins = front.until_control <= 0 and t.checks and f.tells
    return CONTROLLED if known and not front.missing and (front.control or begins) else ADVANCE


# --- The track.


@compiled
def remember_place(A: Row, r: Any, c: Any, at: int) -> None:
    """The present place becomes the newest known one, number ``at``; of two, the older one goes."""
    front, lag, slots = r.intake, c.lag, A.voltages.shape[0]
    if front.past_count == 2:
        A.past_motion[0], A.past_V[0], A.past_um[0] = A.past_motion[1], A.past_V[1], A.past_um[1]
        A.past_memory[0], A.past_from[0] = A.past_memory[1], A.past_from[1]
    first = front.track.count - lag
    A.past_motion[at, :3], A.past_motion[at, 3], A.past_memory[at] = A.motion, A.voltages[(first - 1) % slots], A.memory
    for i in range(lag):
        A.past_V[at, i], A.past_um[at, i] = A.voltages[(first + i) % slots], A.readings[(first + i) % slots]
    A.past_from[at], front["past_count"] = front.past_written, at + 1


@compiled
def _advance(A: Row, r: Any, c: Any) -> int:
    """One step of the smoother, and of the hysteresis memory in both frames."""
    t, front = r.sample, r.intake
    track, slots = front.track, A.voltages.shape[0]
    _note_step(front.gates)
    front["calm"] += 1
    A.past_ring[front.past_written % A.past_ring.shape[0]] = t.u_V
    front["past_written"] += 1
    if front.past_count > 0 and front.past_written - A.past_from[0] > MOST_BRIDGED:
        # At rest nothing is checked, and the present place is as good as the past one.
        if track.count > c.lag:
            remember_place(A, r, c, front.past_count - 1)
        else:
            front["past_count"] = 0
    slot = track.count % slots
    A.readings[slot], A.voltages[slot], A.good[slot] = t.y_um, t.u_V, t.good
    if track.count == 0:
        A.drive_x[0] = t.u_V
    motion = A.motion
    smooth_one(t.u_V, track.count, A.drive_x, A.drive_ring, A.transition, A.gain, A.lag_gains, motion)
    smooth_V, A.rates[0], A.rates[1] = motion[0], motion[1] * A.scale[1], motion[2] * A.scale[2]
    smooth_one(t.y_um, track.count, A.x, A.ring, A.transition, A.gain, A.lag_gains, motion)
    track["count"] += 1
    rare = front.trial or front.proven_past or front.missing
    if track.count > c.lag:
        track["smooth_V"] = smooth_V
        motion[1] *= A.scale[1]
        motion[2] *= A.scale[2]
        m = unpacked(A.model, A.sizes)[0]
        if track.jumps and track.count > track.switch:
            A.frames[0], track["jumps"] = A.frames[1], False
            expect_change(c.drift, r.filter.state, A.beta, A.covariance, A.bursts)
        advance(motion[0], A.memory, _map(m, A.frames[0]))
        advance(motion[0], A.frozen_memory, m)
    elif not rare:
        return _end(r, gates.SETTLING) if t.teaches else DONE
    if rare:
        return ADVANCED
    return TEACH if t.teaches else DONE


# --- What it teaches.


@compiled
def _teach(A: Row, r: Any, c: Any) -> int:
    """Gates of the smoothed instant; whether it is due; the inputs of the model there."""
    t, track, g, slots = r.sample, r.intake.track, r.intake.gates, A.voltages.shape[0]
    now = track.count - 1 - c.lag
    at, before = now % slots, (now - 1) % slots
    if gates.settling(c.admission, g):
        return _end(r, gates.SETTLING)
    if not (A.good[at] and A.good[before]):
        return _end(r, gates.GLITCH)
    refused = gates.check_pair(c.admission, A.voltages[at], A.voltages[before], A.motion[0])
    # A saturated sample is not learnt, but it shows where the stage is, and so the error of the model.
    if refused != "" and refused != gates.SATURATED:
        return _end(r, refused)
    if now % c.filter_every != 0:
        return _end(r, refused if refused != "" else gates.PASSED)
    t["saturated"], t["due"], motion = refused != "", True, A.motion
    m = unpacked(A.model, A.sizes)[0]
    fill(motion[0], motion[1], motion[2], A.memory, _map(m, A.frames[0]), A.basis, A.point)
    t["rests"] = gates.at_rest(c.admission, g, motion[0], track.count, r.fixed.range_um, c.dt_s)
    return PREDICT


@compiled
def _judge_models(A: Row, r: Any, c: Any) -> int:
    """Errors of the learnt and of the identified model as they were served; marks of good estimates."""
    t, j, span_V, track, motion = r.sample, r.judgement, r.fixed.span_V, r.intake.track, A.motion
    p = A.basis.shape[0]
    target_V = track.smooth_V - r.share.share * t.kernel_V
    if not isfinite(target_V):
        return _end(r, gates.NUMERICS)
    m, beta, inverse_widths, alpha, scaled, _ = unpacked(A.model, A.sizes)
    basis, kernel = np.empty(p), np.empty(A.point.shape[0])
    fill(motion[0], motion[1], motion[2], A.frozen_memory, m, basis, kernel)
    frozen_V = mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)
    # Errors are those of the linear part as it was when an answer that takes effect now was given.
    size = A.delay.shape[0]
    A.delay[r.delayed % size] = A.beta
    r["delayed"] += 1
    served_V = dot(A.basis, A.delay[max(r.delayed - size, 0) % size], p)
    _judge(j, target_V - served_V, track.smooth_V - frozen_V, c.step_s)
    _is_valid(j, c.valid_enter * span_V, c.valid_leave * span_V)
    before = j.fallback
    r["fallbacks"] += _falls_back(j, c.fallback_floor * span_V, c.step_s) and not before
    if j.fallen_s > ROLLBACK_S:
        return ROLLED_BACK
    if j.short_V2 < (0.5 * c.valid_enter * span_V) ** 2:
        if j.judged % c.mark_every == 0:
            A.mark_beta[0], A.mark_covariance[:p] = A.mark_beta[1], A.mark_covariance[p:]
            A.mark_beta[1], A.mark_covariance[p:] = A.beta, A.covariance
        if j.judged % c.reference_every == 0:
            A.references[0], A.references[1] = A.references[1], A.beta
            A.known[0], A.known[1] = A.known[1], A.known[2]
    return CHECK


@compiled
def _check(A: Row, r: Any, c: Any) -> int:
    """Whether the readings follow the drive; places in which they did."""
    t, front, f, p = r.sample, r.intake, r.fixed, A.basis.shape[0]
    now = front.track.count - 1 - c.lag
    if now % c.check_every != 0 or t.saturated or not f.tells:
        return LEARN
    if front.track.jumps:
        return FORGET
    # Voltage of the last good model for this motion.
    p_V = r.share.share * t.kernel_V + dot(A.basis, A.references[0], p)
    follows, u_V = front.following, front.track.smooth_V
    fault = _follow(follows, u_V, p_V, f.drive_V, c.check_s, c.envelope.drift_per_s * f.drive_V)
    known = is_known(A.known[0], A.rates[0], A.rates[1])
    if not known:
        _forget_slopes(follows)
    if not (known and front.credit > 0):
        # A model that cannot say where the stage is still says that it moves.
        if follows.steps == 0 and follows.still == 0:
            remember_place(A, r, c, min(front.past_count, 1))
        return DISTRUSTED if follows.still >= STILL_STEPS else LEARN
    if not front.hold and (follows.good >= CONFIRMED or front.past_count == 0):
        if follows.good >= CONFIRMED:
            front["proven"], front["proven_past"] = False, False
        _count_again(follows)
        remember_place(A, r, c, min(front.past_count, 1))
    return DISTRUSTED if fault else LEARN


@compiled
def _learn(A: Row, r: Any, c: Any) -> int:
    """The step of the filter; what the window is to learn of what that has left."""
    t, track, f, p, motion = r.sample, r.intake.track, r.fixed, A.basis.shape[0], A.motion
    u_V = track.smooth_V
    if t.saturated:
        return _end(r, gates.SATURATED)
    if r.frozen:
        return _end(r, gates.FROZEN)
    left_V = u_V - dot(A.basis, A.beta, p)
    said = update(
        c.drift, r.filter.state, A.beta, A.covariance, A.walks, A.bursts, f.span_V, c.step_s, A.basis,
        u_V - r.share.share * t.kernel_V, not t.rests, np.empty(p), np.empty(p),
    )  # fmt: skip
    if said == "outlier":
        return _end(r, gates.OUTLIER)
    if t.rests:
        # The gain of the constant moves to the frame, but not where that is about to jump.
        shift_um = _rest_shift_um(r.rest, A.beta[0], u_V, f.span_V, f.range_um, c.step_s, c.creep_s)
        if not track.jumps:
            A.frames[0, 0] += shift_um
            A.frames[1, 0] += shift_um
        return _end(r, gates.UNEXCITED)
    _weigh(r.share, t.kernel_V, left_V, c.step_s)
    _leave_rest(r.rest)
    if r.judgement.valid:
        for i in range(2):
            A.known[2, i] = max(A.known[2, i], abs(A.rates[i]))
        for i in range(3):
            A.domain[2 * i] = min(A.domain[2 * i], motion[i])
            A.domain[2 * i + 1] = max(A.domain[2 * i + 1], motion[i])
    # The window learns only what the filter has just taken, and what that left. Alone it would take the first samples
    # of a changed stage, which the filter still refuses, and the change would become local for good.
    if window.due((track.count - 1 - c.lag) // c.filter_every, c.window_every):
        t["target_V"] = u_V - dot(A.basis, A.beta, p)
        return WINDOW
    return _end(r, gates.LEARNT)


@compiled
def learn_window(A: Row, W: WindowArrays, r: Any, c: Any) -> int:
    """The step of the window; its refusal for numerics begins a healing."""
    empty = W.C[ws.COUNT] == 0
    status = window.learn(W, r.share, A.point, r.sample.target_V, A.born, c.fifo)
    _end(r, gates.LEARNT if status == ws.ACCEPTED else gates.NUMERICS)
    # An empty window has nothing that a new factorisation could mend.
    return ILL if status == ws.ILL_CONDITIONED and not empty else DONE


# --- The order.


@compiled
def _go_on(A: Row, W: WindowArrays, r: Any, c: Any, first: int, here: bool) -> int:
    """From a stage to the next one that is not compiled, or to the end."""
    stage = first
    if stage == TAKE:
        stage = _take(A, r, c)
    if stage == ADVANCE:
        stage = _advance(A, r, c)
    if stage == TEACH:
        stage = _teach(A, r, c)
    if stage == PREDICT and here:
        r.sample["kernel_V"] = steps.predict(W, A.point)
        stage = JUDGE
    if stage == JUDGE:
        stage = _judge_models(A, r, c)
    if stage == CHECK:
        stage = _check(A, r, c)
    if stage == LEARN:
        stage = _learn(A, r, c)
    if stage == WINDOW and here:
        stage = HEALING if r.sample.heals else learn_window(A, W, r, c)
    if stage == DONE and not r.sample.rare:
        A.counters[r.sample.outcome] += 1
    r.sample["stage"] = stage
    return stage


@compiled
def go_on(
    row: IntArray, own: IntArray, numbers: Any, config: Any, stage: int, seq: int, t_s: float, u_V: float, y_um: float
) -> int:
    """The sample of one axis from ``stage`` on: the stage at which it stops. From TAKE on it is the one given here.

    row, own : handles of the row and of the window. numbers, config : arrays of one record.
    """
    if stage == TAKE:
        t = numbers[0].sample
        t["seq"], t["t_s"], t["u_V"], t["y_um"], t["checks"] = seq, t_s, u_V, y_um, True
    return _go_on(row_of(row), arrays_of(own), numbers[0], config[0], stage, True)


@compiled
def go_on_all(
    lo: int, hi: int, axes: IntArray, rows: IntArray, owns: IntArray, numbers: Any, config: Any, stage: int, here: bool
) -> None:
    """`go_on` with the samples of ``axes[lo:hi]``; the first index of all others is the axis.

    here : whether the steps of the windows are made here too, not only all up to them.
    """
    for k in range(lo, hi):
        b = axes[k]
        _go_on(row_of(rows[b]), arrays_of(owns[b]), numbers[b], config[0], stage, here)


@compiled
def learn_all(axes: IntArray, rows: IntArray, owns: IntArray, numbers: Any, config: Any, out: IntArray) -> None:
    """(k,) status of the step of each window of ``axes``; see `ResidualWindow.learn`."""
    for k in range(axes.shape[0]):
        b = axes[k]
        A, W, r = row_of(rows[b]), arrays_of(owns[b]), numbers[b]
        empty = W.C[ws.COUNT] == 0
        status = window.learn(W, r.share, A.point, r.sample.target_V, A.born, config[0].fifo)
        out[k] = ws.BAD_INPUT if empty and status == ws.ILL_CONDITIONED else status


@compiled
def memory_now(A: Row, r: Any, frozen: bool, out: FloatArray) -> None:
    """(m,) memory after the last step: the smoothed one, carried along the readings since; see `Track.memory_now`."""
    slots, end, lag = A.readings.shape[0], r.intake.track.count, A.readings.shape[0] - 2
    m = unpacked(A.model, A.sizes)[0]
    out[:] = A.frozen_memory if frozen else A.memory
    for i in range(max(end - lag, 0), end):
        # Readings from before a jump are in the frame from before it.
        frame = m.frame if frozen else A.frames[1 if i >= r.intake.track.switch - lag else 0]
        advance(A.readings[i % slots], out, _map(m, frame))


@compiled
def memories_now(rows: IntArray, numbers: Any, frozen: BoolArray, out: FloatArray) -> None:
    """(B, m) `memory_now` of all axes."""
    for b in range(out.shape[0]):
        memory_now(row_of(rows[b]), numbers[b], frozen[b], out[b])
