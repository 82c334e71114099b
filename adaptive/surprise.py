"""Readings that surprise: a glitch of the sensor, or a jump for good? Two hypotheses until the readings tell.

From the first surprising reading on, samples are held back and teach nothing. The old level is carried on by the
bridge (``adaptive.bridge``); a reading that is near it again ends a glitch, and what lay between is bridged. Readings
that stay at one new level, by the same distance (the sensor's zero) or the same ratio (a gain), are a jump. How many it
takes depends on what is known of the sensor: few where it has not been wrong lately and the jump is of a size that a
stage makes; more after a glitch, for larger and for the smallest jumps. A jump that was taken is on probation: readings
that come back to the old level soon after, or go to a third one, take it back.

Readings that do not change at all while the voltage moves the stage are a sensor that is stuck, or at its end: they are
no level, however long they last, and the bridge goes on until the sensor shows the stage again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from adaptive.admission import REPEATED, AdmissionConfig, AdmissionState
from adaptive.bridge import SLOPES, Bridge, Bridging
from adaptive.features import FeatureMap
from adaptive.smoothing import FixedLagSmoother
from adaptive.state import prefixed, under
from adaptive.track import Step, Track
from adaptive.types import BoolArray, FloatArray, StateDict

#: Samples that are held back undecided at most, and for how many the old level is followed after a jump was taken.
MOST_HELD, PROBATION = 40, 64
#: Samples that are bridged at most while there are no readings, or only repeated ones. The hysteresis memory stays true
#: for as long, and would be wrong after a restart until the stage wipes that out.
MOST_BRIDGED = 4096
#: A jump of place that scales the displacement by less than this, or more than its inverse, is taken for an offset.
JUMP_RATIO = 0.85
#: Share of the way that the bridge has gone by which it may be wrong, and of a level by which readings may scatter.
WAY_SHARE, LEVEL_SHARE = 0.03, 0.08


class Verdict(Enum):
    """What a held reading decides: nothing yet, that it was a glitch, a jump, motion after all, or that all is lost."""

    WAIT = 0
    BACK = 1
    JUMP = 2
    MOTION = 3
    LOST = 4


@dataclass(slots=True)
class Hold:
    """Samples held back, and all that is needed to go on from before the first of them.

    bridge : the old level. track : as it was before.
    u_V, y_um, old_um : by sample: voltage, reading (NaN for none), and where it must be at the old level.
    level : index of the first reading of the present level; -1 for none. worst_um : largest distance from the old one.
    taken : whether a jump to the present level has been taken, on probation.
    last_um : the last reading, also from before the hold. same : how many in a row are equal to it; low_um, high_um :
    between what places the stage was meanwhile.
    """

    bridge: Bridge
    track: Track
    u_V: list[float] = field(default_factory=list)
    y_um: list[float] = field(default_factory=list)
    old_um: list[float] = field(default_factory=list)
    level: int = -1
    worst_um: float = 0.0
    taken: bool = False
    last_um: float = math.nan
    same: int = 0
    low_um: float = 0.0
    high_um: float = 0.0

    def put(self, u_V: float, y_um: float, old_um: float) -> None:
        """Keep one sample."""
        if y_um == self.last_um:
            self.same += 1
            self.low_um, self.high_um = min(self.low_um, old_um), max(self.high_um, old_um)
        elif not math.isnan(y_um):
            self.last_um, self.same, self.low_um, self.high_um = y_um, 1, old_um, old_um
        self.u_V.append(u_V)
        self.y_um.append(y_um)
        self.old_um.append(old_um)

    def state_dict(self) -> StateDict:
        """All of it under flat names."""
        state: StateDict = prefixed("bridge.", self.bridge.state_dict())
        state |= prefixed("track.", self.track.state_dict())
        for name in ("u_V", "y_um", "old_um"):
            state[name] = np.array(getattr(self, name), dtype=np.float64)
        names = ("level", "worst_um", "taken", "last_um", "same", "low_um", "high_um")
        return state | {name: getattr(self, name) for name in names}

    @classmethod
    def from_state(cls, smoother: FixedLagSmoother, base: FeatureMap, values: StateDict) -> Hold:
        """Inverse of ``state_dict``."""
        return cls(
            Bridge.from_state(under("bridge.", values)),
            Track.from_state(smoother, base, under("track.", values)),
            u_V=[float(x) for x in values["u_V"]],
            y_um=[float(x) for x in values["y_um"]],
            old_um=[float(x) for x in values["old_um"]],
            level=int(values["level"]),
            worst_um=float(values["worst_um"]),
            taken=bool(values["taken"]),
            last_um=float(values["last_um"]),
            same=int(values["same"]),
            low_um=float(values["low_um"]),
            high_um=float(values["high_um"]),
        )


def begin_hold(made: Bridging, track: Track, gates: AdmissionState) -> Hold:
    """A hold of what comes: the old level goes on from where ``track`` last was by readings that were believed."""
    motion, past_V, past_um = track.since_motion()
    # Readings that were repeated before that was noticed are none, nor are they an anchor.
    repeated = gates.same - 1 if gates.same >= REPEATED else 0
    track.doubt(repeated)
    hold = Hold(made.begin(motion, past_V, past_um[: max(past_um.size - repeated, 0)], track.memory), track.copy())
    if gates.same > 1:
        hold.last_um, hold.same = gates.y_um, gates.same - 1
        hold.low_um = hold.high_um = gates.y_um
    return hold


def near_old(hold: Hold, tolerance_um: float) -> bool:
    """Whether the last reading is at the old level."""
    return abs(hold.y_um[-1] - hold.old_um[-1]) <= tolerance_um + WAY_SHARE * hold.bridge.path_um


def is_stuck(hold: Hold, stuck_um: float) -> bool:
    """Whether the last readings are equal although the stage has moved: no sensor that works shows that."""
    return hold.same >= REPEATED and hold.high_um - hold.low_um > SLOPES[0] * stuck_um


def needed(config: AdmissionConfig, away_um: float, range_um: float, trusted: bool) -> int:
    """Readings at one level beyond which it is a jump."""
    usual = config.glitch_share <= abs(away_um) / range_um <= config.jump_share
    return config.glitch_persistence if trusted and usual else config.doubt_persistence


def judge(
    config: AdmissionConfig, hold: Hold, tolerance_um: float, stuck_um: float, range_um: float, trusted: bool
) -> Verdict:
    """What the last reading of a hold decides, where no jump has been taken yet. Changes ``level``.

    ``tolerance_um`` : how far from the old level a reading may be; ``stuck_um`` : how far the stage may have gone under
    readings that stay equal; ``trusted`` : the sensor has not been wrong lately.
    """
    last = len(hold.y_um) - 1
    away_um = hold.y_um[last] - hold.old_um[last]
    if np.isnan(away_um):
        return Verdict.WAIT if last + 1 < MOST_BRIDGED else Verdict.LOST
    stuck = is_stuck(hold, stuck_um)
    if not stuck and near_old(hold, tolerance_um):
        return Verdict.BACK
    hold.worst_um = max(hold.worst_um, abs(away_um))
    if stuck:
        return Verdict.WAIT if last + 1 < MOST_BRIDGED else Verdict.LOST
    if hold.level < 0 or not _same_level(hold, tolerance_um):
        hold.level = last
    count = int(np.count_nonzero(~np.isnan(hold.y_um[hold.level :])))
    if count > needed(config, away_um, range_um, trusted):
        return Verdict.JUMP
    if last + 1 < MOST_HELD:
        return Verdict.WAIT
    return Verdict.MOTION if hold.worst_um <= config.glitch_share * range_um else Verdict.LOST


def _same_level(hold: Hold, tolerance_um: float) -> bool:
    """Whether the last reading is at the level of those before, as an offset or as a gain."""
    y, old = np.array(hold.y_um[hold.level :]), np.array(hold.old_um[hold.level :])
    known = ~np.isnan(y[:-1])
    away = y - old
    mean = float(np.mean(away[:-1][known]))
    allowed = tolerance_um + LEVEL_SHARE * abs(mean)
    if abs(away[-1] - mean) <= allowed:
        return True
    place = old - hold.track.served.offset_um
    total = float(np.sum(place[:-1][known] ** 2))
    share = float(np.sum((away * place)[:-1][known])) / total if total > 0.0 else 0.0
    return bool(abs(away[-1] - share * place[-1]) <= allowed)


def jump_of(hold: Hold) -> tuple[float, float]:
    """(mean distance, µm, ratio) of the present level from the old one; the ratio is about the frame's origin."""
    y, old = np.array(hold.y_um[hold.level :]), np.array(hold.old_um[hold.level :])
    known = ~np.isnan(y)
    place = (old - hold.track.served.offset_um)[known]
    away = (y - old)[known]
    total = float(np.sum(place**2))
    ratio = 1.0 + float(np.sum(away * place)) / total if total > 0.0 else 0.0
    return float(np.mean(away)), ratio


def frame_after(frame: FeatureMap, away_um: float, ratio: float) -> tuple[float, float, FeatureMap]:
    """(ratio, shift in µm, frame) after a jump by ``away_um``: a place goes to offset + ratio (y - offset) + shift.

    One jump can't tell a gain from an offset; a gain is the likelier where there is displacement to scale. What is
    wrong about it the filter finds as the stage moves.
    """
    if JUMP_RATIO < ratio < 1.0 / JUMP_RATIO:
        return ratio, 0.0, replace(frame, gain=frame.gain * ratio)
    return 1.0, away_um, replace(frame, offset_um=frame.offset_um + away_um)


def steps_of_motion(hold: Hold) -> tuple[Step, ...]:
    """The samples held back, which were the stage's motion after all."""
    y_um = np.array(hold.y_um)
    return _steps_of(hold, y_um, np.isnan(y_um))


def steps_of_glitch(hold: Hold) -> tuple[Step, ...]:
    """The samples held back with the last reading, good again; those before are bridged, ending where it is."""
    y_um, upto = np.array(hold.y_um), len(hold.y_um) - 1
    bad = np.isnan(y_um)
    off = hold.y_um[upto] - hold.old_um[upto]
    y_um[:upto] = np.array(hold.old_um[:upto]) + off * np.arange(1, upto + 1) / (upto + 1)
    bad[:upto] = True
    return _steps_of(hold, y_um, bad)


def steps_of_jump(hold: Hold, ratio: float, shift_um: float) -> tuple[Step, ...]:
    """The samples held back with those before the new level moved there; ``ratio``, ``shift_um`` of `frame_after`."""
    f, y_um = hold.track.served, np.array(hold.y_um)
    bad = np.isnan(y_um)
    bad[: hold.level] = True
    y_um[bad] = f.offset_um + ratio * (np.array(hold.old_um)[bad] - f.offset_um) + shift_um
    return _steps_of(hold, y_um, bad)


def _steps_of(hold: Hold, y_um: FloatArray, bad: BoolArray) -> tuple[Step, ...]:
    """The samples held back as steps of the track, with (n,) places; a bad one without a place is at the old level."""
    places = np.where(np.isnan(y_um), hold.old_um, y_um)
    return tuple(Step(float(y), u, not no) for y, u, no in zip(places, hold.u_V, bad, strict=True))
