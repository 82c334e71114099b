"""Intake of samples: judges each reading, and turns good ones into smoothed motion.

`Intake.take` judges a sample and returns the steps of the track (``adaptive.online.track``) to make for it.
`Intake.advance` makes a step and returns the pair of smoothed motion and voltage, ``lag`` samples old, to learn.

A reading is in one of three states. *Trusted*: it goes to the smoother. *Held*: a reading far from the prediction is
held back with those that follow (``adaptive.online.glitch_or_jump``) until they are known to be a glitch, ringing or a
jump. A jump that no voltage caused moves the frame of the features, so that everything learnt stays valid. *On trial*:
readings that stay undecided, or that do not follow the drive, must first prove that they do
(``adaptive.online.sensor_trust``). While readings are held or on trial nothing is learnt, and dead reckoning advances
the hysteresis memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Annotated, Any

import numpy as np

from dehyst.adaptive.compiled import shared
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates as admission
from dehyst.adaptive.online import glitch_or_jump as hypotheses
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import AdmissionState
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED, Circumstances, Hold, Verdict
from dehyst.adaptive.online.sensor_trust import CONFIRMED, STILL_STEPS, Following, Outcome, Trial
from dehyst.adaptive.online.track import (
    PROBE_EVERY,
    UNKNOWN_S,
    MissingMotion,
    Pair,
    Past,
    Reckoning,
    Step,
    Taken,
    Track,
    answers,
    drive_V,
    mean_slope,
)
from dehyst.adaptive.smoothing import smoother_of
from dehyst.adaptive.state import Entry, restore, save
from dehyst.adaptive.types import FloatArray, Sample

#: A reading further from the middle of the range than this many ranges is out of range.
FAR_OUT = 1.5
#: A state holds no motion of more ranges, and no voltage of more times the largest one, than this: such numbers are no
#: motion of the stage, and overflow in what is computed from them.
MOST_RANGES = 1e3
#: A reading that repeats for this time, s, while the voltage moves, is a fault of the sensor and no missing reading.
REPEATED_S = 0.1
#: Share of the identified range beyond its ends up to which the model is valid.
KNOWN = 0.05
#: Largest deviation of a reckoned place, as a share of the range, for a hold to begin from a past place.
PAST_SHARE = 0.02
#: Age of a place that is certainly from before a fault that is detected now, s.
CLEAN_S = 0.06
#: Control trials: most credit of a model, which may judge only with some; what it begins with, so that a model that was
#: never right judges no sensor; passed trials that a failed one takes away; time to the next while it has full credit,
#: and while not, s; windows after which one has shown nothing.
CREDIT, FIRST_CREDIT, FAILURE, CONTROL_S, CONTROL_AGAIN_S, CONTROL_WINDOWS = 3, 0, 2, 5.0, 0.3, 4

#: Rates of the voltage above the largest known ones by this factor are unknown motion, in which no reading is judged.
BEYOND = 1.25

Model = Callable[[], LssvmInverse]


@shared
def is_known(known: FloatArray, slope: float, bend: float) -> bool:
    """Whether rates of the voltage, V/s and V/s², are not beyond the learnt ones ``known`` (2,).

    Only there the model can tell a wrong reading from motion that it has not learnt yet.
    """
    return bool(abs(slope) <= BEYOND * known[0] and abs(bend) <= BEYOND * known[1])


class Intake:
    """The intake of a learner; ``base`` is the identified model."""

    gates: Annotated[AdmissionState, Entry("state of the gates")]
    known: Annotated[
        FloatArray, Entry("largest rates of the voltage learnt: at the two good estimates, now", "V/s, V/s²", "3,2")
    ]
    following: Annotated[Following, Entry("check that the readings follow the drive")]
    track: Annotated[Track | None, Entry("of the stage, before the first reading none")]
    _hold: Annotated[Hold | None, Entry("readings that are held back")]
    _trial: Annotated[Trial | None, Entry("trial of the sensor")]
    _control: Annotated[Trial | None, Entry("control trial: it judges readings that are trusted")]
    missing: Annotated[MissingMotion | None, Entry("a gap of which the motion is not known yet")]
    _proven: Annotated[FeatureMap | None, Entry("the frame before the first jump that is not confirmed")]
    _proven_past: Annotated[Past | None, Entry("a place from then")]
    _pasts: Annotated[list[Past], Entry("places in which the readings followed, older first", name="past", most=2)]
    _lost: Annotated[bool, Entry("whether the smoother has to start again")]
    _calm: Annotated[int, Entry("samples since readings were last held back", low=0)]
    _credit: Annotated[int, Entry("passed control trials; without any the model judges no sensor", high=CREDIT)]
    _until_control: Annotated[int, Entry("samples until the next control trial")]
    _reckoned_seq: Annotated[int, Entry("the last sample that has advanced the place", low=-1)]
    restarts: Annotated[int, Entry("restarts of the smoother", low=0)]
    jumps: Annotated[int, Entry("jumps taken", low=0)]
    undone: Annotated[int, Entry("jumps taken back", low=0)]
    trials: Annotated[int, Entry("trials of the sensor", low=0)]

    def __init__(self, base: LssvmInverse, config: LearnerConfig) -> None:
        self.base = base
        self.dt_s = base.dt_s
        self.range_um = base.features.y_max_um - base.features.y_min_um
        self.smoother = smoother_of(config.smoother(self.dt_s))
        self.gates = admission.AdmissionState()
        self.track = None
        # Standard deviation of the model's predictions as of the last sample, V; that of the most recent ones.
        self._doubt_V = self._recent_V = 0.0
        self.restarts = self.jumps = self.undone = self.trials = 0
        self.following = Following()
        self.missing = None
        self._middle_um = 0.5 * (base.features.y_max_um + base.features.y_min_um)
        self._admission = config.admission.at(self.dt_s)
        self._envelope = config.envelope
        self._hold = None
        self._trial = None
        self._lost = True  # The smoother has to start again.
        # The frame before the first jump since the readings were last found to follow the drive, and a place from then.
        self._proven = None
        self._proven_past = None
        self._calm = 1_000_000  # Samples since readings were last held back.
        # A model that does not depend on the displacement cannot check a sensor.
        self._tells = answers(base)
        self._drive_V = drive_V(base)
        self.known = known_rates(base)
        # A control trial judges readings that are trusted. A fault that it finds is the model's, and costs the model
        # credit: without credit the model may not judge the sensor. Samples until the next control trial.
        self._control = None
        self._credit, self._until_control = FIRST_CREDIT, 0
        self._reckoned_seq = -1  # The last sample that has advanced the place, with a reading or without.
        # Places from before the last steps in which the readings followed the drive, the older one first.
        self._pasts = []

    @property
    def served(self) -> FeatureMap:
        """The feature map to serve with."""
        return self.base.features if self.track is None else self.track.served

    @property
    def _judges(self) -> bool:
        """Whether the model is good enough to judge the sensor."""
        return self._tells and self._credit > 0

    def resync(self) -> None:
        """Forget the sequence: the next sample is taken whatever its number."""
        self.gates = admission.AdmissionState()
        self._reckoned_seq = -1
        self._hold, self._trial, self._lost = None, None, True
        self._proven = self._proven_past = None
        self._forget()

    def _forget(self) -> None:
        """Forget how the readings followed so far."""
        self.following.forget()
        self._pasts.clear()
        self._control = None

    @property
    def fault(self) -> str:
        """Name of what is wrong with the sensor, "" while nothing is known to be."""
        return "" if self._trial is None else self._trial.fault

    @property
    def why(self) -> str:
        """The reason for ``fault`` in words."""
        return "" if self._trial is None else self._trial.why

    @property
    def on_trial(self) -> bool:
        """Whether readings have come that are on trial."""
        return self._trial is not None and self._trial.since > 0

    # ---- what a sample is

    def take(self, sample: Sample, model: Model, doubt_V: float, recent_V: float) -> Taken:
        """Judge one sample; ``model`` returns the served model, for dead reckoning if needed.

        ``doubt_V`` : standard deviation of the model's predictions, V; ``recent_V`` : of the most recent ones. Never
        raises on data.
        """
        self._doubt_V, self._recent_V = doubt_V, recent_V
        c, gates, track = self._admission, self.gates, self.track
        refused = self._refusal(sample)
        if refused:
            if gates.seq < 0 or self._refusal(replace(sample, y_um=self._middle_um)):
                return Taken(refused)
            # Only the reading is wrong. The stage moves all the same: the sample is one without a reading.
            sample = replace(sample, y_um=nan)
        missing = sample.seq - self._reckoned_seq - 1 if gates.seq >= 0 else 0
        between = self._missed_V(sample.u_V, missing)
        for u in (*between, sample.u_V):
            admission.watch_voltage(gates, u)
        if not refused:
            gates.take(sample, sample.seq - gates.seq if gates.seq >= 0 else 1)
        self._reckoned_seq = sample.seq
        if self._trial is not None:
            return self._try(self._trial, sample, between, refused)
        refused = refused or admission.check_repeats(gates, sample, self.base.span_V)
        if track is None or self._lost or missing > c.max_gap or ((missing or refused) and track.motion is None):
            if refused:
                self._lost = True
                return Taken(refused)
            return self._after_gap(sample, missing, model)
        for u in between:
            self._keep(track, model, u, nan)
        if refused:
            return self._without_reading(self._keep(track, model, sample.u_V, nan), refused)
        innovation = (sample.y_um - track.predicted_um) / self.range_um
        known = track.motion is not None and gates.since_start > c.settle and is_known(self.known[0], *track.rates_now)
        limit = admission.surprise(c, gates, self.base.span_V)
        doubtful = known and abs(innovation) > limit
        # Held readings count too, except while they ring: an error that repeats becomes the usual error.
        if self._hold is None or not self._hold.rang:
            admission.watch_innovation(c, gates, innovation)
        if self._hold is None and not doubtful:
            self._until_control -= 1
            if known and self.missing is None and (self._control is not None or self._until_control <= 0):
                self._check_model(track, sample, model)
            return Taken("", (Step(sample.y_um, sample.u_V),))
        # Dead reckoning knows the motion that a kink of the voltage causes; only the smoother does not.
        limit -= admission.KINK_SHARE * gates.kink_V / self.base.span_V
        return self._decide(sample, track, self._keep(track, model, sample.u_V, sample.y_um), limit)

    def _refusal(self, sample: Sample) -> str:
        """The gate that refuses a sample for what it is, or ""."""
        refused = admission.check_sample(self._admission, self.gates, sample, self.dt_s)
        if not refused and sample.seq <= self._reckoned_seq:
            # A sample without a reading has come in its place already, or in that of a later one.
            return admission.DUPLICATE if sample.seq == self._reckoned_seq else admission.OUT_OF_ORDER
        if not refused and abs(sample.y_um - self._middle_um) > FAR_OUT * self.range_um:
            return admission.OUT_OF_RANGE
        return refused

    def _missed_V(self, u_V: float, missing: int) -> list[float]:
        """Voltages of ``missing`` samples before one with ``u_V``, V: interpolated, as they are unknown."""
        before_V = self.gates.u_V
        slope_V = (u_V - before_V) / (missing + 1)
        return [before_V + slope_V * (i + 1) for i in range(min(missing, MOST_BRIDGED))]

    def _without_reading(self, hold: Hold, refused: str) -> Taken:
        """A held sample whose reading was refused. A sensor that repeats itself for long goes on trial; after too many
        other refused readings, the next one begins anew."""
        repeats = refused == admission.GLITCH and len(hold.y_um) * self.dt_s >= REPEATED_S
        if len(hold.y_um) < MOST_BRIDGED and not (repeats and self._judges):
            return Taken(refused)
        if self._judges:
            return self._begin_trial(hold.reckoning)
        self._hold, self._lost = None, True
        return Taken(refused)

    def _after_gap(self, sample: Sample, missing: int, model: Model) -> Taken:
        """Begin smoothing anew after ``missing`` samples, 0 for an unknown number, or at the first sample."""
        track, earlier = self.track, self.missing
        from_um = sample.y_um if track is None else track.last_um
        taken = self._restart(sample, admission.GAP if missing else admission.SETTLING)
        if track is None or not track.served.memory_size:
            return taken
        seconds = (missing + 1) * self.dt_s if missing else UNKNOWN_S
        self.missing = gap = MissingMotion.begin(
            self._of_track(track, model()), track.memory, from_um, sample.y_um, sample.u_V, seconds,
            self._recent_V, earlier,
        )  # fmt: skip
        track.remember(gap.memory)
        return taken

    def recall(self, pair: Pair, model: Model, every: int) -> bool:
        """After a gap: correct the memory by a pair. Returns whether nothing may be learnt from it yet.

        ``every`` : samples between two steps of the filter. At rest the zero is learnt on: the memory stays as it is.
        """
        gap, track = self.missing, self.track
        assert gap is not None
        assert track is not None
        if pair.now % every:
            return not gap.rests
        if self.rests(pair.y_um):
            gap.stand()
            return False
        gap.move(lambda: self._of_track(track, model()), every * self.dt_s)
        motion = (pair.y_um, pair.v_um_per_s, pair.a_um_per_s2)
        if pair.good and not admission.check_pair(self._admission, *pair.applied_V, pair.y_um):
            # The smoother's first instants are worse: it does not know the velocity when it begins.
            gap.correct(motion, pair.u_V, min(1.0, (gap.since / (2 * track.lag)) ** 2))
            track.remember(gap.memory)
        if pair.now // every % PROBE_EVERY == 0:
            gap.compare(motion)
            if gap.closed:
                self.missing = None
        return self.missing is not None

    def _restart(self, sample: Sample, why: str) -> Taken:
        """Begin smoothing anew at a sample."""
        self.missing = None
        self._hold, self._trial, self._lost = None, None, False
        self._proven_past = None
        self.gates.restart()
        self._forget()
        if self.track is None:
            self.track = Track.begin(self.smoother, self.base.features, self.base.features, sample.y_um)
        else:
            self.track.restart(sample.y_um)
        self.restarts += 1
        return Taken(why, (Step(sample.y_um, sample.u_V),))

    # ---- readings held back

    def _keep(self, track: Track, model: Model, u_V: float, y_um: float) -> Hold:
        """Hold a sample back; begins a hold where there is none."""
        self._control = None
        if self._hold is None:
            # Soon after another hold the readings are no anchor: some of them may have rung.
            self._hold = self._begin_hold(track, model(), past=self._calm <= 2 * self.smoother.config.lag)
        self._hold.put(u_V, y_um)
        return self._hold

    def _check_model(self, track: Track, sample: Sample, model: Model) -> None:
        """Control trial: would a trial of trusted readings find a fault?"""
        if self._control is None:
            if not self._tells:
                return
            self._control = Trial.begin(self._begin_hold(track, model()).reckoning, self.base, track.memory_now(True))
        control = self._control
        decision = control.put(sample.u_V, sample.y_um, self._circumstances(0.0))
        done = decision.outcome is not Outcome.OPEN or bool(control.fault)
        if not done and control.since * self.dt_s < CONTROL_WINDOWS * self._envelope.follow_s:
            return
        self._give_credit(-1 if control.fault else decision.credit)
        self._control = None
        self._until_control = round((CONTROL_S if self._credit == CREDIT else CONTROL_AGAIN_S) / self.dt_s)

    def _give_credit(self, credit: int) -> None:
        # A model that fails every second time would get credit now and then, and accuse a good sensor with it.
        self._credit = min(max(self._credit + (credit if credit >= 0 else FAILURE * credit), -CREDIT), CREDIT)

    def _begin_hold(self, track: Track, model: LssvmInverse, past: bool = False) -> Hold:
        """A hold of what comes: the place goes on from where ``track`` last was by readings that were believed.

        ``past`` : or from where it was when the readings had followed the drive, where the last ones are in doubt too.
        """
        if past and self._pasts and self._judges:
            reckoning = self._from_past(track, model)
            # A place from long ago, over a long way, is no better than readings that may have rung.
            if reckoning.std_um <= PAST_SHARE * self.range_um:
                return Hold(reckoning, reckoning.y_um)
        motion, u_before_V, past_V, past_um = track.since_motion()
        reckoning = Reckoning.begin(self._of_track(track, model), motion, u_before_V, past_V, past_um, track.memory)
        last_um = float(past_um[-1]) if past_um.size else motion[0]
        return Hold(reckoning, last_um)

    def _from_past(self, track: Track, model: LssvmInverse) -> Reckoning:
        """From the last place that readings have confirmed, over the voltages since."""
        return _from_past(self._clean_past(), self._of_track(track, model))

    def _clean_past(self) -> Past:
        """The last place that readings have confirmed which is from before anything that is noticed now."""
        newest = self._pasts[-1]
        return newest if len(newest.u_V) * self.dt_s > CLEAN_S else self._pasts[0]

    def _of_track(self, track: Track, model: LssvmInverse) -> LssvmInverse:
        """A model in the frame of the track: the identified one is served in its own, with a memory of its own."""
        return model if model.features == track.served else replace(model, features=track.served)

    def _circumstances(self, limit: float) -> Circumstances:
        """What readings are judged by; ``limit`` : distance, in ranges, up to which one is no surprise."""
        c, gates, served = self._admission, self.gates, self.served
        usual = max(limit, c.surprise_share)
        usual += min(2.0 * self._doubt_V / self.base.span_V, c.glitch_share)
        return Circumstances(
            config=c,
            envelope=self._envelope,
            dt_s=self.dt_s,
            range_um=self.range_um,
            noise_um=max(gates.innovation2**0.5, c.surprise_share / c.surprise_sigma) * self.range_um,
            usual_um=usual * self.range_um,
            rest_um=served.offset_um + served.gain * served.y_rest_um,
            low_um=served.offset_um + served.gain * (served.y_min_um - KNOWN * self.range_um),
            high_um=served.offset_um + served.gain * (served.y_max_um + KNOWN * self.range_um),
            trusted=gates.since_glitch * self.dt_s > c.doubt_s,
        )

    def _decide(self, sample: Sample, track: Track, hold: Hold, limit: float) -> Taken:
        """The decision after the last sample held back."""
        now = self._circumstances(limit)
        verdict = hypotheses.judge(hold, now)
        if verdict is Verdict.JUMP:
            return self._take_jump(sample, track, hold, now)
        if verdict is Verdict.WAIT:
            if hold.rang or hold.taken:
                return Taken(admission.RINGING)
            # A hold that waits for missing readings has seen no wrong one.
            return Taken(admission.GAP if hold.silent and hold.seen_um <= now.usual_um else admission.GLITCH)
        if verdict is Verdict.LOST:
            return self._give_up(sample, hold)
        self._hold = None
        if verdict is Verdict.MOTION:
            return Taken("", hypotheses.steps_of_motion(hold))
        if hold.seen_um > self._admission.glitch_share * self.range_um and not (hold.taken or hold.rang):
            self.gates.note_glitch()
        self._calm = -len(hold.y_um) if len(hold.y_um) > 1 else self._calm
        return Taken("", hypotheses.steps_of_hold(hold, now.usual_um))

    def _give_up(self, sample: Sample, hold: Hold) -> Taken:
        """An unexplained hold: begin a trial, or restart where the model may not judge the sensor."""
        return self._begin_trial(hold.reckoning) if self._judges else self._restart(sample, admission.SETTLING)

    def _take_jump(self, sample: Sample, track: Track, hold: Hold, now: Circumstances) -> Taken:
        """The readings have settled at another level: move frame and place.

        No voltage caused this jump, so the hysteresis memory stays. A jump back is another jump.
        """
        f, away_um = track.served, hold.away_um
        slope, shift_um = hypotheses.jump_after(f, hold.expected_um, away_um)
        frame = hypotheses.frame_after(f, slope, shift_um)
        if self._envelope.refuses(self.base.features, frame):
            return self._give_up(sample, hold)
        first = self._proven is None
        if first:
            self._proven, self._proven_past = f, self._clean_past() if self._pasts else Past.of(track)
        self.jumps += 1
        self.missing = None
        track.move(frame, slope, shift_um)
        hold.take(slope, shift_um)
        self._forget()
        if abs(hold.y_um[-1] - hold.expected_um) > now.usual_um:
            # It rings about the new level: the frame is right, wait for settled readings.
            return Taken(admission.RINGING, (), away_um, first=first)
        self._hold = None
        return Taken("", hypotheses.steps_of_hold(hold, now.usual_um), away_um, first=first)

    # ---- readings on trial

    def distrust(self, model: Model) -> bool:
        """The readings do not follow the drive: begin a trial with the next sample. Returns whether one has begun.

        The place is reckoned from one at which they still followed, over the voltages since.
        """
        track = self.track
        if track is None or track.motion is None or self._trial is not None:
            return False
        if not (self._judges or self.following.still >= STILL_STEPS):
            return False
        if self._hold is not None:
            reckoning = self._hold.reckoning
        elif self._pasts:
            reckoning = self._from_past(track, model())
            # What was learnt since is about to be taken back: the place is reckoned once more then.
            self._proven_past = self._proven_past or self._clean_past()
        else:
            reckoning = self._begin_hold(track, model()).reckoning
        self._begin_trial(reckoning)
        return True

    def _begin_trial(self, reckoning: Reckoning) -> Taken:
        track, proven = self.track, self._proven
        assert track is not None
        if proven is not None:
            # Unconfirmed jumps are taken back with the readings that they were taken from.
            reckoning = reckoning.in_frame(proven)
            if self._proven_past is not None:
                self._proven_past.u_V.extend(() if self._hold is None else self._hold.u_V)
            track.enter(proven)
            self.undone += 1
        self._hold, self._proven, self.missing = None, None, None
        self._trial = Trial.begin(reckoning, self.base, track.memory_now(True), by_voltages=not self._judges)
        self.trials += 1
        self._forget()
        return Taken(admission.UNTRUSTED, distrusted=True)

    def _try(self, trial: Trial, sample: Sample, between: list[float], refused: str) -> Taken:
        """One sample of a sensor on trial, after missing ones with the voltages ``between``, V.

        ``refused`` : the gate that refused its reading, or "".
        """
        fault = trial.fault
        # Samples without a reading advance the reckoning alone.
        for u in between if not refused else (*between, sample.u_V):
            trial.put(u, nan, self._circumstances(0.0))
        if refused:
            return Taken(refused)
        decision = trial.put(sample.u_V, sample.y_um, self._circumstances(0.0))
        if decision.outcome is Outcome.OPEN:
            return Taken(admission.UNTRUSTED, renamed=trial.fault != fault)
        self._give_credit(min(decision.credit, 0))
        track = self.track
        assert track is not None
        frame, away_um = track.served, 0.0
        if decision.outcome is Outcome.CHANGED:
            frame = hypotheses.frame_after(frame, decision.slope, decision.shift_um)
            refused = self._envelope.refuses(self.base.features, frame)
            if refused:
                trial.refuse(refused)
                return Taken(admission.UNTRUSTED, renamed=trial.fault != fault)
            away_um = sample.y_um - trial.reckoning.y_um
            self.jumps += 1
        before = track.served
        track.enter(frame)
        self.gates.note_glitch()
        taken = self._restart(sample, admission.SETTLING)
        track.remember(trial.reckoning.memory)
        first = decision.outcome is Outcome.CHANGED
        if first:
            # Readings of another stage may have moved alike for a while: this jump is open until motion confirms it.
            self._proven, self._proven_past = before, Past.reckoned(trial.reckoning)
        return taken._replace(jump_um=away_um, renamed=True, first=first)

    def reckon_by(self, model: LssvmInverse) -> None:
        """``model`` is served while readings are on trial: reckon the place with the same model.

        The place is reckoned again from one at which the readings followed, or from before jumps that were taken back.
        """
        past, self._proven_past = self._proven_past, None
        if self._trial is None or self.track is None:
            return
        model = self._of_track(self.track, model)
        reckoning = self._trial.reckoning
        self._trial.go_on_from(reckoning.by_model(model) if past is None else _from_past(past, model))

    # ---- where the stage is

    @property
    def holds(self) -> bool:
        """Whether readings are held back, or on trial."""
        return self._hold is not None or self._trial is not None

    def memory_now(self, frozen: bool = False) -> FloatArray:
        """(m,) hysteresis memory at the place of the last sample, measured or reckoned.

        ``frozen`` : for a model in the frame that learning began with.
        """
        assert self.track is not None
        reckoned = self._hold or self._trial
        # The identified model has its own memory in its own frame. On trial, the reckoned one is better.
        if reckoned is not None and (not frozen or self._trial is not None):
            memory = reckoned.reckoning.memory
            return self.served.memory_in(self.base.features, memory) if frozen else memory.copy()
        return self.track.memory_now(frozen)

    @property
    def controls(self) -> bool:
        """Whether a control trial of the model is under way."""
        return self._control is not None

    @property
    def begins(self) -> bool:
        """Whether the next sample cannot teach anything, because the smoother has just started."""
        smooths = self.track is not None and self.track.motion is not None
        return not smooths and self.gates.since_start < self._admission.settle

    @property
    def ordinary(self) -> bool:
        """Whether nothing is under way: readings are smoothed and trusted, and no jump is open."""
        track = self.track
        return not (
            track is None
            or self._lost
            or track.motion is None
            or track.features != track.served
            or self.holds
            or self.missing is not None
            or self._control is not None
            or self._proven is not None
            or self._proven_past is not None
        )

    # ---- what it teaches

    def advance(self, step: Step) -> tuple[Pair | None, bool]:
        """One step of the track; see there."""
        assert self.track is not None
        self.gates.step()
        self._calm += 1
        for past in self._pasts:
            past.u_V.append(step.u_V)
        if self._trial is not None or self._proven_past is not None:
            self._note_voltage(step.u_V)
        if self._pasts and len(self._pasts[0].u_V) > hypotheses.MOST_BRIDGED:
            # At rest nothing is checked, and the present place is as good as the past one.
            self._pasts = [*self._pasts[1:], Past.of(self.track)] if self.track.motion else []
        advanced = self.track.advance(step)
        if self.missing is not None and self.track.motion is not None:
            self.missing.advance(self.track.motion[0])
            self.track.remember(self.missing.memory)
        return advanced

    def _note_voltage(self, u_V: float) -> None:
        """Note a voltage for the trial and for the place from before unconfirmed jumps."""
        if self._trial is not None:
            # The trial began within the samples of a hold: their readings are not used, their voltages are.
            self._trial.reckoning.advance(u_V)
        if self._proven_past is not None and not any(self._proven_past is past for past in self._pasts):
            self._proven_past.u_V.append(u_V)
            if len(self._proven_past.u_V) > hypotheses.MOST_BRIDGED:
                self._proven_past = None

    def to_base_frame(self) -> None:
        """Return to the identified frame and the memory tracked in it; nothing without a jump.

        For when the identified model predicts well: then no jump was a lasting one.
        """
        track = self.track
        if track is None or self.jumps == self.undone or track.served == self.base.features:
            return
        track.to_base()
        self.missing = None
        self._hold, self._proven, self._proven_past = None, None, None
        self.undone += 1

    def creep(self, by_um: float) -> None:
        """The stage has crept by ``by_um``, µm, without a voltage: move the frame."""
        if self.track is not None:
            self.track.creep(by_um)

    def follow(self, pair: Pair, p_V: float, since_s: float) -> bool:
        """Check with one pair whether the readings follow the drive; True where they do not and a trial is due.

        ``p_V`` : voltage of the last good model for the pair's motion. ``since_s`` : time since the last check, s.
        """
        track = self.track
        assert track is not None
        if not self._tells:
            return False
        if track.features is not track.served:
            # Motion from before and after a jump cannot be compared.
            self._forget()
            return False
        fastest_V_per_s = self._envelope.drift_per_s * self._drive_V
        fault = self.following.take(pair.u_V, p_V, self._drive_V, since_s, fastest_V_per_s)
        known = is_known(self.known[0], *pair.rates)
        if not known:
            self.following.forget_slopes()
        if not (self._judges and known):
            # A model that cannot say where the stage is still says that it moves.
            if self.following.moved:
                self._pasts = [*self._pasts[-1:], Past.of(track)]
            return self.following.still >= STILL_STEPS
        if self._hold is None and (self.following.good >= CONFIRMED or not self._pasts):
            if self.following.good >= CONFIRMED:
                self._proven = self._proven_past = None
            self.following.count_again()
            self._pasts = [*self._pasts[-1:], Past.of(track)]
        return fault

    def rests(self, y_um: float) -> bool:
        """Whether the stage, now at ``y_um``, has not left its place for a while."""
        count = self.track.state.count if self.track is not None else 0
        return admission.at_rest(self._admission, self.gates, y_um, count, self.range_um, self.dt_s)

    def learn_rates(self, rates: tuple[float, float]) -> None:
        """Motion with these rates of the voltage, V/s and V/s², has been learnt."""
        np.maximum(self.known[2], np.abs(rates), out=self.known[2])

    def mark_rates(self) -> None:
        """The present estimate becomes the newer good one."""
        self.known[:2] = self.known[1:]

    # ---- keeping

    @property
    def given(self) -> dict[str, Any]:
        """What the records of a stored state do not hold themselves; see `adaptive.state.load`."""
        track = {"smoother": self.smoother, "base": self.base.features}
        return {"track": track, "_trial": {"base": self.base}, "_control": {"base": self.base}}

    @property
    def sizes(self) -> dict[str, float]:
        """Sizes of the dimensions of the state by name, and largest magnitudes of motion and voltage by unit."""
        c = self._admission
        most_um = MOST_RANGES * (abs(self._middle_um) + self.range_um)
        most_V = MOST_RANGES * max(abs(c.u_min_V), abs(c.u_max_V), self._drive_V)
        rates = {"": 1.0, "/s": self.dt_s, "/s²": self.dt_s**2}
        limits = {f"µm{per}": most_um / step for per, step in rates.items()}
        limits |= {f"V{per}": most_V / step for per, step in rates.items()}
        return limits | self.base.features.sizes | self.smoother.sizes

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where a frame has other sizes than the model."""
        if values["_proven"] is not None:
            values["_proven"].check_like(self.base.features)

    def go_on_as(self, other: Intake) -> None:
        """Continue from the state of another intake of the same model."""
        restore(self, save(other), self.sizes, self.given)


def known_rates(base: LssvmInverse) -> FloatArray:
    """(3, 2) rates of the voltage that an identified model knows, see `Intake.known`, V/s and V/s²."""
    fastest = np.abs(base.domain[2:].reshape(2, 2)).max(axis=1) * abs(mean_slope(base))
    return np.tile(fastest, (3, 1))


def _from_past(past: Past, model: LssvmInverse) -> Reckoning:
    """From a place in the past over the voltages since."""
    reckoning = Reckoning.begin(model, past.motion, past.u_before_V, past.lag_V, past.lag_um, past.memory)
    for u in past.u_V:
        reckoning.advance(u)
    reckoning.begin_way()
    return reckoning
