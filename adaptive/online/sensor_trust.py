"""Trust in the sensor: does it follow the drive, and what is wrong with it where it does not?

**All the time** `Following` compares readings with the drive. A sensor that sticks with some noise, or whose gain
creeps away, does not surprise the smoother. So the identified model gives the voltage p for the motion that was read,
and the steps of p are compared with the steps of the applied voltage u. A step ends when one of the two has moved far
enough, beyond the noise that readings cause in p. All steps count alike, whatever their size. A fault shows as readings
that stand still in several steps in a row, as a slope p/u that no stage has, or as steps that do not lie on a line.

**On trial** (`Trial`) readings teach nothing and move no frame. Dead reckoning carries the hysteresis memory on. The
readings y are compared with the reckoned places x over a window of ``envelope.follow_s`` of motion:

    y = slope x + constant, share = share of the variance of y that this explains

- share near 1 and a slope that a stage can have: the sensor follows. Slope and constant give the change of the frame.
- readings that hardly vary: ``sensor_stuck``; a negative slope: ``sensor_sign``; another slope: ``sensor_gain``; no
  straight line: ``sensor_foreign``. The fault is named when ``NAMED`` looks in a row have found it.
- a stage at rest shows only whether a reading is where it was before.

A wrong reckoning must not shut out a good sensor. The identified model is therefore asked for the voltage p of the
readings here too: where p follows the applied voltage u, no fault is named, and after ``OBEYED`` windows the readings
are trusted whatever the reckoning says.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from adaptive.inverse_model import LssvmInverse
from adaptive.online.dead_reckoning import Reckoning, drive_V
from adaptive.online.glitch_or_jump import Circumstances, Slope, slope_of, tolerance_um
from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, StateDict

# --- All the time.

#: Size of a step: this share of the voltage span, and this many times the noise of p.
STEP_SHARE, STEP_SIGMA = 0.004, 8.0
#: Pairs over which that noise is averaged.
NOISE_PAIRS = 250
#: Shortest time of a step, s: over it, ringing of the stage is small compared with the motion.
STEP_S = 0.01
#: Forgetting factor of a step; fewest steps for a decision; share of the steps in which the voltage must have moved.
FORGET, ENOUGH, OF_VOLTAGE = 0.9, 3.4, 0.7
#: A voltage slower than this share of the span a second may only hold a creeping stage in place.
CREEP_PER_S = 0.05
#: Fewest steps for a decision by the slope.
ENOUGH_SLOPE = 6.0
#: Slopes that a stage can have, hysteresis and a wrong model included, and the smallest squared correlation.
FOLLOWING_SLOPES, FOLLOWING_STRAIGHT = (0.62, 1.6), 0.35
#: A reading that moves by less than this share of the voltage's step stands still; number of such steps for a fault.
STEP_STILL, STILL_STEPS = 0.2, 4
#: Good steps after which the readings so far are confirmed to have followed.
CONFIRMED = 10


@dataclass(slots=True)
class Following:
    """Check of readings that raise no surprise: sums over the last steps, each a vector (u, p) whose larger part is 1.

    u_V, p_V, steps : voltage and answer of the model at the end of the last step, and number of pairs since.
    count, driven : number of steps, and of those in which the voltage moved, with forgetting as in the sums uu, pp, up.
    good, still : steps in a row in which the readings followed, and stood still.
    last_V, noise2 : last p - u, V, and mean square change of it from one pair to the next, V².
    """

    u_V: float = math.nan
    p_V: float = math.nan
    steps: int = 0
    count: float = 0.0
    driven: float = 0.0
    uu: float = 0.0
    pp: float = 0.0
    up: float = 0.0
    good: int = 0
    still: int = 0
    last_V: float = math.nan
    noise2: float = 0.0

    def forget(self) -> None:
        """Start again without history."""
        self.u_V = self.p_V = math.nan
        self.last_V = math.nan
        self.steps = self.good = self.still = 0
        self.count = self.driven = self.uu = self.pp = self.up = 0.0

    def take(self, u_V: float, p_V: float, span_V: float, dt_s: float) -> bool:
        """Take one pair: the voltage, and the model's voltage for the reading. Returns whether a fault shows.

        ``span_V`` : range of the drive, V. ``dt_s`` : time between two pairs, s.
        """
        self.steps += 1
        change_V, self.last_V = p_V - u_V - self.last_V, p_V - u_V
        if not math.isnan(change_V):
            self.noise2 += (min(change_V * change_V, 16.0 * self.noise2 + (STEP_SHARE * span_V) ** 2) - self.noise2) / (
                NOISE_PAIRS
            )
        step_V = max(STEP_SHARE * span_V, STEP_SIGMA * math.sqrt(self.noise2))
        du, dp = u_V - self.u_V, p_V - self.p_V
        if math.isnan(du) or math.isnan(dp):
            self.u_V, self.p_V, self.steps = u_V, p_V, 0
            return False
        size = max(abs(du), abs(dp))
        if size < step_V or self.steps * dt_s < STEP_S:
            return False
        slow = size < CREEP_PER_S * span_V * self.steps * dt_s
        self.u_V, self.p_V, self.steps = u_V, p_V, 0
        if slow:
            return False
        u, p = du / size, dp / size
        self.still = self.still + 1 if abs(p) <= STEP_STILL * abs(u) else 0
        self.count = FORGET * self.count + 1.0
        self.uu = FORGET * self.uu + u * u
        self.pp = FORGET * self.pp + p * p
        self.up = FORGET * self.up + u * p
        # Readings that move without the voltage are handled as glitch or jump.
        self.driven = FORGET * self.driven + (abs(u) >= STEP_STILL)
        if self.count < ENOUGH or self.driven < OF_VOLTAGE * self.count:
            return False
        fault = self._fault()
        self.good = 0 if fault else self.good + 1
        return fault or self.still >= STILL_STEPS

    def _fault(self) -> bool:
        slope, straight = self.up / self.uu, self.up * self.up / (self.uu * self.pp) if self.pp > 0.0 else 0.0
        if straight < FOLLOWING_STRAIGHT:
            # More motion than the drive explains: something else moves the stage, the sensor is not at fault.
            return self.pp <= FOLLOWING_SLOPES[1] ** 2 * self.uu
        return self.count >= ENOUGH_SLOPE and not FOLLOWING_SLOPES[0] <= slope <= FOLLOWING_SLOPES[1]

    def state_dict(self) -> StateDict:
        return asdict(self)

    @classmethod
    def from_state(cls, values: StateDict) -> Following:
        """Inverse of ``state_dict``; older states have no entries: start without history."""
        if not values:
            return cls()
        return cls(**{name: type(value)(values[name]) for name, value in asdict(cls()).items()})


# --- On trial.

SENSOR_STUCK = "sensor_stuck"
SENSOR_SIGN = "sensor_sign"
SENSOR_GAIN = "sensor_gain"
SENSOR_FOREIGN = "sensor_foreign"
OUT_OF_ENVELOPE = "out_of_envelope"
#: Names of sensor faults.
SENSOR_FAULTS = frozenset({SENSOR_STUCK, SENSOR_SIGN, SENSOR_GAIN, SENSOR_FOREIGN, OUT_OF_ENVELOPE})

#: Values in the window at most; looks a window.
VALUES, LOOKS = 128, 8
#: Standard deviation of the place in the window, as a share of the range and in deviations of a reading, from which on
#: the stage moves.
SWING_SHARE, SWING_SIGMA = 0.003, 5.0
#: Share of the variance from which on readings follow, and from which on they are a straight line at all.
FOLLOWS, STRAIGHT = 0.9, 0.7
#: Deviations of the reckoned place that the stage must move for the place to tell; where it does not, the share of the
#: variance below which the voltage of the readings does not follow the applied one.
TELLS, STRAIGHT_ALONE = 2.0, 0.4
#: Readings that vary by less than this share of the stage's motion stand still.
STILL = 0.15
#: Looks in a row that must find a fault before it is named, and before it has another name; windows at rest before
#: another level is believed.
NAMED, RENAMED, RESTED = 3, 24, 3
#: A slope so far from 1 is a change of gain; slopes so near to each other, and places as a share of the range, agree.
GAIN_STEP, AGREE = 0.02, 0.02
#: By how much the slope may be another one where motion bears out a jump that was taken back.
OPEN_SLOPE = 0.15
#: Between what shares of a change of the zero the identified model must see it too, and share of the variance and
#: distance of both slopes from 1 for which half a window is enough to believe it.
ALIKE, PLAIN, PLAIN_SLOPE = (0.5, 2.5), 0.98, 0.12
#: Windows of readings that follow, but not by the same change, after which it is the model that is wrong.
UNCLEAR = 6
#: Windows in which p must have followed the voltage; share of its variance, and slope, from which on it does; slope up
#: to which it does whatever the reckoning says; and by what share of the drive it is off where the readings are those
#: of before.
OBEYED, OBEYS, OBEYS_SLOPE, OBEYS_SURE, SAME_SHARE = 2, 0.8, 1.4, 1.2, 0.03


class Outcome(Enum):
    """Result of a trial."""

    OPEN = 0
    #: The readings are where they were, but for what the reckoning may be off.
    SAME = 1
    #: The readings follow, but y = slope x + shift is where they are now.
    CHANGED = 2


class Decision(NamedTuple):
    """credit : 1 where reckoning and readings agreed, -1 where only the readings were right, else 0."""

    outcome: Outcome
    slope: float = 1.0
    shift_um: float = 0.0
    credit: int = 0


OPEN = Decision(Outcome.OPEN)


@dataclass(slots=True)
class Trial:
    """reckoning : where the stage is. fault, why : name of what is wrong with the sensor, and the reason in
    words, "" while open.

    base, memory : the identified model, and (m,) its memory as if the readings were true.
    window : (4, VALUES) of voltage, reading, place, and the voltage that the identified model asks for at the reading,
    in the order of arrival; the next goes to ``count``. since, looked : samples since the trial began and at the last
    look. suspected, times : the last finding and how often in a row.
    rested : looks in a row with readings steady at another level. obeyed : looks in a row in which the readings have
    followed the voltage. followed, agreed : looks at which they followed the place, in a row without a fault, and of
    those in a row by the same slope and shift_um. open_slope, open_shift_um : of the jumps that were taken back when
    the trial began, 0 for none.
    """

    reckoning: Reckoning
    base: LssvmInverse
    memory: FloatArray
    window: FloatArray
    fault: str = ""
    why: str = ""
    count: int = 0
    since: int = 0
    looked: int = 0
    suspected: str = ""
    times: int = 0
    rested: int = 0
    obeyed: int = 0
    followed: int = 0
    agreed: int = 0
    slope: float = 1.0
    shift_um: float = 0.0
    open_slope: float = 0.0
    open_shift_um: float = 0.0

    @classmethod
    def begin(
        cls, reckoning: Reckoning, base: LssvmInverse, memory: FloatArray, slope: float = 0.0, shift_um: float = 0.0
    ) -> Trial:
        """``memory`` (m,) of the identified model ``base`` where the trial begins.

        ``slope``, ``shift_um``: what jumps that are taken back had made of a reading y, slope y + shift; 0 for none.
        """
        return cls(reckoning, base, memory, np.zeros((4, VALUES)), open_slope=slope, open_shift_um=shift_um)

    def put(self, u_V: float, y_um: float, now: Circumstances) -> Decision:
        """Take one sample; NaN for one without a reading."""
        place = self.reckoning.advance(u_V)
        self.since += 1
        samples = max(VALUES // 4, now.envelope.follow_s / now.dt_s)
        stride = max(1, math.ceil(samples / VALUES))
        if self.since % stride == 0 and not math.isnan(y_um):
            p_V = self.base.evaluate_point(y_um, 0.0, 0.0, self.memory)[0]
            self.window[:, self.count % VALUES] = u_V, y_um, place, p_V
            self.count += 1
        size = min(VALUES, int(samples / stride))
        # Half a window is enough to see that readings do not follow.
        if 2 * self.count < size or (self.since - self.looked) * LOOKS < samples:
            return OPEN
        whole, size = self.count >= size, min(size, self.count)
        self.looked = self.since
        last = np.arange(self.count - size, self.count) % VALUES
        u, y, x, p = self.window[:, last]
        return self._look(u, y, x, p, whole, now)

    def _look(
        self, u: FloatArray, y: FloatArray, x: FloatArray, p: FloatArray, whole: bool, now: Circumstances
    ) -> Decision:
        s = slope_of(x, y)
        if s.swing < max(SWING_SHARE * now.range_um, SWING_SIGMA * now.noise_um):
            return self._at_rest(x, y, now) if whole else OPEN
        self.rested = 0
        obeys, off_V = slope_of(u, p), float(np.mean(p - u))
        drive = drive_V(self.base)
        obeyed = (
            obeys.share >= OBEYS
            and 1.0 / OBEYS_SLOPE <= obeys.slope <= OBEYS_SLOPE
            and abs(off_V) <= now.envelope.offset * drive
        )
        straight, allowed = s.share >= FOLLOWS, now.envelope.gain_allows(s.slope)
        follows = straight and allowed
        if self.open_slope and self._bears_out(s, x, y, now):
            return Decision(Outcome.CHANGED, self.open_slope, self.open_shift_um)
        off_um = float(np.mean(y - x))
        by_model_um = off_V / self.reckoning.mean_slope_V_per_um
        # Off the place, and the identified model says so too: then the zero has moved, and both are right.
        there = abs(off_um) <= tolerance_um(now, self.reckoning)
        moved = follows and not there and ALIKE[0] <= by_model_um / off_um <= ALIKE[1]
        off_line = max(abs(s.slope - 1.0), abs(obeys.slope - 1.0))
        plain = moved and not self.fault and abs(off_um) <= now.envelope.jump * now.range_um
        if plain and min(s.share, obeys.share) >= PLAIN and off_line <= PLAIN_SLOPE:
            # As clear as this, half a window is enough: a change of usual size, and no fault found so far.
            return Decision(Outcome.CHANGED, 1.0, off_um)
        wrong = _fault(s, float(np.std(y)))
        if s.swing < TELLS * self.reckoning.std_um:
            # A place that is not known better than the stage moves tells nothing; the voltage alone must.
            wrong = _fault(obeys, float(np.std(p)), "V") if obeys.share < STRAIGHT_ALONE else ("", "")
        if not whole:
            if not (obeyed or follows):
                self._suspect(*wrong)
            return OPEN
        # Where the readings are the reckoned place but for a gain that no stage has, the answer must be quite right.
        sure = allowed or not straight or 1.0 / OBEYS_SURE <= obeys.slope <= OBEYS_SURE
        self.obeyed = self.obeyed + 1 if obeyed and sure else 0
        if self.obeyed >= OBEYED * LOOKS:
            return Decision(Outcome.CHANGED, 1.0, off_um) if moved else Decision(Outcome.SAME, credit=-1)
        if follows:
            if obeyed and abs(off_V) <= SAME_SHARE * drive:
                return Decision(Outcome.SAME, credit=1 if there else -1)
            return self._following(s, off_um, float(x[-1]), there, now)
        self.followed = self.agreed = 0
        if not obeyed:
            self._suspect(*wrong)
        return OPEN

    def _bears_out(self, s: Slope, x: FloatArray, y: FloatArray, now: Circumstances) -> bool:
        """Whether motion now bears out the jumps that were taken back: the readings are where they would be by them."""
        off_um = float(np.mean(y - self.open_slope * x - self.open_shift_um))
        alike = abs(s.slope / self.open_slope - 1.0) <= OPEN_SLOPE
        return s.share >= FOLLOWS and alike and abs(off_um) <= tolerance_um(now, self.reckoning)

    def _following(self, s: Slope, off_um: float, at_um: float, there: bool, now: Circumstances) -> Decision:
        near = abs(s.slope - 1.0) <= GAIN_STEP + 4.0 * s.std
        if near and there:
            return Decision(Outcome.SAME, credit=1)
        slope, shift_um = (1.0, off_um) if near else (s.slope, s.constant)
        # A change of the stage is the same in the next window; an error of the model differs from place to place.
        self.followed += 1
        moved_um = (self.slope - slope) * at_um + self.shift_um - shift_um
        agrees = abs(self.slope - slope) <= AGREE and abs(moved_um) <= max(AGREE * now.range_um, 2.0 * now.usual_um)
        if not agrees:
            self.agreed, self.slope, self.shift_um = 0, slope, shift_um
            return Decision(Outcome.SAME, credit=-1) if self.followed >= UNCLEAR * LOOKS else OPEN
        self.agreed += 1
        return Decision(Outcome.CHANGED, slope, shift_um) if self.agreed >= LOOKS else OPEN

    def _at_rest(self, x: FloatArray, y: FloatArray, now: Circumstances) -> Decision:
        """A stage that does not move: readings that are back where they were, or steady somewhere near."""
        off, spread = float(np.mean(y - x)), float(np.std(y - x))
        steady = spread <= max(3.0 * now.noise_um, 0.5 * now.usual_um)
        if steady and not self.fault and abs(off) <= tolerance_um(now, self.reckoning):
            return Decision(Outcome.SAME)
        near = steady and not self.fault and abs(off) <= now.envelope.jump * now.range_um
        self.rested = self.rested + 1 if near else 0
        if self.rested >= RESTED * LOOKS:
            return Decision(Outcome.CHANGED, 1.0, off)
        return OPEN

    def refuse(self, why: str) -> None:
        """The envelope refuses the change that the readings show."""
        # Straight lines outside tell more than the identified model's answer.
        self.obeyed = -OBEYED * LOOKS
        self._suspect(OUT_OF_ENVELOPE, why)

    def _suspect(self, fault: str, why: str) -> None:
        if not fault:
            self.suspected, self.times = "", 0
            return
        self.times = self.times + 1 if fault == self.suspected else 1
        self.suspected = fault
        if self.times >= (RENAMED if self.fault else NAMED):
            self.fault, self.why = fault, why

    def state_dict(self) -> StateDict:
        """All of it under flat names."""
        own = {name: getattr(self, name) for name in _NUMBERS}
        return {
            **own,
            "memory": self.memory.copy(),
            "window": self.window.copy(),
            **prefixed("reckoning.", self.reckoning.state_dict()),
        }

    @classmethod
    def from_state(cls, values: StateDict, base: LssvmInverse) -> Trial:
        """Inverse of ``state_dict``, but for ``base``.

        Raises KeyError, TypeError or ValueError where it does not fit.
        """
        window = np.array(values["window"], dtype=np.float64)
        if window.shape != (4, VALUES):
            raise ValueError(f"trial.window: got shape {window.shape}, expected (4, {VALUES})")
        # Older states have no jumps that were taken back.
        values = {"open_slope": 0.0, "open_shift_um": 0.0} | values
        numbers: dict[str, Any] = {name: kind(values[name]) for name, kind in _NUMBERS.items()}
        memory = np.array(values["memory"], dtype=np.float64)
        return cls(Reckoning.from_state(under("reckoning.", values)), base, memory, window, **numbers)


_NUMBERS = {
    "fault": str, "why": str, "count": int, "since": int, "looked": int, "suspected": str, "times": int, "rested": int,
    "obeyed": int, "followed": int, "agreed": int, "slope": float, "shift_um": float,
    "open_slope": float, "open_shift_um": float,
}  # fmt: skip


def _fault(s: Slope, spread: float, unit: str = "um") -> tuple[str, str]:
    """(name, why in words) of what readings do that do not follow: ``s`` of the readings over the places, in ``unit``;
    in V that of the voltages that they ask for over those applied. ``spread`` : rms of the first."""
    why = f"readings go {s.slope:.3g} times as far as the voltage must have moved the stage, {s.share:.0%} on a line"
    if s.share >= STRAIGHT:
        return (SENSOR_SIGN if s.slope < 0.0 else SENSOR_GAIN), why
    if spread <= STILL * s.swing:
        must = f"where the stage must have by {s.swing:.3g} {unit}"
        return SENSOR_STUCK, f"readings vary by {spread:.3g} {unit} rms {must}"
    return SENSOR_FOREIGN, why
