"""Where the stage is: by its readings (`Track`), by the voltage alone (`Reckoning`), and after a gap (`MissingMotion`).

A *track* holds the fixed-lag smoother, the last voltages and readings, the frame and the hysteresis memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.features import FeatureMap, advance, fill
from dehyst.adaptive.inverse_model import LssvmInverse, mean_of, track_memory, unpacked, voltage_of
from dehyst.adaptive.online.row import Row
from dehyst.adaptive.state import Entry, Numbers
from dehyst.adaptive.types import FloatArray, IntArray

# --- Dead reckoning: the place of the stage from the voltage alone, by solving the inverse model for the displacement.
#
# While readings are not trusted, extrapolation by the smoother is wrong by micrometres within ten samples. Dead
# reckoning instead solves, at each sample, for the displacement at which the inverse model gives the applied voltage,
# and advances the hysteresis memory. The model's error at the start is subtracted, so that only its change from then on
# counts.
#
# Why the place cannot diverge, for any model:
#
# - The velocity is not a free unknown. Where voltage rises with velocity (a lag), it is the backward difference of the
#   displacement: an implicit Euler step, which is stable. Where voltage falls with velocity, that recursion would be
#   unstable; there the velocity follows from the change of the voltage itself, which is no recursion.
# - A change of the voltage moves the stage by a slope within ``SLOPES`` times the mean one. Summed from the start this
#   gives a band that limits the place. In one sample it moves the stage one way only, apart from the motion under way.
# - The place stays within ``OFF_LINE`` ranges of a straight line through the start, of the model's mean slope.
#
# The uncertainty grows with the way gone and with what the band and the line cut off. Beyond ``LOST_SHARE`` of the
# range the reckoning is `lost`.


#: Newton's steps a sample, and the displacement over which the slope is taken, as a share of the range.
STEPS, SLOPE_SHARE = 2, 1e-5
#: Slopes of the voltage over the displacement, as shares of the mean one, that a stage can have. Some stages stand
#: nearly still while the voltage turns back over a tenth of the drive.
SLOPES = (0.4, 25.0)
#: Distance from the straight line through the start, in ranges, that hysteresis, creep and bend explain together.
OFF_LINE = 0.35
#: Time for which the stage's own motion at the start (lag, ringing) widens the band, s.
RUN_OUT_S = 0.01
#: One standard deviation of the place, as a share of the way gone, and as a share of the range the most that this adds
#: and the limit of what is of use.
WAY_SHARE, WAY_MOST, LOST_SHARE = 0.002, 0.02, 0.05

#: Entries of a reckoning's numbers.
_Y, _V, _U, _LOW, _HIGH, _WAY, _CUT, _OFF, _SLOPE, _LINE = range(10)


@dataclass(slots=True)
class Reckoning:
    """A reckoned place, and the fixed model that reckons it.

    numbers : place (µm, µm/s) and voltage (V) of the last sample; the band (µm); way gone and what the band cut
    off since the doubt began (µm); what a reading shows more than the place (µm); mean slope (V/µm), and the voltage
    at which the line through the start is at 0 µm (V).
    """

    model: Annotated[LssvmInverse, Entry("an immutable snapshot, which reckons the place")]
    memory: Annotated[FloatArray, Entry("hysteresis memory after the last sample", "µm", "m")]
    numbers: Annotated[FloatArray, Entry("as listed by `Reckoning`", "µm, µm/s, V, µm, µm, µm, µm, µm, V/µm, V", "10")]

    def check_state(self) -> None:
        """Raise ValueError where the memory is not of the model."""
        if self.memory.shape != (self.model.memory_size,):
            raise ValueError(f"memory: {self.memory.shape}, the model has one of {self.model.memory_size}")

    @classmethod
    def begin(
        cls,
        model: LssvmInverse,
        motion: tuple[float, float, float],
        u_before_V: float,
        u_V: FloatArray,
        y_um: FloatArray,
        memory: FloatArray,
    ) -> Reckoning:
        """From the last smoothed instant over the (n,) samples after it, with their voltages and (k,) first readings.

        ``motion`` (µm, µm/s, µm/s²) and ``memory`` (m,) are of that instant, ``u_before_V`` is its voltage.
        """
        y, v, _ = motion
        made = cls(model, memory.copy(), np.zeros(10))
        slack = abs(v) * RUN_OUT_S + 1e-3 * made.range_um
        made.numbers[:_WAY] = (y, v, u_before_V, y - slack, y + slack)
        slope = mean_slope(model)
        made.numbers[[_SLOPE, _LINE]] = slope, u_before_V - slope * y
        # The first step is the model's way from the measured place to its own.
        off = np.array([made.advance(float(u), anew=i == 0) for i, u in enumerate(u_V[: y_um.size])])
        made.advance_all(u_V[y_um.size :])
        if off.size:
            # The middle one: some of these readings may have rung, or been wrong, already.
            made.numbers[_OFF] = float(np.median(y_um - off))
        made.begin_way()
        return made

    def begin_way(self) -> None:
        """Set the way gone to zero: everything up to here is trusted."""
        self.numbers[[_WAY, _CUT]] = 0.0

    @property
    def range_um(self) -> float:
        """Displacement range of the model, as a reading shows it, µm."""
        f = self.model.features
        return (f.y_max_um - f.y_min_um) * f.gain

    @property
    def y_um(self) -> float:
        """Expected reading at the last sample, µm."""
        return float(self.numbers[_Y] + self.numbers[_OFF])

    @property
    def v_um_per_s(self) -> float:
        """Velocity there, µm/s."""
        return float(self.numbers[_V])

    @property
    def u_V(self) -> float:
        """Voltage there, V."""
        return float(self.numbers[_U])

    @property
    def std_um(self) -> float:
        """One standard deviation of the place, µm: it grows with the way gone, and by what the band cut off.

        The part of the way is limited to a share of the range: but for hysteresis the voltage determines the place.
        """
        most = WAY_MOST * self.range_um
        return most * (1.0 - math.exp(-WAY_SHARE * self.way_um / most)) + float(self.numbers[_CUT])

    @property
    def mean_slope_V_per_um(self) -> float:
        """Slope of the straight line through the model's range, V/µm; negative where voltage draws the stage back."""
        return float(self.numbers[_SLOPE])

    @property
    def way_um(self) -> float:
        """Way gone since the doubt began, µm."""
        return float(self.numbers[_WAY])

    @property
    def lost(self) -> bool:
        """Whether the place is too uncertain to be of use."""
        return not self.std_um <= LOST_SHARE * self.range_um

    def in_frame(self, frame: FeatureMap) -> Reckoning:
        """The same stage read in another frame; the hysteresis memory is of the stage and stays."""
        f, n = self.model.features, self.numbers.copy()
        slope = frame.gain / f.gain
        n[[_Y, _LOW, _HIGH]] = frame.offset_um + slope * (n[[_Y, _LOW, _HIGH]] - f.offset_um)
        n[[_V, _WAY, _CUT, _OFF]] *= slope
        n[_SLOPE] /= slope
        line_um = (n[_U] - n[_LINE]) / self.numbers[_SLOPE]
        n[_LINE] = n[_U] - n[_SLOPE] * (frame.offset_um + slope * (line_um - f.offset_um))
        return Reckoning(replace(self.model, features=frame), self.memory.copy(), n)

    def by_model(self, model: LssvmInverse) -> Reckoning:
        """Continue with another model of the same frame; the expected reading stays the same."""
        made = Reckoning(model, self.memory.copy(), self.numbers.copy())
        made.numbers[_OFF] += self.y_um - made.advance(float(self.numbers[_U]), anew=True)
        return made

    def advance(self, u_V: float, anew: bool = False) -> float:
        """Advance by one sample with the voltage ``u_V``; returns the expected reading, µm.

        ``anew`` : the place is not yet the model's own, and may move to it at once.
        """
        f = self.model.features
        constants, counts = self.model.packed
        _step(u_V, f.dt_s, self.range_um, anew, self.memory, self.numbers, constants, counts)
        return self.y_um

    def advance_all(self, u_V: FloatArray) -> None:
        """Advance by a sample with each of (n,) voltages."""
        constants, counts = self.model.packed
        _steps(
            np.asarray(u_V, dtype=np.float64),
            self.model.dt_s,
            self.range_um,
            self.memory,
            self.numbers,
            constants,
            counts,
        )


def drive_V(model: LssvmInverse) -> float:
    """Voltage span of a model over its range, V; at least that of its recording."""
    low_V, high_V, _ = _ends(model)
    return max(model.span_V, abs(high_V - low_V))


def mean_slope(model: LssvmInverse) -> float:
    """Slope, V/µm, of the straight line through the ends of a model's range, of a size that a stage can have."""
    low_V, high_V, range_um = _ends(model)
    usual, slope = model.span_V / range_um, (high_V - low_V) / range_um
    # A model with the same voltage everywhere still has a sign.
    return math.copysign(max(abs(slope), 0.5 * usual), slope)


def answers(model: LssvmInverse) -> bool:
    """Whether the voltages of a model at the two ends of its range differ, as those of a stage's inverse do."""
    low_V, high_V, _ = _ends(model)
    return bool(abs(high_V - low_V) > 0.3 * model.span_V)


def _ends(model: LssvmInverse) -> tuple[float, float, float]:
    """Voltages, V, at the lower and the upper end of the range, and the range, µm."""
    f = model.features
    low_um, high_um = (f.offset_um + f.gain * y for y in (f.y_min_um, f.y_max_um))
    low_V, high_V = (model.evaluate_point(y, 0.0, 0.0, model.rest_memory(y))[0] for y in (low_um, high_um))
    return low_V, high_V, high_um - low_um


@compiled
def _step(
    u: float,
    dt: float,
    span: float,
    anew: bool,
    memory: FloatArray,
    n: FloatArray,
    constants: FloatArray,
    counts: IntArray,
) -> None:  # pragma: no cover - compiled
    """One sample: place, velocity, band and memory in place. ``anew`` : the model has not reckoned the place before."""
    m, beta, inverse_widths, alpha, scaled, _ = unpacked(constants, counts)
    scratch = np.empty(memory.shape[0])
    before, v, k = n[_Y], n[_V], n[_SLOPE]
    under_way = v * dt
    sign, least, most = math.copysign(1.0, k), SLOPES[0] * abs(k), SLOPES[1] * abs(k)
    dv = 1e-3 / (m.scale[2] * m.frame[1])
    # How the voltage depends on velocity here decides where the velocity comes from.
    lag = (
        voltage_of(before, v + dv, 0.0, memory, scratch, m, beta, scaled, alpha, inverse_widths)
        - voltage_of(before, v, 0.0, memory, scratch, m, beta, scaled, alpha, inverse_widths)
    ) / dv
    implicit = sign * lag > 0.0
    du = u - n[_U]
    h = SLOPE_SHARE * span
    y = before + v * dt
    for _ in range(STEPS):
        if implicit:
            v = (y - before) / dt
        there = voltage_of(y, v, 0.0, memory, scratch, m, beta, scaled, alpha, inverse_widths)
        more = voltage_of(y + h, v, 0.0, memory, scratch, m, beta, scaled, alpha, inverse_widths)
        slope = sign * min(max(sign * (more - there) / h, least), most)
        if implicit:
            slope += lag / dt
        else:
            v = du / (slope * dt)
            there = voltage_of(y, v, 0.0, memory, scratch, m, beta, scaled, alpha, inverse_widths)
        y -= (there - u) / slope
    # The band: the least and the largest motion that this change of the voltage can cause.
    rises, falls = max(sign * du, 0.0), min(sign * du, 0.0)
    n[_LOW] += rises / most + falls / least
    n[_HIGH] += rises / least + falls / most
    line = (u - n[_LINE]) / k
    low = max(n[_LOW], line - OFF_LINE * span)
    high = min(n[_HIGH], line + OFF_LINE * span)
    held = min(max(y, low), high) if math.isfinite(y) else before
    # What is cut off stays the same error while the stage stands still: the largest of it, not the sum.
    n[_CUT] = max(n[_CUT], abs(held - y) if math.isfinite(y) else span)
    if not anew:
        # A voltage that rises moves the stage one way only, apart from the motion under way.
        down, up = falls / least + min(under_way, 0.0), rises / least + max(under_way, 0.0)
        held = min(max(held, before + down), before + up)
    n[_V] = (held - before) / dt
    n[_WAY] += abs(held - before)
    n[_Y], n[_U] = held, u
    advance(held, memory, m)


@compiled
def _steps(
    u: FloatArray, dt: float, span: float, memory: FloatArray, n: FloatArray, constants: FloatArray, counts: IntArray
) -> None:  # pragma: no cover - compiled
    for i in range(u.shape[0]):
        _step(u[i], dt, span, False, memory, n, constants, counts)


# --- The hysteresis memory after a gap: what the stage may have done while its samples were missing.
#
# After a gap the place is known and the memory is not: it depends on where the stage turned meanwhile. An ensemble of
# memories stands for the possible motions: straight to the new place, or by turning points above and below it, in both
# orders, as far as the stage can go in that time with its largest known velocity and acceleration. Their mean is
# served. The spread of their voltages is added to the stated deviation.
#
# Each member then follows the readings, and the voltages correct them all: an ensemble Kalman filter of the memory
# alone (the deterministic one of Whitaker and Hamill, 2002). Plays that the motion wipes out become equal by
# themselves. The states that a play memory can have form a convex set, so the mean of members is such a state. The gap
# is closed where the voltages agree, at the place and away from it, or after some time of motion: what is then left
# counts as an error of the model.


#: Turning points, as shares of the way from the two known places to the farthest one that can be reached.
TURNS: Final = (0.0, 0.1, 0.4, 1.0)
#: Points of a path through the gap.
PATH_POINTS: Final = 60
#: Assumed length of a gap of unknown length, s: slow states are relaxed, and every place can be reached.
UNKNOWN_S: Final = 10.0
#: Deviation of the first voltage, as a share of the span: its velocity and acceleration are not known yet.
FIRST_SHARE: Final = 0.01
#: Variance of a voltage over that of the model's error: successive errors are alike.
ALIKE: Final = 10.0
#: The model's error after a gap over its rms error just before it, which differs along the motion.
NOISE_FACTOR: Final = 2.0
#: Least deviation of the model's error, as a share of the span.
LEAST_SHARE: Final = 1e-4
#: Distance, as a share of the range, at which the voltages are compared beside the place itself.
PROBE_SHARE: Final = 0.15
#: Steps of the filter between two comparisons.
PROBE_EVERY: Final = 5
#: The gap is closed where the spread is below the model's error, or this share of the span. Each time in motion that
#: has passed, s, adds as much: motion that tells little must not stop the learning. The longest time in motion, s.
CLOSED_SHARE, PATIENCE_S, LONGEST_S = 3e-4, 0.25, 1.0


@dataclass(slots=True)
class MissingMotion:
    """An open gap."""

    model: Annotated[LssvmInverse, Entry("as before the gap, in the frame that is served; learnt only at rest")]
    members: Annotated[FloatArray, Entry("possible memories", "µm", "*,m", most=4096)]
    noise_V: Annotated[float, Entry("deviation of the model's error", "V", low=0.0)]
    std_V: Annotated[float, Entry("spread of the members' voltages", "V", low=0.0)] = 0.0
    since: Annotated[int, Entry("smoothed instants since the gap", low=0)] = 0
    moved_s: Annotated[float, Entry("time of motion since", "s", low=0.0)] = 0.0
    rests: Annotated[bool, Entry("whether the stage is at rest")] = False

    def check_state(self) -> None:
        """Raise ValueError where there are no members, or they are not of the model."""
        if not len(self.members) or self.members.shape[1] != self.model.memory_size:
            raise ValueError(f"members: {self.members.shape}, expected some of {self.model.memory_size} entries")

    @classmethod
    def begin(
        cls,
        model: LssvmInverse,
        memory: FloatArray,
        from_um: float,
        to_um: float,
        u_V: float,
        seconds: float,
        noise_V: float,
        earlier: MissingMotion | None = None,
    ) -> MissingMotion:
        """Between two readings, µm, that are ``seconds`` apart; ``u_V`` : voltage of the second one.

        ``memory`` : (m,) at the first one. ``earlier`` : a gap that was still open there.
        """
        top_um, bottom_um = max(from_um, to_um), min(from_um, to_um)
        fastest = float(np.max(np.abs(model.domain[2:4])))
        hardest = float(np.max(np.abs(model.domain[4:6])))
        # A turn with the acceleration a takes the stage a t² / 8 beyond both places.
        reach_um = max(0.0, min(0.5 * (fastest * seconds - (top_um - bottom_um)), hardest * seconds**2 / 8.0))
        above = min(reach_um, max(0.0, float(model.domain[1]) - top_um))
        below = min(reach_um, max(0.0, bottom_um - float(model.domain[0])))
        turns = [(top_um + up * above, bottom_um - down * below) for up in TURNS for down in TURNS]
        paths = [*turns, *((low, high) for high, low in turns)]
        before = memory[np.newaxis] if earlier is None else earlier.members
        arrays = model.features.arrays
        # A path has fewer points than samples are missing: the slow states relax by several samples in each step.
        arrays = arrays._replace(retain=arrays.retain ** (seconds / model.dt_s / PATH_POINTS))
        members = np.empty((len(paths), model.memory_size))
        for i, (first, second) in enumerate(paths):
            # An earlier gap's members are dealt out so that like ones do not get like paths.
            members[i] = before[(7 * i + 3) % before.shape[0]]
            track_memory(_path(from_um, first, second, to_um), members[i], arrays)
        noise_V = max(NOISE_FACTOR * noise_V, LEAST_SHARE * model.span_V)
        made = cls(model, members, noise_V, moved_s=0.0 if earlier is None else earlier.moved_s)
        _correct(to_um, 0.0, 0.0, u_V, (FIRST_SHARE * model.span_V) ** 2, members, *model.packed)
        made.compare((to_um, 0.0, 0.0))
        return made

    @property
    def memory(self) -> FloatArray:
        """(m,) the mean of the members."""
        mean: FloatArray = self.members.mean(axis=0)
        return mean

    def advance(self, y_um: float) -> None:
        """All members follow one smoothed place, µm."""
        _advance_all(y_um, self.members, *self.model.packed)
        self.since += 1

    def stand(self) -> None:
        """The stage is at rest: the learner learns the zero, and the memory stays as it is."""
        self.rests = True

    def move(self, model: Callable[[], LssvmInverse], step_s: float) -> None:
        """The stage has moved for ``step_s``; ``model`` returns the model with what was learnt at rest."""
        if self.rests:
            self.rests, self.model = False, model()
        self.moved_s += step_s

    def correct(self, motion: tuple[float, float, float], u_V: float, weight: float) -> None:
        """Correct the members, advanced to ``motion`` (µm, µm/s, µm/s²), by the voltage there. ``weight`` : 0 to 1."""
        variance = ALIKE * self.noise_V**2 / weight
        _correct(*motion, u_V, variance, self.members, *self.model.packed)

    @property
    def closed(self) -> bool:
        """Whether what is missing no longer matters, or has been waited for long enough."""
        close_V = max((1.0 + self.moved_s / PATIENCE_S) * self.noise_V, CLOSED_SHARE * self.model.span_V)
        return self.std_V <= close_V or self.moved_s > LONGEST_S

    def compare(self, motion: tuple[float, float, float]) -> None:
        """Take the spread anew: the largest distance of a voltage from their mean, here and on both sides."""
        f = self.model.features
        away_um = PROBE_SHARE * (f.y_max_um - f.y_min_um) * f.gain
        y, v, a = motion
        places = np.array([y - away_um, y, y + away_um])
        self.std_V = float(_largest_distance(places, v, a, self.members, *self.model.packed))


def _path(*corners_um: float) -> FloatArray:
    """(``PATH_POINTS``,) places, µm, along straight lines through the corners at constant speed; corners included."""
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners_um)))])
    between = np.linspace(0.0, way[-1], PATH_POINTS - len(corners_um) + 3)[1:]
    # Sorted: corners are places too, so that a play reaches them.
    path: FloatArray = np.interp(np.sort(np.concatenate([between, way[1:-1]])), way, corners_um)
    return path


@compiled
def _advance_all(
    y_um: float, members: FloatArray, constants: FloatArray, counts: IntArray
) -> None:  # pragma: no cover - compiled
    m = unpacked(constants, counts)[0]
    for c in range(members.shape[0]):
        advance(y_um, members[c], m)


@compiled
def _voltages(
    y: float,
    v: float,
    a: float,
    move: bool,
    members: FloatArray,
    constants: FloatArray,
    counts: IntArray,
    u: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Voltages, V, of all members at a place; ``move``: they are moved there, as copies, first."""
    m, beta, inverse_widths, alpha, scaled, _ = unpacked(constants, counts)
    basis, kernel, at = np.empty(beta.shape[0]), np.empty(inverse_widths.shape[0]), np.empty(members.shape[1])
    for c in range(members.shape[0]):
        at[:] = members[c]
        if move:
            advance(y, at, m)
        fill(y, v, a, at, m, basis, kernel)
        u[c] = mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)


@compiled
def _correct(
    y: float,
    v: float,
    a: float,
    u_V: float,
    variance: float,
    members: FloatArray,
    constants: FloatArray,
    counts: IntArray,
) -> None:  # pragma: no cover - compiled
    n, size = members.shape
    u = np.empty(n)
    _voltages(y, v, a, False, members, constants, counts, u)
    mean_u = u.mean()
    spread = ((u - mean_u) ** 2).mean()
    if not (np.isfinite(spread) and spread > 0.0):
        return
    total = spread + variance
    less = 1.0 / (1.0 + np.sqrt(variance / total))
    for j in range(size):
        mean = members[:, j].mean()
        gain = ((members[:, j] - mean) * (u - mean_u)).mean() / total
        for c in range(n):
            members[c, j] += gain * (u_V - mean_u) - less * gain * (u[c] - mean_u)


@compiled
def _largest_distance(
    places: FloatArray, v: float, a: float, members: FloatArray, constants: FloatArray, counts: IntArray
) -> float:  # pragma: no cover - compiled
    u = np.empty(members.shape[0])
    largest = 0.0
    for i in range(places.shape[0]):
        _voltages(places[i], v, a, True, members, constants, counts, u)
        largest = max(largest, np.abs(u - u.mean()).max())
    return largest


# --- The track of a stage whose readings are smoothed.


Motion = tuple[float, float, float]


class Step(NamedTuple):
    """One step of the smoother: reading, µm, voltage applied from then on, V, and whether the reading is good.

    Where it is not, ``y_um`` is the reckoned place.
    """

    y_um: float
    u_V: float
    good: bool = True


class Pair(NamedTuple):
    """One smoothed instant to learn: its number, motion (µm, µm/s, µm/s²), and its voltage, V, smoothed alike.

    applied_V : the voltages that were applied at that instant and just before
    it, V. good : whether the readings at that instant and before it are good.
    """

    now: int
    y_um: float
    v_um_per_s: float
    a_um_per_s2: float
    u_V: float
    applied_V: tuple[float, float]
    good: bool


class Taken(NamedTuple):
    """Result of the intake of a sample: the gate that refused it or "", and the steps to make.

    jump_um : move of the frame, µm. first : whether no other unconfirmed jump is open. distrusted : whether
    the readings are on trial from now on; renamed : whether the name of the sensor fault has changed.
    """

    refused: str
    steps: tuple[Step, ...] = ()
    jump_um: float = 0.0
    distrusted: bool = False
    renamed: bool = False
    first: bool = False


@dataclass(slots=True)
class Past:
    """A known place of the stage, and the voltages since: dead reckoning can start from it.

    The first four are as ``Track.since_motion`` gives them.
    """

    motion: Annotated[Motion, Entry("motion there", "µm, µm/s, µm/s²", "3")]
    u_before_V: Annotated[float, Entry("voltage there", "V", finite=False)]
    lag_V: Annotated[FloatArray, Entry("voltages over the lag since", "V", finite=False, most=20_000)]
    lag_um: Annotated[FloatArray, Entry("first readings over the lag since", "µm", finite=False, most=20_000)]
    memory: Annotated[FloatArray, Entry("hysteresis memory there", "µm", "m")]
    u_V: Annotated[list[float], Entry("voltages since", "V", finite=False, most=5000)]

    def check_state(self) -> None:
        """Raise ValueError where there are more readings than voltages."""
        if len(self.lag_um) > len(self.lag_V):
            raise ValueError(f"lag_um: {len(self.lag_um)} readings, but {len(self.lag_V)} voltages")

    @classmethod
    def of(cls, track: Track) -> Past:
        return cls(*track.since_motion(), track.memory.copy(), [])

    @classmethod
    def reckoned(cls, reckoning: Reckoning) -> Past:
        """The place where ``reckoning`` is now."""
        place_um, u_V = np.array([reckoning.y_um]), np.array([reckoning.u_V])
        motion = (reckoning.y_um, reckoning.v_um_per_s, 0.0)
        return cls(motion, reckoning.u_V, u_V, place_um, reckoning.memory.copy(), [])


class Track(Numbers):
    """A track: its part of a row; ``base`` is the feature map of the model that the learner started from.

    The frames of ``features`` and ``served`` differ for a lag after a jump. ``frozen_memory`` knows of no jump. The
    voltage is smoothed as the motion is: what the smoother takes from the motion is then missing in both, so that
    turns, steps and fast motion teach what slow motion does.
    """

    begun: Annotated[bool, Entry("whether there has been a reading")]
    count: Annotated[int, Entry("steps of the smoother", low=0)]
    smooth_V: Annotated[float, Entry("smoothed voltage of the last instant", "V")]
    switch: Annotated[int, Entry("the smoother's count until which the two frames differ", low=0)]
    jumps: Annotated[bool, Entry("whether they differ")]
    x: Annotated[FloatArray, Entry("predicted state of the smoother, in sample units", "µm", "order")]
    ring: Annotated[FloatArray, Entry("innovation and prediction of each step", "µm", "taps,4")]
    drive_x: Annotated[FloatArray, Entry("the same of the smoother of the voltage", "V", "order")]
    drive_ring: Annotated[FloatArray, Entry("the same", "V", "taps,4")]
    u_V: Annotated[FloatArray, Entry("ring of voltages by the smoother's count", "V", "slots", finite=False)]
    y_um: Annotated[FloatArray, Entry("ring of readings by the smoother's count", "µm", "slots", finite=False)]
    good: Annotated[IntArray, Entry("ring of which readings are good", "", "slots", low=0, high=1)]
    instant: Annotated[FloatArray, Entry("last smoothed motion, lag samples old", "µm, µm/s, µm/s²", "3")]
    rates: Annotated[FloatArray, Entry("rates of the smoothed voltage", "V/s, V/s²", "2")]
    frames: Annotated[
        FloatArray,
        Entry("frames of the instant that is learnt, and that is served: offset, 1/gain, dead band, gain",
              "µm, , µm, ", "2,4"),
    ]  # fmt: skip
    memory: Annotated[FloatArray, Entry("hysteresis memory in the learner's frame", "µm", "m")]
    frozen_memory: Annotated[FloatArray, Entry("hysteresis memory in the identified frame", "µm", "m")]

    def __init__(self, record: Any, row: Row, base: FeatureMap, lag: int) -> None:
        self.record, self.base, self.lag = record, base, lag
        self.x, self.ring, self.drive_x, self.drive_ring = row.x, row.ring, row.drive_x, row.drive_ring
        self.u_V, self.y_um, self.good, self.rates = row.voltages, row.readings, row.good, row.rates
        self.instant, self.frames, self.scale = row.motion, row.frames, row.scale
        self.memory, self.frozen_memory = row.memory, row.frozen_memory
        self._maps = [base, base]
        self.enter(base)

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where a frame is none."""
        for offset_um, inverse, _, gain in values["frames"]:
            self.base.in_frame(gain, offset_um)
            if inverse != 1.0 / gain:
                raise ValueError(f"frames: got a gain of {gain} and {inverse} as one over it")

    def begin(self, y_um: float) -> None:
        """A stage that came to rest at ``y_um`` in one stroke; after the first time, begin smoothing anew.

        The hysteresis memory follows to where the stage now is, over the readings that were not smoothed yet too: where
        many samples are lost there is nothing else.
        """
        if self.begun:
            self.memory[:], self.frozen_memory[:] = self.memory_now(False), self.memory_now(True)
        else:
            self.memory[:], self.frozen_memory[:] = self.served.rest_memory(y_um), self.base.rest_memory(y_um)
        self.begun = True
        self.x[:], self.ring[:], self.drive_x[:], self.drive_ring[:], self.good[:] = 0.0, 0.0, 0.0, 0.0, False
        self.x[0] = y_um
        self.frames[0], self.count, self.switch, self.jumps = self.frames[1], 0, 0, False

    @property
    def features(self) -> FeatureMap:
        """Feature map of the instant that is being learnt."""
        return self._map(0)

    @property
    def served(self) -> FeatureMap:
        """Feature map to serve with."""
        return self._map(1)

    def _map(self, which: int) -> FeatureMap:
        made, (offset_um, _, _, gain) = self._maps[which], self.frames[which].tolist()
        if made.offset_um != offset_um or made.gain != gain:
            made = self._maps[which] = self.base.in_frame(gain, offset_um)
        return made

    @property
    def motion(self) -> Motion | None:
        """Last smoothed motion (µm, µm/s, µm/s²), ``lag`` samples old, if any."""
        if self.count <= self.lag:
            return None
        y, v, a = self.instant.tolist()
        return y, v, a

    @property
    def last_um(self) -> float:
        """The last reading that was smoothed."""
        return self.y_um.item((self.count - 1) % self.y_um.shape[0])

    def move(self, served: FeatureMap, slope: float, shift_um: float) -> None:
        """A jump: the smoother goes on at another place, y <- slope y + shift, in a new frame."""
        self.x *= slope
        self.x[0] += shift_um
        self._put(1, served)
        self.switch, self.jumps = self.count + self.lag, True

    def enter(self, frame: FeatureMap) -> None:
        """Learn and serve in another frame from now on, where no jump is under way."""
        self._put(0, frame)
        self._put(1, frame)
        self.jumps = False

    def _put(self, which: int, frame: FeatureMap) -> None:
        self.frames[which] = frame.offset_um, 1.0 / frame.gain, frame.dead_um, frame.gain

    def to_base(self) -> None:
        """Return to the frame of ``base`` and the memory tracked in it."""
        self.enter(self.base)
        self.memory[:], self.switch = self.frozen_memory, 0

    def pair(self) -> Pair | None:
        """What the smoothed instant teaches; None before there is one."""
        motion, slots = self.motion, self.u_V.shape[0]
        if motion is None:
            return None
        now = self.count - 1 - self.lag
        at, before = now % slots, (now - 1) % slots
        good = bool(self.good[at] and self.good[before])
        return Pair(now, *motion, self.smooth_V, (self.u_V.item(at), self.u_V.item(before)), good)

    def remember(self, memory: FloatArray) -> None:
        """Go on with another (m,) hysteresis memory, given in the frame that is served."""
        self.memory[:], self.frozen_memory[:] = memory, self.served.memory_in(self.base, memory)

    def since_motion(self) -> tuple[Motion, float, FloatArray, FloatArray]:
        """The last smoothed motion, in the frame that is served, its voltage, and (lag,) voltages and readings since.

        The readings are as they came; just after a jump, those from before it are moved to where they would be now.
        """
        assert self.motion is not None
        slots = self.u_V.shape[0]
        numbers = np.arange(self.count - self.lag, self.count)
        past = numbers % slots
        u_before_V = float(self.u_V[(self.count - self.lag - 1) % slots])
        f, g = self.features, self.served
        y, v, a = self.motion
        # Just after a jump the smoothed instants are still in the frame from before it.
        ratio = g.gain / f.gain
        y_um = self.y_um[past]
        if self.jumps:
            early = numbers < self.switch - self.lag
            y_um[early] = g.offset_um + ratio * (y_um[early] - f.offset_um)
        motion = g.offset_um + ratio * (y - f.offset_um), ratio * v, ratio * a
        return motion, u_before_V, self.u_V[past], y_um

    def memory_now(self, frozen: bool) -> FloatArray:
        """(m,) hysteresis memory after the last step: the smoothed one, carried along the readings since.

        ``frozen`` : the one in the frame of ``base``.
        """
        past = np.arange(max(self.count - self.lag, 0), self.count)
        y_um = self.y_um[past % self.y_um.shape[0]]
        if frozen:
            after = self.frozen_memory.copy()
            track_memory(y_um, after, self.base.arrays)
            return after
        after = self.memory.copy()
        # Readings from before a jump are in the frame from before it; else the two frames are one.
        jumped = int(np.searchsorted(past, self.switch - self.lag))
        track_memory(y_um[:jumped], after, self.features.arrays)
        track_memory(y_um[jumped:], after, self.served.arrays)
        return after
