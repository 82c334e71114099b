"""Dead reckoning: the place of the stage from the voltage alone, by solving the inverse model for the displacement.

While readings are not trusted, extrapolation by the smoother is wrong by micrometres within ten samples. Dead reckoning
instead solves, at each sample, for the displacement at which the inverse model gives the applied voltage, and advances
the hysteresis memory. The model's error at the start is subtracted, so that only its change from then on counts.

Why the place cannot diverge, for any model:

- The velocity is not a free unknown. Where voltage rises with velocity (a lag), it is the backward
  difference of the displacement: an implicit Euler step, which is stable. Where voltage falls with velocity, that
  recursion would be unstable; there the velocity follows from the change of the voltage itself, which is no recursion.
- A change of the voltage moves the stage by a slope within ``SLOPES`` times the mean one. Summed from the start this
  gives a band that limits the place. In one sample it moves the stage one way only, apart from the motion under way.
- The place stays within ``OFF_LINE`` ranges of a straight line through the start, of the model's mean slope.

The uncertainty grows with the way gone and with what the band and the line cut off. Beyond ``LOST_SHARE`` of the range
the reckoning is `lost`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.features import FeatureMap, advance
from dehyst.adaptive.inverse_model import LssvmInverse, unpacked, voltage_of
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray, IntArray

#: Newton's steps a sample, and the displacement over which the slope is taken, as a share of the range.
STEPS, SLOPE_SHARE = 2, 1e-5
#: Slopes of the voltage over the displacement, as shares of the mean one, that a stage can have. Some stages stand
#: nearly still while the voltage turns back over a tenth of the drive.
SLOPES = (0.4, 25.0)
#: Distance from the straight line through the start, in ranges, that hysteresis, creep and bend explain together.
OFF_LINE = 0.35
#: Most motion that a constant voltage causes (creep, drift), ranges per second.
CREEP_PER_S = 0.1
#: Readings before the doubtful one from which the model's error is taken.
ANCHORS = 5
#: Time constant with which the acceleration at the start is forgotten, s; time for which the stage's own motion at the
#: start (lag, ringing) widens the band, s.
FORGET_S, RUN_OUT_S = 0.05, 0.01
#: One standard deviation of the place, as a share of the way gone, and as a share of the range the most that this adds
#: and the limit of what is of use.
WAY_SHARE, WAY_MOST, LOST_SHARE = 0.002, 0.02, 0.05

#: Entries of a reckoning's numbers.
_Y, _V, _A, _U, _LOW, _HIGH, _WAY, _CUT, _OFF, _SLOPE, _LINE = range(11)


@dataclass(slots=True)
class Reckoning:
    """A reckoned place, and the fixed model that reckons it.

    numbers : place (µm, µm/s, µm/s²) and voltage (V) of the last sample; the band (µm); way gone and what the band cut
    off since the doubt began (µm); what a reading shows more than the place (µm); mean slope (V/µm), and the voltage
    at which the line through the start is at 0 µm (V).
    """

    model: Annotated[LssvmInverse, Entry("an immutable snapshot, which reckons the place")]
    memory: Annotated[FloatArray, Entry("hysteresis memory after the last sample", "µm", "m")]
    numbers: Annotated[
        FloatArray, Entry("as listed by `Reckoning`", "µm, µm/s, µm/s², V, µm, µm, µm, µm, µm, V/µm, V", "11")
    ]

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
        y, v, a = motion
        made = cls(model, memory.copy(), np.zeros(11))
        slack = abs(v) * RUN_OUT_S + 1e-3 * made.range_um
        made.numbers[:_WAY] = (y, v, a, u_before_V, y - slack, y + slack)
        slope = mean_slope(model)
        made.numbers[[_SLOPE, _LINE]] = slope, u_before_V - slope * y
        # The first step is the model's way from the measured place to its own.
        off = np.array([made.advance(float(u), anew=i == 0) for i, u in enumerate(u_V[: y_um.size])])
        for u in u_V[y_um.size :]:
            made.advance(float(u))
        if off.size:
            # The middle one of the last: some of these readings may have rung, or been wrong, already.
            made.numbers[_OFF] = float(np.median((y_um - off)[-ANCHORS:]))
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
        n[[_V, _A, _WAY, _CUT, _OFF]] *= slope
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
        voltage_of(before, v + dv, n[_A], memory, scratch, m, beta, scaled, alpha, inverse_widths)
        - voltage_of(before, v, n[_A], memory, scratch, m, beta, scaled, alpha, inverse_widths)
    ) / dv
    implicit = sign * lag > 0.0
    du = u - n[_U]
    h = SLOPE_SHARE * span
    y = before + v * dt
    for _ in range(STEPS):
        if implicit:
            v = (y - before) / dt
        there = voltage_of(y, v, n[_A], memory, scratch, m, beta, scaled, alpha, inverse_widths)
        more = voltage_of(y + h, v, n[_A], memory, scratch, m, beta, scaled, alpha, inverse_widths)
        slope = sign * min(max(sign * (more - there) / h, least), most)
        if implicit:
            slope += lag / dt
        else:
            v = du / (slope * dt)
            there = voltage_of(y, v, n[_A], memory, scratch, m, beta, scaled, alpha, inverse_widths)
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
        # A voltage that rises moves the stage one way only, apart from the motion under way and from creep.
        creep = CREEP_PER_S * span * dt
        down, up = falls / least + min(under_way, -creep), rises / least + max(under_way, creep)
        held = min(max(held, before + down), before + up)
    n[_V] = (held - before) / dt
    n[_A] *= math.exp(-dt / FORGET_S)
    n[_WAY] += abs(held - before)
    n[_Y], n[_U] = held, u
    advance(held, memory, m)
