"""Readings far from the prediction: a glitch, ringing after a shock, a lasting jump, or a fault of the sensor?

From the first such reading on, samples are held back and not learnt. Dead reckoning continues from before it
(``adaptive.online.dead_reckoning``). `judge` decides by the distances of the readings from the reckoned place:

- back at the old level for ``CALM_S``: a glitch or a shock that is over;
- ringing about the old level: motion of the stage; wait until it ends;
- settled at a new level, by a distance or by a ratio that a jump may have: a jump, if the readings have moved that far
  and still follow the stage;
- anything else after ``UNDECIDED_S``: the sensor goes on trial (``adaptive.online.sensor_trust``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from adaptive.compiled import compiled
from adaptive.features import FeatureMap
from adaptive.online.dead_reckoning import SLOPES, Reckoning
from adaptive.online.envelope import EnvelopeConfig
from adaptive.online.gates import REPEATED, AdmissionConfig
from adaptive.online.track import Step
from adaptive.state_codec import prefixed, under
from adaptive.types import BoolArray, FloatArray, StateDict

# --- The level of a run of readings. The distances r(k) of the readings from the reckoned place are fitted by:
#
# - a level with ringing on it: r(k) = sum a_i r(k-i) + c + noise. A mode of the stage obeys this exactly with two
#   coefficients, with a lag or a second mode three and four; without any it is a plain level. The level is
#   c/(1 - sum a_i), its deviation follows from the covariance of the fit. Ringing of any frequency therefore is no
#   level: after a shock the level is zero, however large the swing.
# - the same of the shares r(k)/place(k): a change of the gain.
# - a straight line: a drift under way.
#
# The fit with the best Bayesian information criterion is taken. It decides only where the level is ``SIGMA`` deviations
# outside the usual distance, or as many inside. Measured error rates: docs/learner.md.


#: Most coefficients of ringing.
ORDERS = 4
#: Deviations between a level and a limit for a decision.
SIGMA = 5.0
#: A recursion whose sum of coefficients is nearer to 1 than this has no level.
NO_LEVEL = 0.05
#: Values that a fit needs beyond two for each coefficient.
SPARE = 4


class Level(NamedTuple):
    """The level at which readings settle.

    Attributes
    ----------
    at, std : level at the last reading and its standard deviation, in the unit of the readings; infinite deviation
    where there is none. residual : rms of what the fit leaves. order : coefficients of ringing.
    rate : change of the level from one reading to the next.
    """

    at: float
    std: float
    residual: float
    order: int
    rate: float


def level_of(r: FloatArray, noise: float, drifts: bool = False) -> Level:
    """The level of (n,) distances whose usual deviation is ``noise`` (above 0), in their unit.

    ``drifts`` : a straight line in place of a constant. Fewer than six values have no level.
    """
    out = np.array([math.nan, math.inf, math.inf, 0.0, 0.0])
    # In units of its own size, so that no sum depends on the unit.
    size = max(float(np.max(np.abs(r), initial=0.0)), noise)
    _fit(np.ascontiguousarray(r, dtype=np.float64) / size, noise / size, drifts, out)
    return Level(float(out[0]) * size, float(out[1]) * size, float(out[2]) * size, int(out[3]), float(out[4]) * size)


@compiled
def _fit(r: FloatArray, noise: float, drifts: bool, out: FloatArray) -> None:  # pragma: no cover - compiled
    """Best order by the information criterion; ``out`` is [level, deviation, residual, order, rate]."""
    n = r.shape[0]
    best = math.inf
    extra = 2 if drifts else 1
    for p in range(ORDERS + 1):
        rows, k = n - p, p + extra
        if rows < 2 * k + SPARE:
            break
        X = np.empty((rows, k))
        for i in range(rows):
            for j in range(p):
                X[i, j] = r[p + i - 1 - j]
            X[i, p] = 1.0
            if drifts:
                # Counted backwards from the last reading, so that the constant is the level there.
                X[i, p + 1] = float(i - rows + 1)
        z = r[p:]
        normal = X.T @ X
        ridge = 1e-13 * np.trace(normal)
        for j in range(k):
            normal[j, j] += ridge + 1e-300
        inverse = np.linalg.inv(normal)
        theta = inverse @ (X.T @ z)
        error = z - X @ theta
        variance = float(error @ error) / (rows - k)
        gone, squares = 1.0, 1.0
        lagged = 0.0
        for j in range(p):
            gone -= theta[j]
            squares += theta[j] * theta[j]
            lagged += theta[j] * (j + 1)
        # Noise of the readings passes through the recursion; no fit is better than that.
        told = rows * math.log(variance + 0.3 * noise * noise * squares) + k * math.log(float(rows))
        told /= rows
        if not told < best:
            continue
        best = told
        out[2], out[3] = math.sqrt(variance), float(p)
        if gone < NO_LEVEL:
            out[0], out[1], out[4] = math.nan, math.inf, 0.0
            continue
        rate = theta[p + 1] / gone if drifts else 0.0
        # With a line, r = level + rate i: the recursion shifts it by what its lags are of the rate.
        level = (theta[p] - rate * lagged) / gone
        gradient = np.zeros(k)
        for j in range(p):
            gradient[j] = level / gone
        gradient[p] = 1.0 / gone
        spread = float(gradient @ inverse @ gradient)
        out[0], out[4] = level, rate
        out[1] = math.sqrt(max(variance, noise * noise) * max(spread, 0.0))


class Slope(NamedTuple):
    """A straight line y = constant + slope x: by least squares. std : of the slope. residual : rms. share : of the
    variance of y that it explains, 0 to 1. swing : standard deviation of x."""

    slope: float
    constant: float
    std: float
    residual: float
    share: float
    swing: float


def slope_of(x: FloatArray, y: FloatArray) -> Slope:
    """Straight line of (n,) values ``y`` over (n,) values ``x``; n at least 3."""
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


#: Readings in a row at the expected level that end a hold, at least.
BACK_AGAIN = 2
#: Samples without any reading, or with repeated ones, that are bridged at most.
MOST_BRIDGED = 4096
#: Time for which undecided readings are held, and ringing about the old level, s; samples of the first at least.
UNDECIDED_S, RINGING_S, UNDECIDED_SAMPLES = 0.04, 0.6, 40
#: A jump of place that scales the displacement by less than this, or more than its inverse, is taken for an offset.
JUMP_RATIO = 0.85
#: Share of the way gone by which the old level may be missed, and the most that this allows, as a share of the range.
WAY_SHARE, WAY_MOST = 0.03, 0.02
#: Deviation of a level, as a share of it and of what is usual, beyond which it is not yet known.
LEVEL_STD, USUAL_STD = 0.03, 0.3
#: Values that a level is worked out from at most, and the shortest time between two of them, s: noise hides the
#: curvature of a mode between readings that follow each other faster.
VALUES, SPACING_S = 64, 5e-4
#: Time that readings at a new level must span, s: a glitch of the sensor's electronics lasts some milliseconds.
SPAN_S = 0.008
#: Sizes of the windows, in such values, that are tried beside the longest.
WINDOWS = (28, 16)
#: Time for which a reading repeats itself under a stage that moves, s, after which it is no lost sample but a fault.
STUCK_S = 0.1
#: Time for which readings must be where they must be, s.
CALM_S = 0.005
#: Share of a level that drifts at which its first reading may have been, and how much faster than with the stage, in
#: proportion to the place, it may drift beyond that.
BEGUN, WITH_STAGE = 0.6, 2.0
#: Between what slopes readings follow the stage, and the stage's way from which on that is asked, as a share of the
#: range, for a jump, and to lose the trust without waiting.
FOLLOWING, MOTION_SHARE, SHOWN_SHARE = (0.6, 1.7), 0.004, 0.015


class Verdict(Enum):
    """Decision after a held reading."""

    WAIT = 0
    BACK = 1
    JUMP = 2
    MOTION = 3
    LOST = 4


class Circumstances(NamedTuple):
    """Limits and units by which the readings of a hold are judged.

    Attributes
    ----------
    config, envelope : limits. dt_s : sample time. range_um : of the model.
    noise_um : usual deviation of a reading from the smoother's prediction. usual_um : distance up to which a reading is
    no surprise. stuck_um : way of the stage under readings that stay equal, from which on they are no chance.
    rest_um : reading of the stage at rest without voltage. low_um, high_um : readings at the ends of the range in which
    the model is known. trusted : the sensor has not been wrong lately.
    """

    config: AdmissionConfig
    envelope: EnvelopeConfig
    dt_s: float
    range_um: float
    noise_um: float
    usual_um: float
    stuck_um: float
    rest_um: float
    low_um: float
    high_um: float
    trusted: bool


@dataclass(slots=True)
class Hold:
    """Samples held back, and the quantities that judge them.

    reckoning : of the place meanwhile. last_um : the last trusted reading.
    u_V, y_um, old_um : by sample: voltage, reading (NaN for none), and where it must be without any change.
    slope, shift_um : after the jumps taken so far a reading must be at slope old + shift.
    jumped : number of samples at the last of them, 0 for none. silent : number of samples at the last one without a
    reading of its own.
    level, away_um : of the level that ``judge`` has found: number of its first reading, and its distance.
    seen_um : largest distance from where readings must be. good : readings in a row where they must be.
    rang : number of samples when the readings were last found to swing about that, 0 for never.
    same_um, same, low_um, high_um : last reading, how many in a row are equal to it, and between what places the stage
    was meanwhile.
    """

    reckoning: Reckoning
    last_um: float
    u_V: list[float] = field(default_factory=list)
    y_um: list[float] = field(default_factory=list)
    old_um: list[float] = field(default_factory=list)
    slope: float = 1.0
    shift_um: float = 0.0
    jumped: int = 0
    silent: int = 0
    level: int = 0
    away_um: float = 0.0
    seen_um: float = 0.0
    good: int = 0
    rang: int = 0
    same_um: float = math.nan
    same: int = 0
    low_um: float = 0.0
    high_um: float = 0.0

    def put(self, u_V: float, y_um: float) -> None:
        """Keep one sample, and advance the reckoned place."""
        old_um = self.reckoning.advance(u_V)
        if y_um == self.same_um:
            self.same += 1
            self.low_um, self.high_um = min(self.low_um, old_um), max(self.high_um, old_um)
        elif not math.isnan(y_um):
            self.same_um, self.same, self.low_um, self.high_um = y_um, 1, old_um, old_um
        self.u_V.append(u_V)
        self.y_um.append(y_um)
        self.old_um.append(old_um)
        if math.isnan(y_um):
            self.silent = len(self.y_um)

    @property
    def taken(self) -> bool:
        """Whether a jump has been taken."""
        return self.jumped > 0

    @property
    def expected_um(self) -> float:
        """Expected value of the last reading, µm."""
        return self.slope * self.old_um[-1] + self.shift_um

    def take(self, slope: float, shift_um: float) -> None:
        """A jump, from where readings have been up to now: to slope y + shift."""
        self.slope, self.shift_um = slope * self.slope, slope * self.shift_um + shift_um
        self.jumped, self.good, self.rang = len(self.y_um), 0, 0

    def state_dict(self) -> StateDict:
        """All of it under flat names."""
        state: StateDict = prefixed("reckoning.", self.reckoning.state_dict())
        for name in ("u_V", "y_um", "old_um"):
            state[name] = np.array(getattr(self, name), dtype=np.float64)
        return state | {name: getattr(self, name) for name in _NUMBERS}

    @classmethod
    def from_state(cls, values: StateDict) -> Hold:
        """Inverse of ``state_dict``. Raises KeyError, TypeError or ValueError where it does not fit."""
        kept: dict[str, Any] = {name: [float(x) for x in values[name]] for name in ("u_V", "y_um", "old_um")}
        kept |= {name: kind(values[name]) for name, kind in _NUMBERS.items()}
        return cls(Reckoning.from_state(under("reckoning.", values)), **kept)


_NUMBERS: dict[str, Callable[[Any], Any]] = {
    "last_um": float, "slope": float, "shift_um": float, "jumped": int, "silent": int, "level": int, "away_um": float,
    "seen_um": float, "good": int, "rang": int, "same_um": float, "same": int, "low_um": float, "high_um": float,
}  # fmt: skip


def is_stuck(hold: Hold, stuck_um: float) -> bool:
    """Whether the last readings are equal although the stage has moved: the sensor is stuck."""
    return hold.same >= REPEATED and hold.high_um - hold.low_um > SLOPES[0] * stuck_um


def tolerance_um(now: Circumstances, reckoning: Reckoning) -> float:
    """Largest distance of a good reading from the reckoned place, µm; it grows with the way gone."""
    way_um = min(WAY_SHARE * reckoning.way_um, WAY_MOST * now.range_um)
    return now.usual_um + way_um + reckoning.std_um


def needed(config: AdmissionConfig, away_um: float, range_um: float, trusted: bool) -> int:
    """Readings at one level beyond which it may be a jump."""
    usual = config.glitch_share <= abs(away_um) / range_um <= config.jump_share
    return config.glitch_persistence if trusted and usual else config.doubt_persistence


def judge(hold: Hold, now: Circumstances) -> Verdict:
    """Decide by the last sample of a hold. Updates the hold; for JUMP also its ``level`` and ``away_um``."""
    n = len(hold.y_um)
    away_um = hold.y_um[-1] - hold.expected_um
    if math.isnan(away_um):
        return Verdict.WAIT if n < MOST_BRIDGED else Verdict.LOST
    stuck = is_stuck(hold, now.stuck_um)
    if not stuck and abs(away_um) <= tolerance_um(now, hold.reckoning):
        hold.good += 1
        # At once where the voltage explains what surprised the smoother, and after a single wrong reading; a stage that
        # rings passes by its place again and again.
        enough = max(BACK_AGAIN, round(CALM_S / now.dt_s))
        return Verdict.BACK if hold.good >= enough or n <= 2 else Verdict.WAIT
    hold.good = 0
    hold.seen_um = max(hold.seen_um, abs(away_um))
    if stuck:
        hold.silent = n
        shown = hold.same * now.dt_s >= STUCK_S and hold.high_um - hold.low_um > SHOWN_SHARE * now.range_um
        return Verdict.LOST if shown or n >= MOST_BRIDGED else Verdict.WAIT
    if hold.reckoning.lost:
        return Verdict.LOST
    # Readings that clearly do not follow the stage: the sensor is wrong, no need to wait.
    if n * now.dt_s >= SPAN_S and n >= 10 and not _follow(hold, min(n, round(2 * SPAN_S / now.dt_s)), now, SHOWN_SHARE):
        return Verdict.LOST
    stride = max(1, round(SPACING_S / now.dt_s))
    if n % stride == 0:
        found = _level(hold, now, stride)
        if found is not None:
            return found
    # Without readings, or with repeated ones, nothing could be decided.
    waited = n - max(hold.jumped, hold.silent)
    if hold.rang and (n - hold.rang) * now.dt_s <= 0.5 * UNDECIDED_S:
        return Verdict.WAIT if waited * now.dt_s < RINGING_S else Verdict.MOTION
    if waited < max(UNDECIDED_SAMPLES, UNDECIDED_S / now.dt_s):
        return Verdict.WAIT
    small = hold.seen_um <= now.config.glitch_share * now.range_um
    return Verdict.MOTION if small and not hold.taken and _follow(hold, n, now) else Verdict.LOST


def _level(hold: Hold, now: Circumstances, stride: int) -> Verdict | None:
    """JUMP or WAIT where the readings have settled on a level or about the old one; None where they have not."""
    y, old = np.array(hold.y_um), hold.slope * np.array(hold.old_um) + hold.shift_um
    none = np.flatnonzero(np.isnan(y))
    first = int(none[-1]) + 1 if none.size else 0
    first = max(first, y.size - VALUES * stride)
    usual_um = tolerance_um(now, hold.reckoning)
    for count in dict.fromkeys((y.size - first, *(size * stride for size in WINDOWS))):
        count -= count % stride
        if count < stride * 6 or count > y.size - first:
            continue
        part = slice(y.size - count, None)
        r, place = _spaced(y[part] - old[part], stride), _spaced(old[part] - now.rest_um, stride)
        noise = now.noise_um / math.sqrt(stride)
        levels = [level_of(r, noise)]
        if np.min(np.abs(place)) > 0.1 * now.range_um:
            share = level_of(r / place * place[-1], noise)
            if share.residual <= levels[0].residual:
                levels.insert(0, share)
        moving = level_of(r, noise, drifts=True)
        # Where nothing else is known a line is: a frame that is not quite right moves slowly under the ringing.
        level = next((one for one in (*levels, moving) if _known(one, usual_um)), None)
        if level is None:
            continue
        if abs(level.at) + SIGMA * level.std < usual_um:
            # About the old level. A glitch that alternates looks like that too: it teaches as little.
            hold.rang = y.size
            return Verdict.WAIT
        if level is moving and not _drifts(level, hold, count, now, stride):
            continue
        if _is_jump(level, hold, count, r, usual_um, now):
            hold.away_um, hold.level = level.at, y.size - count
            return Verdict.JUMP
    return None


def _spaced(x: FloatArray, stride: int) -> FloatArray:
    """Means of ``stride`` neighbours each: ringing stays ringing, noise becomes less."""
    return x if stride == 1 else x.reshape(-1, stride).mean(axis=1)


def _known(level: Level, usual_um: float) -> bool:
    return level.std <= max(LEVEL_STD * abs(level.at), USUAL_STD * usual_um)


def _drifts(level: Level, hold: Hold, count: int, now: Circumstances, stride: int) -> bool:
    """Whether a level that moves may be a drift of the stage: slow enough, and not a sensor that stands still."""
    rate = abs(level.rate) / (stride * now.dt_s)
    own = abs(hold.old_um[-1] - hold.old_um[-count]) / (count * now.dt_s)
    # What drifts begins where it was: readings that are elsewhere at once and then go on from there are no drift. But
    # the step that a gain makes moves with the stage.
    place_um = max(abs(hold.old_um[-1] - now.rest_um), 0.1 * now.range_um)
    begun_um = hold.y_um[hold.jumped] - hold.slope * hold.old_um[hold.jumped] - hold.shift_um
    if abs(begun_um) > BEGUN * abs(level.at) and rate > WITH_STAGE * own * abs(level.at) / place_um:
        return False
    follows = slope_of(np.array(hold.old_um[-count:]), np.array(hold.y_um[-count:]))
    shown = follows.slope - 2.0 * follows.std > 0.5
    return rate <= now.envelope.drift_per_s * now.range_um and (shown or own < 0.3 * rate)


def _is_jump(level: Level, hold: Hold, count: int, r: FloatArray, usual_um: float, now: Circumstances) -> bool:
    """Whether a level is one to believe: beyond doubt, long enough, of a size that a stage has, and shown."""
    away = abs(level.at)
    # Outside the identified range the model itself may be off by as much.
    if not now.low_um <= hold.expected_um <= now.high_um:
        return False
    if away - usual_um <= SIGMA * level.std or away > now.envelope.jump * now.range_um:
        return False
    if count <= needed(now.config, level.at, now.range_um, now.trusted) or count * now.dt_s < SPAN_S:
        return False
    # It claims no more than what the readings themselves are away by, nor more than they have moved.
    spread = 3.0 * now.noise_um
    if not float(r.min()) - spread <= level.at <= float(r.max()) + spread:
        return False
    readings = np.array(hold.y_um)
    moved = float(np.nanmax(np.abs(readings - hold.last_um))) + hold.reckoning.way_um + now.usual_um
    # A sensor that stands still looks settled over a short while: all readings since the surprise are asked.
    return away <= moved and _follow(hold, count, now) and _follow(hold, readings.size - hold.jumped, now)


def _follow(hold: Hold, count: int, now: Circumstances, share: float = MOTION_SHARE) -> bool:
    """Whether the last ``count`` readings go where the stage goes; if it moves by ``share`` of the range, or more."""
    x, y = np.array(hold.old_um[-count:]), np.array(hold.y_um[-count:])
    good = ~np.isnan(y)
    x, y = x[good], y[good]
    if x.size < 6 or np.ptp(x) < max(share * now.range_um, 8.0 * now.noise_um):
        return True
    s = slope_of(x, y)
    low, high = FOLLOWING
    return not (s.slope + 4.0 * s.std < low or s.slope - 4.0 * s.std > high)


def jump_after(frame: FeatureMap, at_um: float, away_um: float) -> tuple[float, float]:
    """(slope, shift in µm) of a jump by ``away_um`` at ``at_um``: a reading goes to slope y + shift.

    One jump cannot tell a gain from an offset. A gain about the rest position is assumed where there is displacement to
    scale; the filter corrects it as the stage moves.
    """
    rest_um = frame.offset_um + frame.gain * frame.y_rest_um
    place = at_um - rest_um
    ratio = 1.0 + away_um / place if place else math.inf
    if JUMP_RATIO < ratio < 1.0 / JUMP_RATIO:
        return ratio, (1.0 - ratio) * rest_um
    return 1.0, away_um


def frame_after(frame: FeatureMap, slope: float, shift_um: float) -> FeatureMap:
    """The frame in which readings that went to slope y + shift are the same displacements."""
    return replace(frame, gain=slope * frame.gain, offset_um=slope * frame.offset_um + shift_um)


def steps_of_motion(hold: Hold) -> tuple[Step, ...]:
    """The samples held back, which were the stage's motion after all."""
    y_um = np.array(hold.y_um)
    return _steps_of(hold, y_um, np.isnan(y_um))


def steps_of_hold(hold: Hold, usual_um: float) -> tuple[Step, ...]:
    """The samples held back when readings are again where they must be: those before are bridged, ending there."""
    y_um, n = np.array(hold.y_um), len(hold.y_um)
    places = hold.slope * np.array(hold.old_um) + hold.shift_um
    good = ~np.isnan(y_um)
    if hold.taken:
        # Readings at the new level are as good as any; those on the way to it, or ringing, are not.
        good &= (np.arange(n) >= hold.level) & (np.abs(y_um - places) <= usual_um)
        return _steps_of(hold, np.where(good, y_um, places), ~good)
    upto = n - max(hold.good, 1)
    off = y_um[-1] - places[-1]
    bridged = places + off * np.minimum(np.arange(1, n + 1) / (upto + 1), 1.0)
    good[:upto] = False
    return _steps_of(hold, np.where(good, y_um, bridged), ~good)


def _steps_of(hold: Hold, y_um: FloatArray, bad: BoolArray) -> tuple[Step, ...]:
    """The samples held back as steps of the track, with (n,) places; a bad one without a place is where it must be."""
    places = np.where(np.isnan(y_um), hold.slope * np.array(hold.old_um) + hold.shift_um, y_um)
    return tuple(Step(float(y), u, not no) for y, u, no in zip(places, hold.u_V, bad, strict=True))
