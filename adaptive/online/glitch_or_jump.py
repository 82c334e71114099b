"""Classify readings far from the prediction: glitch, ringing after a shock, lasting jump, or sensor fault.

From the first such reading on, samples are held and not learnt. Dead reckoning continues from the sample before it
(``adaptive.online.track``). `judge` decides by the distances of the readings from the dead-reckoned position:

- back at the old level for ``CALM_S``: a glitch or a shock that is over;
- ringing about the old level: motion of the stage; wait until it ends;
- settled at a new level, at a distance or ratio that the envelope allows: a jump, if the readings have moved that far
  and still follow the stage;
- anything else after ``UNDECIDED_S``: the sensor goes on trial (``adaptive.online.sensor_trust``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Annotated, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.online.gates import AdmissionConfig, EnvelopeConfig
from dehyst.adaptive.online.track import Reckoning, Step
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import BoolArray, FloatArray

# --- The level at which readings settle. The distances r(k) of the readings from the dead-reckoned position are fitted:
#
# - a constant level with ringing: r(k) = sum a_i r(k-i) + c + noise. One mode of the stage satisfies this exactly with
#   two coefficients; a lag or a second mode needs three or four; no coefficients give a constant. The level is
#   c/(1 - sum a_i); its standard deviation follows from the covariance of the fit. Ringing of any frequency does not
#   shift the level: after a shock the level is zero, however large the amplitude.
# - the same for the ratios r(k)/position(k): a change of the gain.
#
# The order with the best Bayesian information criterion is used. A level counts as inside or outside of the tolerance
# only if it is ``SIGMA`` standard deviations away from the limit. Measured error rates: docs/learner.md.


#: Most coefficients for ringing.
ORDERS = 4
#: Standard deviations between a level and a limit that a decision needs.
SIGMA = 5.0
#: If 1 minus the sum of the coefficients is smaller than this, the recursion has no level.
NO_LEVEL = 0.05
#: Rows that a fit needs in addition to two per coefficient.
SPARE = 4


class Level(NamedTuple):
    """The level at which readings settle, in their unit.

    Attributes
    ----------
    at, std : level at the last reading and its standard deviation; infinite if there is no level.
    residual : rms of the residual of the fit. order : number of ringing coefficients.
    """

    at: float
    std: float
    residual: float
    order: int


def level_of(r: FloatArray, noise: float) -> Level:
    """The level of (n,) distances ``r`` whose readings have the standard deviation ``noise`` (above 0, same unit).

    Fewer than six values have no level.
    """
    out = np.array([math.nan, math.inf, math.inf, 0.0])
    # Normalised, so that rounding does not depend on the unit.
    size = max(float(np.max(np.abs(r), initial=0.0)), noise)
    _fit(np.ascontiguousarray(r, dtype=np.float64) / size, noise / size, out)
    return Level(float(out[0]) * size, float(out[1]) * size, float(out[2]) * size, int(out[3]))


@compiled
def _fit(r: FloatArray, noise: float, out: FloatArray) -> None:  # pragma: no cover - compiled
    """Fit all orders, keep the best by the information criterion; ``out`` is [level, std, residual, order]."""
    n = r.shape[0]
    best = math.inf
    for p in range(ORDERS + 1):
        rows, k = n - p, p + 1
        if rows < 2 * k + SPARE:
            break
        X = np.empty((rows, k))
        for i in range(rows):
            for j in range(p):
                X[i, j] = r[p + i - 1 - j]
            X[i, p] = 1.0
        z = r[p:]
        normal = X.T @ X
        ridge = 1e-13 * np.trace(normal)
        for j in range(k):
            normal[j, j] += ridge + 1e-300
        inverse = np.linalg.inv(normal)
        theta = inverse @ (X.T @ z)
        error = z - X @ theta
        variance = float(error @ error) / (rows - k)
        remainder, squares = 1.0, 1.0
        for j in range(p):
            remainder -= theta[j]
            squares += theta[j] * theta[j]
        # The noise of the readings enters through every coefficient: no fit can have a smaller residual than this.
        criterion = rows * math.log(variance + 0.3 * noise * noise * squares) + k * math.log(float(rows))
        criterion /= rows
        if not criterion < best:
            continue
        best = criterion
        out[2], out[3] = math.sqrt(variance), float(p)
        if remainder < NO_LEVEL:
            out[0], out[1] = math.nan, math.inf
            continue
        level = theta[p] / remainder
        gradient = np.zeros(k)
        for j in range(p):
            gradient[j] = level / remainder
        gradient[p] = 1.0 / remainder
        spread = float(gradient @ inverse @ gradient)
        out[0] = level
        out[1] = math.sqrt(max(variance, noise * noise) * max(spread, 0.0))


#: Fewest readings in a row at the expected level that end a hold.
BACK_AGAIN = 2
#: Most samples without a reading that dead reckoning bridges.
MOST_BRIDGED = 4096
#: Longest hold of undecided readings, and of ringing about the old level, s; fewest samples for the first.
UNDECIDED_S, RINGING_S, UNDECIDED_SAMPLES = 0.04, 0.6, 40
#: A jump is a change of gain if the displacement changes by a ratio between this and its inverse, else an offset.
JUMP_RATIO = 0.85
#: Tolerance of the old level: this share of the travelled distance, at most this share of the range.
WAY_SHARE, WAY_MOST = 0.03, 0.02
#: A level is known if its standard deviation is below this share of the level, or of the tolerance.
LEVEL_STD, USUAL_STD = 0.03, 0.3
#: Most values for a level, and the shortest time between two of them, s. With shorter spacing, noise hides the
#: curvature of a mode.
VALUES, SPACING_S = 64, 5e-4
#: Time that readings at a new level must span, s: a glitch of the sensor's electronics lasts some milliseconds.
SPAN_S = 0.008
#: Number of values in the shorter windows that are tried after the longest.
WINDOWS = (28, 16)
#: Time for which readings must be at the expected level, s, and the same within ``UNDECIDED_S`` of ringing: one half
#: swing lies within the tolerance.
CALM_S, CALM_RINGING_S = 0.005, 0.01


class Verdict(Enum):
    """Decision after a held reading."""

    WAIT = 0
    BACK = 1
    JUMP = 2
    MOTION = 3
    LOST = 4


class Circumstances(NamedTuple):
    """Limits and scales by which the readings of a hold are judged.

    Attributes
    ----------
    config, envelope : limits. dt_s : sample time. range_um : displacement range of the model.
    noise_um : standard deviation of a reading from the smoother's prediction.
    usual_um : largest distance of an ordinary reading from the prediction.
    rest_um : reading of the stage at rest without voltage.
    low_um, high_um : readings at the ends of the identified range.
    trusted : no sensor fault lately.
    """

    config: AdmissionConfig
    envelope: EnvelopeConfig
    dt_s: float
    range_um: float
    noise_um: float
    usual_um: float
    rest_um: float
    low_um: float
    high_um: float
    trusted: bool


@dataclass(slots=True)
class Hold:
    """Held samples, and the quantities that `judge` uses."""

    reckoning: Annotated[Reckoning, Entry("dead reckoning since the last trusted reading")]
    last_um: Annotated[float, Entry("that reading", "µm", finite=False)]
    u_V: Annotated[list[float], Entry("voltage of each sample", "V", "held", finite=False, most=20_000)] = field(
        default_factory=list
    )
    y_um: Annotated[list[float], Entry("its reading, NaN without one", "µm", "held", finite=False, most=20_000)] = (
        field(default_factory=list)
    )
    old_um: Annotated[
        list[float], Entry("its expected reading without a jump", "µm", "held", finite=False, most=20_000)
    ] = field(default_factory=list)
    slope: Annotated[float, Entry("jumps accepted so far: the expected reading is slope old + shift")] = 1.0
    shift_um: Annotated[float, Entry("the shift of them", "µm", finite=False)] = 0.0
    jumped: Annotated[int, Entry("samples at the last of these jumps, 0 for none", low=0)] = 0
    silent: Annotated[int, Entry("samples at the last one without a reading", low=0)] = 0
    level: Annotated[int, Entry("index of the first reading of the level that `judge` has found", low=0)] = 0
    away_um: Annotated[float, Entry("distance of that level", "µm", finite=False)] = 0.0
    seen_um: Annotated[float, Entry("largest distance from the expected reading", "µm", finite=False)] = 0.0
    good: Annotated[int, Entry("readings in a row at the expected level", low=0)] = 0
    rang: Annotated[int, Entry("samples at the last ringing about that level, 0 for never", low=0)] = 0

    def put(self, u_V: float, y_um: float) -> None:
        """Append one sample, and advance dead reckoning."""
        old_um = self.reckoning.advance(u_V)
        self.u_V.append(u_V)
        self.y_um.append(y_um)
        self.old_um.append(old_um)
        if math.isnan(y_um):
            self.silent = len(self.y_um)

    @property
    def taken(self) -> bool:
        """Whether a jump has been accepted."""
        return self.jumped > 0

    @property
    def expected_um(self) -> float:
        """Expected value of the last reading, µm."""
        return self.slope * self.old_um[-1] + self.shift_um

    def take(self, slope: float, shift_um: float) -> None:
        """Accept a jump: a reading that was y is from now on slope y + shift."""
        self.slope, self.shift_um = slope * self.slope, slope * self.shift_um + shift_um
        self.jumped, self.good, self.rang = len(self.y_um), 0, 0


def tolerance_um(now: Circumstances, reckoning: Reckoning) -> float:
    """Largest distance of a good reading from the dead-reckoned position, µm; it grows with the travelled distance."""
    way_um = min(WAY_SHARE * reckoning.way_um, WAY_MOST * now.range_um)
    return now.usual_um + way_um + reckoning.std_um


def needed(config: AdmissionConfig, away_um: float, range_um: float, trusted: bool) -> int:
    """Number of readings at one level that a jump must exceed."""
    usual = config.glitch_share <= abs(away_um) / range_um <= config.jump_share
    return config.glitch_persistence if trusted and usual else config.doubt_persistence


def judge(hold: Hold, now: Circumstances) -> Verdict:
    """Decision after the last sample of a hold. Updates the hold; for JUMP also its ``level`` and ``away_um``."""
    n = len(hold.y_um)
    away_um = hold.y_um[-1] - hold.expected_um
    if math.isnan(away_um):
        return Verdict.WAIT if n < MOST_BRIDGED else Verdict.LOST
    if abs(away_um) <= tolerance_um(now, hold.reckoning):
        hold.good += 1
        # Two samples or fewer: the voltage explains the motion, or a single reading was wrong; no need to wait. Later,
        # readings must stay for CALM_S, because a ringing stage passes the expected level again and again.
        rings = hold.rang and (n - hold.rang) * now.dt_s <= UNDECIDED_S
        enough = max(BACK_AGAIN, round((CALM_RINGING_S if rings else CALM_S) / now.dt_s))
        return Verdict.BACK if hold.good >= enough or n <= 2 else Verdict.WAIT
    hold.good = 0
    hold.seen_um = max(hold.seen_um, abs(away_um))
    if hold.reckoning.lost:
        return Verdict.LOST
    stride = max(1, round(SPACING_S / now.dt_s))
    if n % stride == 0:
        found = _level(hold, now, stride)
        if found is not None:
            return found
    # Samples without a reading do not count: nothing can be decided from them.
    waited = n - max(hold.jumped, hold.silent)
    if hold.rang and (n - hold.rang) * now.dt_s <= 0.5 * UNDECIDED_S:
        return Verdict.WAIT if waited * now.dt_s < RINGING_S else Verdict.MOTION
    if waited < max(UNDECIDED_SAMPLES, UNDECIDED_S / now.dt_s):
        return Verdict.WAIT
    small = hold.seen_um <= now.config.glitch_share * now.range_um
    return Verdict.MOTION if small and not hold.taken else Verdict.LOST


def _level(hold: Hold, now: Circumstances, stride: int) -> Verdict | None:
    """JUMP if the readings have settled at a new level, WAIT if they ring about the old one, None if undecided."""
    y, old = np.array(hold.y_um), hold.slope * np.array(hold.old_um) + hold.shift_um
    missing = np.flatnonzero(np.isnan(y))
    first = int(missing[-1]) + 1 if missing.size else 0
    first = max(first, y.size - VALUES * stride)
    usual_um = tolerance_um(now, hold.reckoning)
    for count in dict.fromkeys((y.size - first, *(size * stride for size in WINDOWS))):
        count -= count % stride
        if count < stride * 6 or count > y.size - first:
            continue
        part = slice(y.size - count, None)
        r, position = _spaced(y[part] - old[part], stride), _spaced(old[part] - now.rest_um, stride)
        noise = now.noise_um / math.sqrt(stride)
        levels = [level_of(r, noise)]
        if np.min(np.abs(position)) > 0.1 * now.range_um:
            scaled = level_of(r / position * position[-1], noise)
            if scaled.residual <= levels[0].residual:
                levels.insert(0, scaled)
        level = next((fit for fit in levels if _known(fit, usual_um)), None)
        if level is None:
            continue
        if abs(level.at) + SIGMA * level.std < usual_um:
            # At the old level: ringing, or a glitch of alternating sign. Neither is learnt.
            hold.rang = y.size
            return Verdict.WAIT
        if _is_jump(level, hold, count, r, usual_um, now):
            hold.away_um, hold.level = level.at, y.size - count
            return Verdict.JUMP
    return None


def _spaced(x: FloatArray, stride: int) -> FloatArray:
    """Means of groups of ``stride`` values: they keep the ringing and reduce the noise."""
    return x if stride == 1 else x.reshape(-1, stride).mean(axis=1)


def _known(level: Level, usual_um: float) -> bool:
    """Whether the standard deviation of a level is small enough for a decision."""
    return level.std <= max(LEVEL_STD * abs(level.at), USUAL_STD * usual_um)


def _is_jump(level: Level, hold: Hold, count: int, r: FloatArray, usual_um: float, now: Circumstances) -> bool:
    """Whether a level is a jump: significant, long enough, and allowed by the envelope."""
    away = abs(level.at)
    # Outside of the identified range the model itself may have an error as large as this.
    if not now.low_um <= hold.expected_um <= now.high_um:
        return False
    if away - usual_um <= SIGMA * level.std or away > now.envelope.jump * now.range_um:
        return False
    if count <= needed(now.config, level.at, now.range_um, now.trusted) or count * now.dt_s < SPAN_S:
        return False
    # The level must lie within the measured distances, and must not exceed the motion of the readings.
    spread = 3.0 * now.noise_um
    if not float(r.min()) - spread <= level.at <= float(r.max()) + spread:
        return False
    readings = np.array(hold.y_um)
    moved = float(np.nanmax(np.abs(readings - hold.last_um))) + hold.reckoning.way_um + now.usual_um
    return away <= moved


def jump_after(frame: FeatureMap, at_um: float, away_um: float) -> tuple[float, float]:
    """(slope, shift in µm) of a jump by ``away_um`` at the reading ``at_um``: a reading y becomes slope y + shift.

    One jump does not show whether the gain or the offset has changed. A change of gain about the rest position is
    assumed if the displacement is large enough; the filter corrects it as the stage moves.
    """
    rest_um = frame.offset_um + frame.gain * frame.y_rest_um
    displacement_um = at_um - rest_um
    ratio = 1.0 + away_um / displacement_um if displacement_um else math.inf
    if JUMP_RATIO < ratio < 1.0 / JUMP_RATIO:
        return ratio, (1.0 - ratio) * rest_um
    return 1.0, away_um


def frame_after(frame: FeatureMap, slope: float, shift_um: float) -> FeatureMap:
    """The frame after a jump from y to slope y + shift: the new readings give the same displacements as before."""
    return replace(frame, gain=slope * frame.gain, offset_um=slope * frame.offset_um + shift_um)


def steps_of_motion(hold: Hold) -> tuple[Step, ...]:
    """The held samples as steps of the track, where all readings were motion of the stage."""
    y_um = np.array(hold.y_um)
    return _steps_of(hold, y_um, np.isnan(y_um))


def steps_of_hold(hold: Hold, usual_um: float) -> tuple[Step, ...]:
    """The held samples as steps of the track, once readings are as expected again; earlier readings are bridged."""
    y_um, n = np.array(hold.y_um), len(hold.y_um)
    expected_um = hold.slope * np.array(hold.old_um) + hold.shift_um
    good = ~np.isnan(y_um)
    if hold.taken:
        # Use the readings at the new level, but not those on the way to it, nor ringing ones.
        good &= (np.arange(n) >= hold.level) & (np.abs(y_um - expected_um) <= usual_um)
        return _steps_of(hold, np.where(good, y_um, expected_um), ~good)
    bridge = n - max(hold.good, 1)
    off_um = y_um[-1] - expected_um[-1]
    bridged = expected_um + off_um * np.minimum(np.arange(1, n + 1) / (bridge + 1), 1.0)
    good[:bridge] = False
    return _steps_of(hold, np.where(good, y_um, bridged), ~good)


def _steps_of(hold: Hold, y_um: FloatArray, bad: BoolArray) -> tuple[Step, ...]:
    """The held samples as steps of the track; where (n,) ``y_um`` is NaN, the expected reading is used."""
    filled_um = np.where(np.isnan(y_um), hold.slope * np.array(hold.old_um) + hold.shift_um, y_um)
    return tuple(Step(float(y), u, not no) for y, u, no in zip(filled_um, hold.u_V, bad, strict=True))
