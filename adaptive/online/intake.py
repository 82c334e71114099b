"""Intake of samples: judges each reading, and turns good ones into smoothed motion.

What is ordinary is in `adaptive.online.step`, on the same state; here is what is rare.

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
from dehyst.adaptive.online.gates import AdmissionState, Judgement
from dehyst.adaptive.online.glitch_or_jump import MOST_BRIDGED, Circumstances, Hold, Verdict
from dehyst.adaptive.online.row import Row
from dehyst.adaptive.online.sensor_trust import STILL_STEPS, Following, Outcome, Trial
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
from dehyst.adaptive.state import Entry, Numbers, restore, save
from dehyst.adaptive.types import FloatArray, IntArray, Sample

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


class Intake(Numbers):
    """The intake of a learner; ``base`` is the identified model. judgement : of the errors of the served model."""

    judgement: Judgement
    gates: Annotated[AdmissionState, Entry("state of the gates")]
    known: Annotated[
        FloatArray, Entry("largest rates of the voltage learnt: at the two good estimates, now", "V/s, V/s²", "3,2")
    ]
    following: Annotated[Following, Entry("check that the readings follow the drive")]
    track: Annotated[Track, Entry("of the stage")]
    _hold: Annotated[Hold | None, Entry("readings that are held back")]
    rings: Annotated[bool, Entry("whether they ring")]
    _trial: Annotated[Trial | None, Entry("trial of the sensor")]
    _control: Annotated[Trial | None, Entry("control trial: it judges readings that are trusted")]
    missing: Annotated[MissingMotion | None, Entry("a gap of which the motion is not known yet")]
    # A jump is open until readings that follow the drive confirm it.
    _proven: Annotated[FeatureMap | None, Entry("the frame before the first jump that is not confirmed")]
    _proven_past: Annotated[Past | None, Entry("a place from then")]
    # Places from before the last steps in which the readings followed the drive, the older one first.
    past_count: Annotated[int, Entry("places in which the readings followed", low=0, high=2)]
    past_written: Annotated[int, Entry("voltages so far", low=0)]
    past_motion: Annotated[FloatArray, Entry("motion and voltage there", "µm, µm/s, µm/s², V", "2,4")]
    past_V: Annotated[FloatArray, Entry("voltages over the lag since", "V", "2,lag", finite=False)]
    past_um: Annotated[FloatArray, Entry("readings over the lag since", "µm", "2,lag", finite=False)]
    past_memory: Annotated[FloatArray, Entry("hysteresis memory there", "µm", "2,m")]
    past_from: Annotated[IntArray, Entry("voltages before each", "", "2", low=0)]
    past_ring: Annotated[FloatArray, Entry("ring of voltages", "V", "ring", finite=False)]
    lost: Annotated[bool, Entry("whether the smoother has to start again")]
    calm: Annotated[int, Entry("samples since readings were last held back")]
    credit: Annotated[int, Entry("passed control trials; without any the model judges no sensor", high=CREDIT)]
    until_control: Annotated[int, Entry("samples until the next control trial")]
    reckoned_seq: Annotated[int, Entry("the last sample that has advanced the place, with a reading or not", low=-1)]
    restarts: Annotated[int, Entry("restarts of the smoother", low=0)]
    jumps: Annotated[int, Entry("jumps taken", low=0)]
    undone: Annotated[int, Entry("jumps taken back", low=0)]
    trials: Annotated[int, Entry("trials of the sensor", low=0)]

    def __init__(self, record: Any, row: Row, base: LssvmInverse, config: LearnerConfig) -> None:
        self.record, self.base, self.dt_s = record, base, base.dt_s
        self.range_um = base.features.y_max_um - base.features.y_min_um
        self.smoother = smoother_of(config.smoother(self.dt_s))
        self.gates = AdmissionState()
        self.following = Following()
        self.track = Track(record["track"], row, base.features, self.smoother.config.lag)
        self._middle_um = 0.5 * (base.features.y_max_um + base.features.y_min_um)
        self._admission = config.admission.at(self.dt_s)
        self._envelope = config.envelope
        self.lost, self.calm = True, 1_000_000
        # A model that does not depend on the displacement cannot check a sensor.
        self._tells = answers(base)
        self._drive_V = drive_V(base)
        self.known, self.past_motion, self.past_V, self.past_um = row.known, row.past_motion, row.past_V, row.past_um
        self.past_memory, self.past_from, self.past_ring = row.past_memory, row.past_from, row.past_ring
        self.known[:] = known_rates(base)
        # A control trial judges readings that are trusted. A fault that it finds is the model's, and costs the model
        # credit: without credit the model may not judge the sensor. Samples until the next control trial.
        self.credit, self.reckoned_seq = FIRST_CREDIT, -1

    @property
    def served(self) -> FeatureMap:
        """The feature map to serve with."""
        return self.track.served

    @property
    def _judges(self) -> bool:
        """Whether the model is good enough to judge the sensor."""
        return self._tells and self.credit > 0

    def resync(self) -> None:
        """Forget the sequence: the next sample is taken whatever its number."""
        self.gates = AdmissionState()
        self.reckoned_seq = -1
        self._hold, self._trial, self.lost = None, None, True
        self._proven = self._proven_past = None
        self.forget()

    def forget(self) -> None:
        """Forget how the readings followed so far."""
        self.following.forget()
        self.past_count, self._control = 0, None

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

    def take_held(
        self, sample: Sample, before_V: float, missing: int, refused: str, limit: float, model: Model
    ) -> Taken:
        """A sample that is held back, or comes while others are, after ``missing`` ones with the voltage ``before_V``.

        ``refused`` : the gate of its reading, or "". ``limit`` : distance, in ranges, up to which it is no surprise.
        ``model`` returns the served model, for dead reckoning.
        """
        for u in self._missed_V(before_V, sample.u_V, missing):
            self._keep(model, u, nan)
        if refused:
            return self._without_reading(self._keep(model, sample.u_V, nan), refused)
        return self._decide(sample, self.track, self._keep(model, sample.u_V, sample.y_um), limit)

    @staticmethod
    def _missed_V(before_V: float, u_V: float, missing: int) -> list[float]:
        """Voltages of ``missing`` samples between two, V: interpolated, as they are unknown."""
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
        self._hold, self.lost = None, True
        return Taken(refused)

    def after_gap(self, sample: Sample, missing: int, model: Model) -> Taken:
        """Begin smoothing anew after ``missing`` samples, 0 for an unknown number, or at the first sample."""
        track, earlier, first = self.track, self.missing, not self.track.begun
        from_um = track.last_um
        taken = self._restart(sample, admission.GAP if missing else admission.SETTLING)
        if first or not track.served.memory_size:
            return taken
        seconds = (missing + 1) * self.dt_s if missing else UNKNOWN_S
        self.missing = gap = MissingMotion.begin(
            self._of_track(model()), track.memory, from_um, sample.y_um, sample.u_V, seconds,
            self.judgement.recent_V, earlier,
        )  # fmt: skip
        track.remember(gap.memory)
        return taken

    def recall(self, pair: Pair, model: Model, every: int) -> bool:
        """After a gap: correct the memory by a pair. Returns whether nothing may be learnt from it yet.

        ``every`` : samples between two steps of the filter. At rest the zero is learnt on: the memory stays as it is.
        """
        gap, track = self.missing, self.track
        assert gap is not None
        if pair.now % every:
            return not gap.rests
        if self.rests(pair.y_um):
            gap.stand()
            return False
        gap.move(lambda: self._of_track(model()), every * self.dt_s)
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
        self._hold, self._trial, self.lost = None, None, False
        self._proven_past = None
        self.gates.restart()
        self.forget()
        self.track.begin(sample.y_um)
        self.restarts += 1
        return Taken(why, (Step(sample.y_um, sample.u_V),))

    # ---- readings held back

    def _keep(self, model: Model, u_V: float, y_um: float) -> Hold:
        """Hold a sample back; begins a hold where there is none."""
        self._control = None
        hold = self._hold
        if hold is None:
            # Soon after another hold the readings are no anchor: some of them may have rung.
            hold = self._hold = self._begin_hold(model(), past=self.calm <= 2 * self.track.lag)
            self.rings = False
        hold.put(u_V, y_um)
        return hold

    def check_model(self, sample: Sample, model: Model) -> None:
        """Control trial: would a trial of trusted readings find a fault?"""
        control = self._control
        if control is None:
            memory = self.track.memory_now(True)
            control = self._control = Trial.begin(self._begin_hold(model()).reckoning, self.base, memory)
        decision = control.put(sample.u_V, sample.y_um, self._circumstances(0.0))
        done = decision.outcome is not Outcome.OPEN or bool(control.fault)
        if not done and control.since * self.dt_s < CONTROL_WINDOWS * self._envelope.follow_s:
            return
        self._give_credit(-1 if control.fault else decision.credit)
        self._control = None
        self.until_control = round((CONTROL_S if self.credit == CREDIT else CONTROL_AGAIN_S) / self.dt_s)

    def _give_credit(self, credit: int) -> None:
        # A model that fails every second time would get credit now and then, and accuse a good sensor with it.
        self.credit = min(max(self.credit + (credit if credit >= 0 else FAILURE * credit), -CREDIT), CREDIT)

    def _begin_hold(self, model: LssvmInverse, past: bool = False) -> Hold:
        """A hold of what comes: the place goes on from where the track last was by readings that were believed.

        ``past`` : or from where it was when the readings had followed the drive, where the last ones are in doubt too.
        """
        if past and self.past_count and self._judges:
            reckoning = _from_past(self._clean_past(), self._of_track(model))
            # A place from long ago, over a long way, is no better than readings that may have rung.
            if reckoning.std_um <= PAST_SHARE * self.range_um:
                return Hold(reckoning, reckoning.y_um)
        motion, u_before_V, past_V, past_um = self.track.since_motion()
        memory = self.track.memory
        reckoning = Reckoning.begin(self._of_track(model), motion, u_before_V, past_V, past_um, memory)
        last_um = float(past_um[-1]) if past_um.size else motion[0]
        return Hold(reckoning, last_um)

    def _past(self, which: int) -> Past:
        """A place that readings have confirmed, and the voltages since; copies."""
        y, v, a, u_before_V = self.past_motion[which].tolist()
        since = np.arange(max(self.past_from.item(which), self.past_written - self.past_ring.size), self.past_written)
        u_V = self.past_ring[since % self.past_ring.size].tolist()
        lag_V, lag_um, memory = (part[which].copy() for part in (self.past_V, self.past_um, self.past_memory))
        return Past((y, v, a), u_before_V, lag_V, lag_um, memory, u_V)

    def _clean_past(self) -> Past:
        """The last place that readings have confirmed which is from before anything that is noticed now."""
        newest = self._past(self.past_count - 1)
        return newest if len(newest.u_V) * self.dt_s > CLEAN_S else self._past(0)

    def _of_track(self, model: LssvmInverse) -> LssvmInverse:
        """A model in the frame of the track: the identified one is served in its own, with a memory of its own."""
        served = self.track.served
        return model if model.features == served else replace(model, features=served)

    def _circumstances(self, limit: float) -> Circumstances:
        """What readings are judged by; ``limit`` : distance, in ranges, up to which one is no surprise."""
        c, gates, served = self._admission, self.gates, self.served
        usual = max(limit, c.surprise_share)
        usual += min(2.0 * self.judgement.std_V / self.base.span_V, c.glitch_share)
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
        self.rings = hold.rang > 0
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
        if hold.seen_um > 0.0:
            self.calm = -len(hold.y_um)
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
            self._proven, self._proven_past = f, self._clean_past() if self.past_count else Past.of(track)
        self.jumps += 1
        self.missing = None
        track.move(frame, slope, shift_um)
        hold.take(slope, shift_um)
        self.rings = False
        self.forget()
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
        if self.track.motion is None or self._trial is not None:
            return False
        if not (self._judges or self.following.still >= STILL_STEPS):
            return False
        if self._hold is not None:
            reckoning = self._hold.reckoning
        elif self.past_count:
            past = self._clean_past()
            reckoning = _from_past(past, self._of_track(model()))
            # What was learnt since is about to be taken back: the place is reckoned once more then.
            self._proven_past = self._proven_past or past
        else:
            reckoning = self._begin_hold(model()).reckoning
        self._begin_trial(reckoning)
        return True

    def _begin_trial(self, reckoning: Reckoning) -> Taken:
        track, proven = self.track, self._proven
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
        self.forget()
        return Taken(admission.UNTRUSTED, distrusted=True)

    def take_tried(self, sample: Sample, before_V: float, missing: int, refused: str) -> Taken:
        """One sample of a sensor on trial; see `take_held`."""
        trial = self._trial
        assert trial is not None
        fault, between = trial.fault, self._missed_V(before_V, sample.u_V, missing)
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
        if self._trial is None:
            return
        model = self._of_track(model)
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
        reckoned = self._hold or self._trial
        # The identified model has its own memory in its own frame. On trial, the reckoned one is better.
        if reckoned is not None and (not frozen or self._trial is not None):
            memory = reckoned.reckoning.memory
            return self.served.memory_in(self.base.features, memory) if frozen else memory.copy()
        return self.track.memory_now(frozen)

    # ---- beside the smoother

    def go_along(self, u_V: float) -> None:
        """The smoother has made a step with ``u_V``: note it for what is rare."""
        if self._trial is not None:
            # The trial began within the samples of a hold: their readings are not used, their voltages are.
            self._trial.reckoning.advance(u_V)
        past, gap = self._proven_past, self.missing
        if past is not None:
            past.u_V.append(u_V)
            if len(past.u_V) > hypotheses.MOST_BRIDGED:
                self._proven_past = None
        if gap is not None and self.track.motion is not None:
            gap.advance(self.track.motion[0])
            self.track.remember(gap.memory)

    def to_base_frame(self) -> None:
        """Return to the identified frame and the memory tracked in it; nothing without a jump.

        For when the identified model predicts well: then no jump was a lasting one.
        """
        if self.jumps == self.undone or self.served == self.base.features:
            return
        self.track.to_base()
        self.missing = None
        self._hold, self._proven, self._proven_past = None, None, None
        self.undone += 1

    def rests(self, y_um: float) -> bool:
        """Whether the stage, now at ``y_um``, has not left its place for a while."""
        return admission.at_rest(self._admission, self.gates, y_um, self.track.count, self.range_um, self.dt_s)

    # ---- keeping

    @property
    def given(self) -> dict[str, Any]:
        """What the records of a stored state do not hold themselves; see `adaptive.state.load`."""
        return {"_trial": {"base": self.base}, "_control": {"base": self.base}}

    @property
    def sizes(self) -> dict[str, float]:
        """Sizes of the dimensions of the state by name, and largest magnitudes of motion and voltage by unit."""
        c = self._admission
        most_um = MOST_RANGES * (abs(self._middle_um) + self.range_um)
        most_V = MOST_RANGES * max(abs(c.u_min_V), abs(c.u_max_V), self._drive_V)
        rates = {"": 1.0, "/s": self.dt_s, "/s²": self.dt_s**2}
        limits = {f"µm{per}": most_um / step for per, step in rates.items()}
        limits |= {f"V{per}": most_V / step for per, step in rates.items()}
        ours = {"lag": self.track.lag, "ring": self.past_ring.size}
        return limits | self.base.features.sizes | self.smoother.sizes | ours

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
    reckoning.advance_all(np.array(past.u_V))
    reckoning.begin_way()
    return reckoning
