"""From readings to motion: what each sample is, and which steps of the track (``adaptive.track``) it leads to.

Samples go in by ``take``, which says what each is and which steps are to be made for it; ``advance`` makes them and
returns the pair of smoothed motion and voltage, ``lag`` samples old, that may teach. Readings that surprise are held
back (``adaptive.surprise``): nothing is taught until they turn out to be a glitch, which is bridged, or a jump. A jump
of the reading that no voltage made moves the frame of the features, and with it everything that was learnt.
"""

from __future__ import annotations

from dataclasses import replace
from math import nan

from adaptive import admission, surprise
from adaptive.bridge import FAR_OUT, Bridging, Voltage
from adaptive.features import FeatureMap
from adaptive.front_state import parts_of, parts_to_state
from adaptive.heard import Heard
from adaptive.learner_config import LearnerConfig
from adaptive.smoothing import FixedLagSmoother
from adaptive.snapshot import LssvmInverse
from adaptive.surprise import Hold, Verdict
from adaptive.track import Pair, Step, Taken, Track
from adaptive.types import FloatArray, Sample, StateDict

#: A jump back differs from the jump by less than this share of it.
BACK_SHARE = 0.1


class Front:
    """The front end of a learner; ``base`` is the model that it starts from, ``voltage`` the one it has learnt.

    Attributes
    ----------
    track : where the stage is and has been, None before the first reading. gates : of the admission.
    doubt_V : deviation of the model's predictions, V, as far as it is known; the learner tells.
    """

    def __init__(self, base: LssvmInverse, config: LearnerConfig) -> None:
        self.base = base
        self.dt_s = base.dt_s
        self.range_um = base.features.y_max_um - base.features.y_min_um
        self.smoother = FixedLagSmoother(config.smoother(self.dt_s))
        self.gates = admission.AdmissionState()
        self.track: Track | None = None
        self.doubt_V = 0.0
        self.restarts = self.jumps = self.undone = 0
        self._middle_um = 0.5 * (base.features.y_max_um + base.features.y_min_um)
        self._admission = config.admission.at(self.dt_s)
        self._hold: Hold | None = None
        self._lost = True  # The smoother has to start again.
        self._heard = Heard()
        self._before: FeatureMap | None = None  # The frame before the last jump.
        self._jump_um = 0.0

    @property
    def served(self) -> FeatureMap:
        """The feature map to serve with."""
        return self.base.features if self.track is None else self.track.served

    @property
    def on_probation(self) -> bool:
        """Whether a jump was taken so recently that it may still be undone."""
        return self._before is not None and self.gates.since_jump * self.dt_s <= self._admission.undo_s

    def resync(self) -> None:
        """Forget the sequence: the next sample is taken whatever its number."""
        self.gates = admission.AdmissionState()
        self._hold, self._lost = None, True
        self._heard.clear()

    # ---- what a sample is

    def take(self, sample: Sample, voltage: Voltage) -> Taken:
        """Judge one sample; ``voltage``: what the learnt model asks for. Never raises on data."""
        c, gates, track = self._admission, self.gates, self.track
        refused = admission.check_sample(c, gates, sample, self.dt_s)
        if not refused and abs(sample.y_um - self._middle_um) > FAR_OUT * self.range_um:
            refused = admission.OUT_OF_RANGE
        if refused:
            if gates.seq >= 0 and not admission.check_sample(c, gates, replace(sample, y_um=0.0), self.dt_s):
                self._heard.put(sample)
            return Taken(refused)
        missing = sample.seq - gates.seq - 1 if gates.seq >= 0 else 0
        between, gone = self._heard.missed(gates, sample, c.max_gap) if missing else ([], False)
        self._heard.clear()
        for u in (*between, sample.u_V):
            admission.watch_voltage(c, gates, u, self.base.span_V)
        gates.seq, gates.t_s = sample.seq, sample.t_s
        gates.since_glitch += 1 + missing
        if track is None or self._lost or gone or (missing and track.motion is None):
            return self._restart(sample, admission.GAP if missing else admission.SETTLING)
        for u in between:
            self._keep(track, voltage, u, nan)
        stuck = admission.watch_reading(gates, sample.u_V, sample.y_um, self.base.span_V)
        innovation = (sample.y_um - track.predicted_um) / self.range_um
        known = track.motion is not None and not admission.settling(c, gates)
        limit = admission.surprise(c, gates, self.base.span_V)
        doubtful = (known and abs(innovation) > limit) or (stuck and track.motion is not None)
        if self._hold is None and not doubtful:
            admission.watch_innovation(c, gates, innovation)
            return Taken("", (Step(sample.y_um, sample.u_V),))
        return self._decide(sample, track, self._keep(track, voltage, sample.u_V, sample.y_um), limit, innovation)

    def _restart(self, sample: Sample, why: str) -> Taken:
        """Begin smoothing anew at a sample."""
        self._hold, self._lost = None, False
        self.gates.since_start = self.gates.since_jump = 0
        self.gates.moved = 0
        if self.track is None:
            self.track = Track.begin(self.smoother, self.base.features, self.base.features, sample.y_um)
        else:
            self.track.restart(sample.y_um)
        self.restarts += 1
        return Taken(why, (Step(sample.y_um, sample.u_V),))

    # ---- readings held back

    def _keep(self, track: Track, voltage: Voltage, u_V: float, y_um: float) -> Hold:
        """Hold a sample back; begins a hold where there is none."""
        made = Bridging(track.served, voltage, self.base.span_V / self.range_um)
        if self._hold is None:
            self._hold = surprise.begin_hold(made, track, self.gates)
        hold = self._hold
        old = replace(made, features=hold.track.served)
        hold.put(u_V, y_um, old.advance(hold.bridge, u_V))
        return hold

    def _decide(self, sample: Sample, track: Track, hold: Hold, limit: float, innovation: float) -> Taken:
        """What the last sample held back decides."""
        c, gates = self._admission, self.gates
        undone = False
        if hold.taken:
            if abs(innovation) <= limit or admission.settling(c, gates):
                admission.watch_innovation(c, gates, innovation)
                if len(hold.y_um) >= surprise.PROBATION:
                    self._hold = None
                return Taken("", (Step(sample.y_um, sample.u_V),))
            # At another level again within the probation: the sensor can't be trusted, and all is open once more.
            self.track, self._before, undone = hold.track.copy(), None, True
            gates.since_jump, gates.since_glitch = c.settle + 1, 0
            hold.taken, hold.level = False, -1
            self.undone += 1
        tolerance = limit + min(2.0 * self.doubt_V / self.base.span_V, c.glitch_share)
        trusted = gates.since_glitch * self.dt_s > c.doubt_s
        stuck_um = admission.stuck_share(gates) * self.range_um
        verdict = surprise.judge(c, hold, tolerance * self.range_um, stuck_um, self.range_um, trusted)
        if verdict is Verdict.WAIT:
            return Taken(admission.GLITCH, undone=undone)
        if verdict is Verdict.LOST:
            # Where the stage is is open, where it has turned the bridge knows best.
            assert self.track is not None
            self.track.remember(hold.bridge.memory)
            return replace(self._restart(sample, admission.GAP), undone=undone)
        if verdict is Verdict.JUMP:
            return self._take_jump(track, hold, undone)
        self._hold, back = None, verdict is Verdict.BACK
        if back and hold.worst_um > c.glitch_share * self.range_um:
            gates.since_glitch = 0
        return Taken("", surprise.steps_of_glitch(hold) if back else surprise.steps_of_motion(hold), undone=undone)

    def _take_jump(self, track: Track, hold: Hold, undone: bool) -> Taken:
        """The reading has jumped for good: place and frame move from the first sample held back on.

        No voltage made this jump, so it is none of the hysteresis'. A jump back soon after another one undoes it.
        """
        before, f = self._before, hold.track.served
        away_um, ratio = surprise.jump_of(hold)
        if before is not None and self.on_probation and abs(away_um + self._jump_um) <= BACK_SHARE * abs(away_um):
            ratio, shift_um, frame = before.gain / f.gain, before.offset_um - f.offset_um, before
            self._before, self.gates.since_glitch, undone = None, 0, True
            self.undone += 1
        else:
            ratio, shift_um, frame = surprise.frame_after(f, away_um, ratio)
            self._before, self._jump_um = f, away_um
            self.jumps += 1
        hold.taken, self.gates.since_jump = True, 0
        if self.track is not None:
            self.track.move(frame, ratio, shift_um)
        return Taken("", surprise.steps_of_jump(hold, ratio, shift_um), away_um, undone)

    @property
    def holds(self) -> bool:
        """Whether readings are held back."""
        return self._hold is not None and not self._hold.taken

    def memory_now(self, frozen: bool = False) -> FloatArray:
        """(m,) hysteresis memory of a stage that is where the last sample saw it, or must be by its voltage.

        ``frozen`` : for a model in the frame that learning began with.
        """
        assert self.track is not None
        if self._hold is not None and self.holds and not frozen:
            return self._hold.bridge.memory.copy()
        return self.track.memory_now(frozen)

    # ---- what it teaches

    def advance(self, step: Step) -> tuple[Pair | None, bool]:
        """One step of the track; see there."""
        assert self.track is not None
        self.gates.since_start += 1
        self.gates.since_jump += 1
        return self.track.advance(step)

    def to_base_frame(self) -> None:
        """Go back to the frame that learning began with, and the memory tracked in it; nothing without a jump.

        For when the model of the beginning is right again: then no jump has moved the sensor for good.
        """
        track = self.track
        if track is None or self.jumps == self.undone or track.served == self.base.features:
            return
        track.features = track.served = self.base.features
        track.memory, track.switch = track.frozen_memory.copy(), 0
        self._before, self._hold = None, None
        self.undone += 1

    def creep(self, by_um: float) -> None:
        """The stage has crept by so much, µm, that no voltage made. Not while a jump of the frame is under way."""
        if self.track is not None and not self.on_probation:
            self.track.creep(by_um)

    def rests(self, y_um: float) -> bool:
        """Whether the stage, now at ``y_um``, has not left its place for a while."""
        count = self.track.state.count if self.track is not None else 0
        return admission.at_rest(self._admission, self.gates, y_um, count, self.range_um, self.dt_s)

    # ---- keeping

    def state_dict(self) -> StateDict:
        """All of the state under flat names."""
        state = parts_to_state(self.gates, self.track, self._hold, self._before)
        state |= {"heard": self._heard.array(), "lost": self._lost, "jump_um": self._jump_um}
        return state | {"restarts": self.restarts, "jumps": self.jumps, "undone": self.undone}

    def restore(self, state: StateDict) -> None:
        """Go on from a ``state_dict``. Raises KeyError, TypeError, ValueError or InputError where it does not fit."""
        self.gates, self.track, self._hold, self._before = parts_of(self.smoother, self.base.features, state)
        self._heard.restore(state["heard"])
        self._lost, self._jump_um = bool(state["lost"]), float(state["jump_um"])
        self.restarts, self.jumps, self.undone = (int(state[name]) for name in ("restarts", "jumps", "undone"))
