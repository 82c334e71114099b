"""Check of the sensor: whether its readings follow the drive, and which fault it has if they do not.

**Always** (`Following`). The smoother does not notice a sensor that sticks with some noise, or whose gain drifts
slowly. Therefore the identified model computes the voltage p that belongs to each reading, and the steps of p are
compared with the steps of the applied voltage u. A step ends when u or p has moved far enough, well above the noise of
p. All steps have the same weight, whatever their size. Three results show a fault: the readings stand still in several
steps in a row, the slope p/u is one that no stage has, or the steps do not lie on a straight line. A step in which p
goes to and fro about u shows a stage that rings, and is left out.

**On trial** (`Trial`). Readings of a suspected sensor neither train the model nor move its frame. Dead reckoning
advances the hysteresis memory. The readings y are compared with the dead-reckoned positions x over a window of
``envelope.follow_s`` of motion:

    y = slope x + constant, share = share of the variance of y that this line explains

- Share near 1 and a slope that a stage can have: the sensor follows. Slope and constant give the change of the frame.
- Readings that hardly vary: ``sensor_stuck``. Negative slope: ``sensor_sign``. A slope that no stage has:
  ``sensor_gain``. No straight line: ``sensor_foreign``. A fault is reported after ``NAMED`` evaluations in a row have
  found it. After that the readings must be right for one more window before they are trusted again.
- A stage at rest shows nothing: the trial goes on with its motion.

Wrong dead reckoning must not exclude a good sensor. Therefore the trial also computes the voltage p of the readings.
While p follows the applied voltage u, no fault is reported. After ``OBEYED`` such windows the readings are trusted,
even if they contradict dead reckoning. A model whose dead reckoning has often been wrong judges by the voltages alone:
it cannot say where the stage is, but whether the readings move with the drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import shared
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.glitch_or_jump import Circumstances, tolerance_um
from dehyst.adaptive.online.track import Reckoning, drive_V
from dehyst.adaptive.state import Entry, Numbers
from dehyst.adaptive.types import FloatArray

# --- The check that always runs.

#: A step in which p - u goes to and fro shows ringing, not a fault: its net change is below this share of its way.
#: Changes between two pairs below this multiple of the noise of p do not count.
TO_AND_FRO, WAY_SIGMA = 0.5, 3.0
#: Smallest step, as a share of the voltage span and as a multiple of the noise of p; the larger of the two applies.
STEP_SHARE, STEP_SIGMA = 0.004, 8.0
#: Number of pairs (u, p) over which this noise is averaged.
NOISE_PAIRS = 250
#: Shortest duration of a step, s. Within it the motion becomes large compared with ringing of the stage.
STEP_S = 0.01
#: Forgetting factor for each step; fewest steps for a decision; share of the steps in which the voltage must move.
FORGET, ENOUGH, OF_VOLTAGE = 0.9, 3.4, 0.7
#: Steps slower than this share of the span per second are not used: such a voltage may just compensate creep.
CREEP_PER_S = 0.05
#: Fewest steps for a decision by the slope.
ENOUGH_SLOPE = 6.0
#: Slopes p/u that a stage can have, with hysteresis and a wrong model allowed for; smallest squared correlation.
FOLLOWING_SLOPES, FOLLOWING_STRAIGHT = (0.62, 1.6), 0.35
#: Slopes beyond this factor, up or down, that are a fault after ``ENOUGH`` steps already, if so much of the steps lies
#: on a line, and p - u changes faster than a stage can drift.
FAR_SLOPE, FAR_STRAIGHT = 2.0, 0.9
#: The stage itself drifts if p - u changes at a rate whose standard deviation is below this share of its mean; a step
#: follows if p differs from u by no more than this share. Forgetting factor of the rate for each step.
STEADY, FORGET_DRIFT = 0.35, 0.5
#: A reading stands still if p moves by less than this share of the step of u; number of such steps for a
#: fault.
STEP_STILL, STILL_STEPS = 0.2, 4
#: Good steps in a row after which all readings so far count as confirmed.
CONFIRMED = 10


class Following(Numbers):
    """Check of readings that pass the gates: sums over the last steps.

    Each step is a vector (u, p), scaled so that its larger component is 1 or -1.

    """

    u_V: Annotated[float, Entry("applied voltage at the end of the last step", "V", finite=False)] = math.nan
    p_V: Annotated[float, Entry("the model's voltage for the reading there", "V", finite=False)] = math.nan
    steps: Annotated[int, Entry("pairs since then", low=0)] = 0
    count: Annotated[float, Entry("steps, with forgetting", low=0.0)] = 0.0
    driven: Annotated[float, Entry("steps in which the voltage moved, with forgetting", low=0.0)] = 0.0
    uu: Annotated[float, Entry("sum of u² over the steps, with forgetting", low=0.0)] = 0.0
    pp: Annotated[float, Entry("sum of p² over the steps, with forgetting", low=0.0)] = 0.0
    up: Annotated[float, Entry("sum of u p over the steps, with forgetting")] = 0.0
    good: Annotated[int, Entry("steps in a row in which the readings followed", low=0)] = 0
    still: Annotated[int, Entry("steps in a row in which the readings stood still", low=0)] = 0
    last_V: Annotated[float, Entry("last p - u", "V", finite=False)] = math.nan
    noise2: Annotated[float, Entry("mean square change of p - u between two pairs", "V²", low=0.0)] = 0.0
    way_V: Annotated[float, Entry("length of the way of p - u since the end of the last step", "V", low=0.0)] = 0.0
    drift_V_per_s: Annotated[float, Entry("mean rate of p - u, with forgetting", "V/s")] = 0.0
    drift2: Annotated[float, Entry("mean square rate of p - u, with forgetting", "V²/s²", low=0.0)] = 0.0

    @shared
    def forget(self) -> None:
        """Discard all steps so far."""
        self.u_V = self.p_V = math.nan
        self.last_V, self.way_V = math.nan, 0.0
        self.steps = self.good = self.still = 0
        self.count = self.driven = self.uu = self.pp = self.up = 0.0
        self.drift_V_per_s = self.drift2 = 0.0

    @shared
    def forget_slopes(self) -> None:
        """Keep only whether the readings stand still: how far they should move is not known."""
        self.good = 0
        self.count = self.driven = self.uu = self.pp = self.up = 0.0
        self.drift_V_per_s = self.drift2 = 0.0

    @property
    def moved(self) -> bool:
        """Whether a step has just ended in which the readings did not stand still."""
        return self.steps == 0 and self.still == 0

    @shared
    def count_again(self) -> None:
        """Count the steps in which the readings followed from zero again."""
        self.good = 0

    @shared
    def take(self, u_V: float, p_V: float, span_V: float, dt_s: float, drift_V_per_s: float = 0.0) -> bool:
        """Process one pair (u, p). Returns True if the last steps show a fault.

        ``u_V`` : applied voltage. ``p_V`` : the model's voltage for the reading. ``span_V`` : range of the drive, V.
        ``dt_s`` : time between two pairs, s. ``drift_V_per_s`` : fastest drift of the stage, as a voltage, V/s.
        """
        self.steps += 1
        change_V, self.last_V = p_V - u_V - self.last_V, p_V - u_V
        if not math.isnan(change_V):
            self.noise2 += (min(change_V * change_V, 16.0 * self.noise2 + (STEP_SHARE * span_V) ** 2) - self.noise2) / (
                NOISE_PAIRS
            )
            self.way_V += abs(change_V) if change_V * change_V > WAY_SIGMA**2 * self.noise2 else 0.0
        step_V = max(STEP_SHARE * span_V, STEP_SIGMA * math.sqrt(self.noise2))
        du, dp = u_V - self.u_V, p_V - self.p_V
        if math.isnan(du) or math.isnan(dp):
            self.u_V, self.p_V, self.steps = u_V, p_V, 0
            return False
        size = max(abs(du), abs(dp))
        if size < step_V or self.steps * dt_s < STEP_S:
            return False
        step_s = self.steps * dt_s
        slow = size < CREEP_PER_S * span_V * step_s
        rings = abs(dp - du) > STEADY * size and abs(dp - du) < TO_AND_FRO * self.way_V
        self.u_V, self.p_V, self.steps, self.way_V = u_V, p_V, 0, 0.0
        if slow or rings:
            return False
        u, p = du / size, dp / size
        rate = (dp - du) / step_s
        self.drift_V_per_s += (1.0 - FORGET_DRIFT) * (rate - self.drift_V_per_s)
        self.drift2 += (1.0 - FORGET_DRIFT) * (rate * rate - self.drift2)
        self.still = self.still + 1 if abs(p) <= STEP_STILL * abs(u) else 0
        self.count = FORGET * self.count + 1.0
        self.uu = FORGET * self.uu + u * u
        self.pp = FORGET * self.pp + p * p
        self.up = FORGET * self.up + u * p
        # If the readings move without the voltage, the glitch-or-jump test decides.
        self.driven = FORGET * self.driven + (abs(u) >= STEP_STILL)
        if self.count < ENOUGH or self.driven < OF_VOLTAGE * self.count:
            return False
        fault = _shows_fault(self, abs(p - u) <= STEADY, drift_V_per_s)
        self.good = 0 if fault else self.good + 1
        return fault or self.still >= STILL_STEPS


@shared
def _shows_fault(sums: Following, follows: bool, fastest_V_per_s: float) -> bool:
    """Whether the sums show a fault. ``follows`` : whether p went with u in the last step."""
    slope, straight = sums.up / sums.uu, sums.up * sums.up / (sums.uu * sums.pp) if sums.pp > 0.0 else 0.0
    if straight < FOLLOWING_STRAIGHT:
        mean2 = sums.drift_V_per_s**2
        drifts = sums.drift2 - mean2 <= STEADY**2 * mean2 and mean2 <= fastest_V_per_s**2 and not sums.still
        if follows or drifts:
            # A steady drift beside the voltage, or the first steps after one: the stage changes, not the sensor.
            return False
        # Large pp: the readings move more than the drive explains. Something else moves the stage; no sensor fault.
        return sums.pp <= FOLLOWING_SLOPES[1] ** 2 * sums.uu
    if follows or FOLLOWING_SLOPES[0] <= slope <= FOLLOWING_SLOPES[1]:
        return False
    far = straight >= FAR_STRAIGHT and not 1.0 / FAR_SLOPE <= slope <= FAR_SLOPE
    return sums.count >= ENOUGH_SLOPE or (far and abs(sums.drift_V_per_s) > fastest_V_per_s)


class Slope(NamedTuple):
    """Least-squares line y = constant + slope x.

    std : standard deviation of the slope. residual : rms. share : share of the variance of y that the line explains,
    0 to 1. swing : standard deviation of x.
    """

    slope: float
    constant: float
    std: float
    residual: float
    share: float
    swing: float


def slope_of(x: FloatArray, y: FloatArray) -> Slope:
    """Least-squares line of (n,) values ``y`` over (n,) values ``x``; n at least 3."""
    n = x.size
    dx, dy = x - x.mean(), y - y.mean()
    xx, xy, yy = float(dx @ dx), float(dx @ dy), float(dy @ dy)
    if n < 3 or not xx > 0.0:
        return Slope(0.0, float(y.mean()), math.inf, math.sqrt(yy / max(n, 1)), 0.0, 0.0)
    slope = xy / xx
    left = max(yy - slope * xy, 0.0)
    share = slope * xy / yy if yy > 0.0 else 0.0
    std = math.sqrt(left / (n - 2) / xx)
    return Slope(slope, float(y.mean() - slope * x.mean()), std, math.sqrt(left / n), share, math.sqrt(xx / n))


def correlated(left: FloatArray) -> float:
    """Factor of the deviation of a slope whose (n,) residuals are smooth, as from ringing or a drift; at least 1.

    Values of an autoregression of first order count for fewer than they are.
    """
    alike = min(max(float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300), 0.0), 0.99)
    return math.sqrt((1.0 + alike) / (1.0 - alike))


# --- The trial of a suspected sensor.

SENSOR_STUCK = "sensor_stuck"
SENSOR_SIGN = "sensor_sign"
SENSOR_GAIN = "sensor_gain"
SENSOR_FOREIGN = "sensor_foreign"
OUT_OF_ENVELOPE = "out_of_envelope"
#: Names of sensor faults.
SENSOR_FAULTS = frozenset({SENSOR_STUCK, SENSOR_SIGN, SENSOR_GAIN, SENSOR_FOREIGN, OUT_OF_ENVELOPE})

#: Most values in the window; evaluations per window.
VALUES, LOOKS = 128, 8
#: The stage moves if the standard deviation of the position in the window is at least this share of the range and this
#: multiple of the noise of a reading.
SWING_SHARE, SWING_SIGMA = 0.003, 5.0
#: Share of the variance above which the readings follow, and above which they lie on a straight line at all.
FOLLOWS, STRAIGHT = 0.9, 0.7
#: The dead-reckoned position can be used if the stage moves by this multiple of its standard deviation. Otherwise only
#: the voltages are compared: below this share of the variance, p does not follow u.
TELLS, STRAIGHT_ALONE = 2.0, 0.4
#: Readings that vary by less than this share of the stage's motion stand still.
STILL = 0.15
#: Evaluations in a row that must find a fault before it is reported, and before a reported fault is replaced by another
#: one.
NAMED, RENAMED = 3, 24
#: A slope that differs from 1 by more than this is a change of gain. Two results agree if slopes, and positions as a
#: share of the range, differ by less.
AGREE = 0.02
#: A shift of the zero is accepted after half a window under three conditions: the shift by the identified model is
#: within these multiples of the shift by dead reckoning, the lines explain at least this share of the variance, and
#: both slopes are this close to 1.
#: Straight lines in time are taken off position and readings, and what is left must agree. It is compared where that of
#: the position is at least this multiple of the noise of a reading.
ALIKE, PLAIN, PLAIN_SLOPE, BENDS_SIGMA = (0.5, 2.5), 0.98, 0.12, 2.0
#: The model is wrong if the readings follow for this many windows without two windows that agree on slope and shift.
UNCLEAR = 6
#: Number of windows in which p must follow u; smallest share of the variance and largest slope (or its inverse) for
#: that; the same slope if dead reckoning shows a gain that the envelope does not allow; largest mean of p - u, as a
#: share of the drive's range, of readings without a change.
OBEYED, OBEYS, OBEYS_SLOPE, OBEYS_SURE, SAME_SHARE = 2, 0.8, 1.4, 1.2, 0.03
#: Time on trial by voltages alone, s, after which readings that move are trusted: the model is as likely wrong.
BY_VOLTAGES_S = 2.0


class Outcome(Enum):
    """Result of a trial."""

    OPEN = 0
    #: The readings agree with the frame before the trial, within the uncertainty of dead reckoning.
    SAME = 1
    #: The readings follow in a new frame: y = slope x + shift.
    CHANGED = 2


class Decision(NamedTuple):
    """Outcome with the new frame. credit : 1 if dead reckoning and readings agreed, negative if only the readings were
    right, else 0."""

    outcome: Outcome
    slope: float = 1.0
    shift_um: float = 0.0
    credit: int = 0


OPEN = Decision(Outcome.OPEN)


@dataclass(slots=True)
class Trial:
    """State of a trial. ``base`` : the identified model."""

    reckoning: Annotated[Reckoning, Entry("dead-reckoned position of the stage")]
    base: LssvmInverse
    memory: Annotated[FloatArray, Entry("memory of the identified model if the readings are true", "µm", "m")]
    window: Annotated[
        FloatArray,
        Entry(
            "ring of voltage u, reading y, dead-reckoned position x, and the model's voltage p for the reading",
            "V, µm, µm, V", f"4,{VALUES}", finite=False,
        ),
    ]  # fmt: skip
    fault: Annotated[str, Entry("name of the fault that is reported", among=("", *sorted(SENSOR_FAULTS)))] = ""
    why: Annotated[str, Entry("its reason", most=2000)] = ""
    count: Annotated[int, Entry("columns written to the ring", low=0)] = 0
    since: Annotated[int, Entry("samples since the trial began", low=0)] = 0
    looked: Annotated[int, Entry("the same at the last evaluation", low=0)] = 0
    suspected: Annotated[str, Entry("the fault of the last evaluation", among=("", *sorted(SENSOR_FAULTS)))] = ""
    times: Annotated[int, Entry("how often in a row it was found", low=0)] = 0
    obeyed: Annotated[int, Entry("evaluations in a row in which p followed the applied voltage")] = 0
    followed: Annotated[int, Entry("evaluations in a row in which the readings followed the position", low=0)] = 0
    agreed: Annotated[int, Entry("those in a row with the same slope and shift", low=0)] = 0
    # One window is not enough: readings of another stage move like this one's now and then.
    returned: Annotated[int, Entry("evaluations in a row, after a fault, that found the readings right", low=0)] = 0
    slope: Annotated[float, Entry("slope of the readings over the position")] = 1.0
    shift_um: Annotated[float, Entry("their shift", "µm")] = 0.0
    # They may be of another stage.
    bent: Annotated[int, Entry("1 if readings that seemed shifted bend otherwise than the position", low=0)] = 0
    by_voltages: Annotated[int, Entry("1 if the position is not believed and voltages are compared", low=0)] = 0

    @classmethod
    def begin(
        cls,
        reckoning: Reckoning,
        base: LssvmInverse,
        memory: FloatArray,
        by_voltages: bool = False,
    ) -> Trial:
        """Start a trial. ``memory`` (m,) : of the identified model ``base`` at the start.

        ``by_voltages`` : judge by the voltages alone.
        """
        return cls(reckoning, base, memory, np.zeros((4, VALUES)), by_voltages=int(by_voltages))

    def go_on_from(self, reckoning: Reckoning) -> None:
        """Continue with a better dead-reckoned position of the same instant."""
        self.reckoning = reckoning

    def put(self, u_V: float, y_um: float, now: Circumstances) -> Decision:
        """Process one sample; ``y_um`` is NaN if it has no reading."""
        position_um = self.reckoning.advance(u_V)
        self.since += 1
        samples = max(VALUES // 4, now.envelope.follow_s / now.dt_s)
        stride = max(1, math.ceil(samples / VALUES))
        if self.since % stride == 0 and not math.isnan(y_um):
            p_V = self.base.evaluate_point(y_um, 0.0, 0.0, self.memory)[0]
            self.window[:, self.count % VALUES] = u_V, y_um, position_um, p_V
            self.count += 1
        size = min(VALUES, int(samples / stride))
        # Half a window is enough to detect readings that do not follow.
        if 2 * self.count < size or (self.since - self.looked) * LOOKS < samples:
            return OPEN
        full, size = self.count >= size, min(size, self.count)
        self.looked = self.since
        last = np.arange(self.count - size, self.count) % VALUES
        u, y, x, p = self.window[:, last]
        if self.by_voltages:
            decision = self._compare_voltages(u, p, full, now)
        else:
            decision = self._evaluate(u, y, x, p, full, now)
        self.returned = self.returned + 1 if self.fault and decision.outcome is not Outcome.OPEN else 0
        return OPEN if self.fault and self.returned <= LOOKS else decision

    def _evaluate(
        self, u: FloatArray, y: FloatArray, x: FloatArray, p: FloatArray, full: bool, now: Circumstances
    ) -> Decision:
        s = slope_of(x, y)
        if s.swing < max(SWING_SHARE * now.range_um, SWING_SIGMA * now.noise_um):
            return OPEN
        voltages, off_V = slope_of(u, p), float(np.mean(p - u))
        drive = drive_V(self.base)
        obeyed = self._obeyed_by(voltages, off_V, now)
        straight, allowed = s.share >= FOLLOWS, now.envelope.gain_allows(s.slope)
        follows = straight and allowed
        off_um = float(np.mean(y - x))
        by_model_um = off_V / self.reckoning.mean_slope_V_per_um
        # Dead reckoning and the identified model show the same shift of the readings: the sensor's zero has moved.
        in_place = abs(off_um) <= tolerance_um(now, self.reckoning)
        zero_moved = follows and not in_place and ALIKE[0] <= by_model_um / off_um <= ALIKE[1]
        slope_error = max(abs(s.slope - 1.0), abs(voltages.slope - 1.0))
        usual = zero_moved and not self.fault and abs(off_um) <= now.envelope.jump * now.range_um
        plain = min(s.share, voltages.share) >= PLAIN and slope_error <= PLAIN_SLOPE
        if usual and plain and not self.bent:
            # A clear shift of usual size, without a fault so far, needs only half a window.
            self.bent = int(bends_otherwise(x, y, now.noise_um))
            if not self.bent:
                return Decision(Outcome.CHANGED, 1.0, off_um)
        fault = _fault(s, float(np.std(y)), allowed)
        if s.swing < TELLS * self.reckoning.std_um:
            # The dead-reckoned position is less certain than the motion is large: only the voltages can decide.
            alone = voltages.share < STRAIGHT_ALONE
            fault = _fault(voltages, float(np.std(p)), False, "V") if alone else ("", "")
        if not full:
            if not (obeyed or follows):
                self._suspect(*fault)
            return OPEN
        # If dead reckoning shows a gain that no stage has, the voltages must agree within a tighter limit.
        sure = allowed or not straight or 1.0 / OBEYS_SURE <= voltages.slope <= OBEYS_SURE
        self.obeyed = self.obeyed + 1 if obeyed and sure else 0
        if self.obeyed >= OBEYED * LOOKS:
            return Decision(Outcome.CHANGED, 1.0, off_um) if zero_moved else Decision(Outcome.SAME, credit=-1)
        if follows:
            if obeyed and abs(off_V) <= SAME_SHARE * drive:
                return Decision(Outcome.SAME, credit=1 if in_place else -1)
            return self._following(s, off_um, float(x[-1]), in_place, now)
        self.followed = self.agreed = 0
        if not obeyed:
            self._suspect(*fault)
        return OPEN

    def _obeyed_by(self, voltages: Slope, off_V: float, now: Circumstances) -> bool:
        """Whether p follows the applied voltage, by the line ``voltages`` of p over u and the mean of p - u, V."""
        return (
            voltages.share >= OBEYS
            and 1.0 / OBEYS_SLOPE <= voltages.slope <= OBEYS_SLOPE
            and abs(off_V) <= now.envelope.offset * drive_V(self.base)
        )

    def _compare_voltages(self, u: FloatArray, p: FloatArray, full: bool, now: Circumstances) -> Decision:
        """The decision without the dead-reckoned position. Readings that move are trusted again in any case, later."""
        voltages = slope_of(u, p)
        if voltages.swing < SWING_SHARE * drive_V(self.base):
            return OPEN
        obeyed = self._obeyed_by(voltages, float(np.mean(p - u)), now)
        spread_V = float(np.std(p))
        still = spread_V <= STILL * voltages.swing
        # The memory of the model relaxes: p may follow a straight line although the readings stand still.
        allowed = 1.0 / OBEYS_SLOPE <= voltages.slope <= OBEYS_SLOPE
        fault = _fault(voltages._replace(share=0.0) if still else voltages, spread_V, allowed, "V")
        self._suspect(*(("", "") if obeyed else fault))
        self.obeyed = self.obeyed + 1 if obeyed and full else 0
        late = self.since * now.dt_s > BY_VOLTAGES_S and not still
        return Decision(Outcome.SAME) if self.obeyed >= LOOKS or late else OPEN

    def _following(self, s: Slope, off_um: float, at_um: float, in_place: bool, now: Circumstances) -> Decision:
        """Decision for readings that follow, with the line ``s`` and the mean distance ``off_um`` at ``at_um``."""
        same_gain = abs(s.slope - 1.0) <= AGREE + 4.0 * s.std
        if same_gain and in_place:
            return Decision(Outcome.SAME, credit=1)
        slope, shift_um = (1.0, off_um) if same_gain else (s.slope, s.constant)
        # A change of the stage is the same in the next window; an error of the model depends on the position.
        self.followed += 1
        moved_um = (self.slope - slope) * at_um + self.shift_um - shift_um
        agrees = abs(self.slope - slope) <= AGREE and abs(moved_um) <= max(AGREE * now.range_um, 2.0 * now.usual_um)
        if not agrees:
            self.agreed, self.slope, self.shift_um = 0, slope, shift_um
            return Decision(Outcome.SAME, credit=-1) if self.followed >= UNCLEAR * LOOKS else OPEN
        self.agreed += 1
        return Decision(Outcome.CHANGED, slope, shift_um) if self.agreed >= LOOKS else OPEN

    def refuse(self, why: str) -> None:
        """The envelope does not allow the change that the readings show; ``why`` is the reason as text."""
        # A straight line outside of the envelope counts more than agreement with the identified model: start to count
        # the windows of agreement again, from below zero.
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


def bends_otherwise(x: FloatArray, y: FloatArray, noise: float) -> bool:
    """Whether (n,) values ``y`` bend in time, and not as the motion ``x`` does. ``noise`` : deviation of a value y.

    Over a short time two motions of the same speed are alike; what is left beside their straight lines tells them
    apart.
    """
    s, std = _of_bends(x, y)
    return s.swing > BENDS_SIGMA * noise and abs(s.slope - 1.0) > PLAIN_SLOPE + 4.0 * std


def _of_bends(x: FloatArray, y: FloatArray) -> tuple[Slope, float]:
    """The line of (n,) values ``y`` over ``x``, both less their straight lines in time, and the slope's deviation."""
    t = np.linspace(-1.0, 0.0, x.size)
    over_x, over_y = slope_of(t, x), slope_of(t, y)
    dx, dy = x - over_x.slope * t - over_x.constant, y - over_y.slope * t - over_y.constant
    s = slope_of(dx, dy)
    return s, s.std * correlated(dy - s.slope * dx)


def _fault(s: Slope, spread: float, allowed: bool, unit: str = "um") -> tuple[str, str]:
    """(name, reason as text) of the fault of readings that do not follow; empty if they show none.

    ``s`` : line of the readings over the positions (``unit`` "um"), or of the voltages p over u ("V"). ``spread`` :
    standard deviation of the readings, or of p. ``allowed`` : whether a stage can have the slope of the line. Readings
    on such a line, with too much beside it to be trusted, ring or belong to another stage: both show later.
    """
    why = f"readings move {s.slope:.3g} times as far as the voltage moves the stage, {s.share:.0%} on a straight line"
    if s.share >= STRAIGHT:
        if allowed:
            return "", ""
        return (SENSOR_SIGN if s.slope < 0.0 else SENSOR_GAIN), why
    if spread <= STILL * s.swing:
        expected = f"expected {s.swing:.3g} {unit} from the motion of the stage"
        return SENSOR_STUCK, f"readings vary by {spread:.3g} {unit} rms, {expected}"
    return SENSOR_FOREIGN, why
