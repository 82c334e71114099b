"""Slow motion in rests and in the cycles of a repeated motion: what creep and drifts are seen by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import legvander

from dehyst.adaptive.types import FloatArray
from dehyst.sim.fitting.lags import slow_poles

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Cycle, Readings


#: Time constants (s) of the slow motion that a rest may show after the moves before it.
_TAUS_S = (0.1, 0.4, 1.6, 6.4, 25.0, 100.0)
#: Standard errors from which a signature counts as seen.
_SIGMAS = 3.8
#: Usual drift over a record, relative to the motion. The means and heights of cycles change by less of it for many
#: reasons (a loop that settles, a start): they show no smaller one.
USUAL = 2e-3
#: Time constants of a drift that settles, in the time that the cycles take.
_SETTLES = (0.15, 0.3, 0.6, 1.2)
#: Squared error beside a form, in that beside another form and of neighbouring cycles, that speaks against it.
_CLEARLY = 4.0
_WHEN = {"": "over the record", "early": "in its first half", "late": "in its second half"}


@dataclass(frozen=True)
class Change:
    """A change, its standard error, and in which part of the record it is clearest."""

    value: float
    error: float
    when: str = ""
    #: When that part begins and ends, s.
    begin_s: float = 0.0
    end_s: float = 0.0
    #: The largest standard error over the whole record and its halves: what happens in one half excludes nothing in the
    #: other.
    widest: float = 0.0

    def agrees(self, value: float) -> bool:
        """Whether ``value`` is this change, within one error. From 2.5 errors on: a smaller change agrees with many."""
        return abs(self.value) > 2.5 * self.error and abs(self.value - value) < self.error

    def seen(self, value: float, least: float, usual: float) -> bool | None:
        """Whether ``value`` (this one, or its size) counts as seen; None between, and where the error is as large as a
        ``usual`` value."""
        if value > _SIGMAS * self.error and value > least:
            return True
        known = 2.0 * max(self.error, self.widest) < usual
        return False if value < max(2.5 * self.error, least) and known else None


@dataclass(frozen=True)
class RestsOverTime:
    """What the rests show. ``missing``: what they lack to show anything; then nothing else is given.

    ``creep``: rise per decade of time, of the step before (None: no rest follows a step); ``shift`` in µm;
    ``gain``: relative change (None: all rests are at one voltage).
    """

    missing: str
    creep: Change | None = None
    shift: Change | None = None
    gain: Change | None = None


def rests_over_time(readings: Readings) -> RestsOverTime:
    """What the rests show: motion after each step in proportion to it, motion in time alone, and in proportion to u.

    Each rest has a free level, so that no loop matters. Creep is a sum of slow lags of the readings, not of the
    voltage: a step over a steep part of the loop is larger than its voltage, and creeps by more. Both drifts are a
    line and exponentials in time. The standard errors come from leaving out one rest in turn.
    """
    data = readings.data
    long_enough = [r for r in readings.rests if (r.last - r.first) * data.dt_s >= 0.5]
    if len(long_enough) < 4:
        return RestsOverTime(f"{len(long_enough)} rests of half a second or more; four are needed")
    rests = _motion_of_rests(readings)
    values, errors = _jackknife(rests, -1)
    creep = Change(values["creep"], errors["creep"])
    if creep.value > _SIGMAS * creep.error:
        # What two shapes leave of the creep would count as a drift. Where none is seen, a third shape would only make
        # the errors larger.
        values, errors = _jackknife(rests, None)
    drifts: dict[str, Change] = {}
    for name in ("thermal_drift", "gain_drift"):
        parts = [k for k in values if k.split(".")[0] == name]
        if parts:
            best = max(parts, key=lambda k: abs(values[k]) / max(errors[k], 1e-300))
            part = best[len(name) + 1 :]
            widest = max(errors[k] for k in parts)
            drifts[name] = Change(values[best], errors[best], _WHEN[part], *rests.parts_s[part], widest)
    stepped = any(
        float(np.ptp(data.u_V[max(0, r.first - round(1.0 / data.dt_s)) : r.first + 1])) > 0.1 * data.swing_V
        for r in long_enough
    )
    return RestsOverTime("", creep if stepped else None, drifts["thermal_drift"], drifts.get("gain_drift"))


@dataclass(frozen=True)
class _Rests:
    """Normal equations of each rest, (rests, m, m) and (rests, m); what is asked of their solution, (m,) by name.

    The last column is the third shape of creep. ``variance``: of the readings within the rests, µm². ``parts_s``: begin
    and end of the parts of the record in which a change is asked for.
    """

    grams: FloatArray
    slopes: FloatArray
    functionals: dict[str, FloatArray]
    variance: float
    parts_s: dict[str, tuple[float, float]]


def _motion_of_rests(readings: Readings) -> _Rests:
    data = readings.data
    t, y, of = readings.bins(max(0.02, data.duration_s / 4000.0))
    thin = max(1, round(0.01 / data.dt_s))
    n = data.n // thin
    reading = data.y_um[: n * thin].reshape(n, thin).mean(axis=1)
    lags = np.asarray(slow_poles(reading, thin * data.dt_s / np.array(_TAUS_S)))
    # Over log tau the weights of the lags are constant (creep by the logarithm of time), a line, and a parabola.
    per_decade = _per_decade(data.slowest_s)
    weights = 0.02 / float(per_decade.sum()) * legvander(np.linspace(-1.0, 1.0, lags.shape[0]), 2).T
    creep = [np.interp(t, thin * data.dt_s * np.arange(n), row) for row in weights @ lags]
    # A gain acts on the height of the stage. On a loop the voltage does not give it, and the reading of each moment
    # would explain itself: hence the mean of each rest.
    height = np.bincount(of, y)[of] / np.bincount(of)[of] - float(reading.min())
    x = t / data.duration_s
    # One unit of each column is a size that a stage can have, so that one ridge fits all.
    in_time = np.array([x, np.exp(-5.0 * x), np.exp(-20.0 * x)])
    columns = [*creep[:2], *(0.01 * data.range_um * in_time)]
    if float(np.ptp(height)) > 0.1 * data.range_um:
        columns += [*(0.02 * height * in_time[:2])]
    rows = np.array([*columns, creep[2]])
    grams, slopes = [], []
    for i in np.unique(of):
        inside = of == i
        rows[:, inside] -= rows[:, inside].mean(axis=1, keepdims=True)
        y[inside] -= y[inside].mean()
        grams.append(rows[:, inside] @ rows[:, inside].T)
        slopes.append(rows[:, inside] @ y[inside])
    decade = np.zeros(rows.shape[0])
    decade[:2] = weights[:2] @ per_decade
    functionals = {"creep": decade}
    first, last = float(x.min()), float(x.max())
    middle = 0.5 * (first + last)
    parts = {"": (first, last), "early": (first, middle), "late": (middle, last)}
    for name, at, unit, count in (("thermal_drift", 2, 0.01 * data.range_um, 3), ("gain_drift", 5, 0.02, 2)):
        if at >= len(columns):
            continue
        for part, (begin, end) in parts.items():
            row = np.zeros(rows.shape[0])
            change = [end - begin, math.exp(-5.0 * end) - math.exp(-5.0 * begin)]
            change += [math.exp(-20.0 * end) - math.exp(-20.0 * begin)]
            row[at : at + count] = unit * np.array(change[:count])
            functionals[f"{name}.{part}"] = row
    parts_s = {part: (begin * data.duration_s, end * data.duration_s) for part, (begin, end) in parts.items()}
    return _Rests(np.array(grams), np.array(slopes), functionals, float(np.var(y)), parts_s)


def _per_decade(slowest_s: float) -> FloatArray:
    """(m,) slope of each slow lag's step response over log10 t, from 0.1 s to half the record."""
    t = np.logspace(-1.0, math.log10(max(slowest_s / 6.0, 0.3)), 60)
    rise = 1.0 - np.exp(-t[None, :] / np.array(_TAUS_S)[:, None])
    z = np.log10(t) - np.log10(t).mean()
    return np.asarray(rise @ z / float(z @ z))


def _jackknife(rests: _Rests, end: int | None) -> tuple[dict[str, float], dict[str, float]]:
    """What is asked of the solution for the columns before ``end``; standard errors by leaving out one rest in turn."""
    grams, slopes = rests.grams[:, :end, :end], rests.slopes[:, :end]
    gram, slope = grams.sum(axis=0), slopes.sum(axis=0)
    ridge = 1e-3 * rests.variance * np.eye(gram.shape[0])
    solved = np.linalg.solve(gram + ridge, slope)
    without = np.array([np.linalg.solve(gram - g + ridge, slope - s) for g, s in zip(grams, slopes, strict=True)])
    n = without.shape[0]
    values, errors = {}, {}
    for name, row in rests.functionals.items():
        values[name] = float(row[:end] @ solved)
        each = without @ row[:end]
        errors[name] = float(np.sqrt((n - 1) / n * np.sum(np.square(each - each.mean()))))
    return values, errors


@dataclass(frozen=True)
class CyclesOverTime:
    """What equal cycles show. ``missing``: what they lack to show anything; then nothing else is given.

    ``course``: times (s) and means (µm) over one period, (m,) each; empty where other motion lies between the cycles.
    ``grew``: their height changes in time, by what is usual (None: by less, or it settles). ``moved``: their mean does,
    ``creeps`` clearly with the logarithm of time, ``goes_on`` clearly in another way. ``also``: what a change in time
    may be as well.
    """

    missing: str
    height_words: str = ""
    grew: bool | None = None
    mean_words: str = ""
    moved: bool | None = False
    creeps: bool = False
    goes_on: bool = False
    also: tuple[str, ...] = ()
    course: tuple[FloatArray, FloatArray] = (np.empty(0), np.empty(0))


def cycles_over_time(readings: Readings) -> CyclesOverTime:
    """Creep and both drifts from height and mean of cycles of one kind: do they go with time or with its logarithm?

    A drift goes on; creep after the beginning of the motion falls off with the logarithm of time. Where that beginning
    lies before the recording, the logarithm may be as good as straight.
    """
    data = readings.data
    kinds: dict[tuple[int, int], list[Cycle]] = {}
    for cycle in readings.cycles:
        tall_V, period = cycle.amplitude_V(data.u_V), cycle.period_s(data.dt_s)
        kinds.setdefault((round(math.log(tall_V) / 0.03), round(math.log(period) / 0.05)), []).append(cycle)
    same = max(kinds.values(), key=lambda c: (c[-1].stop - c[0].start) * min(len(c), 4), default=[])
    # The first cycle of a kind still carries the history before it; one that ends with the record may be cut short.
    same = [cycle for cycle in same[1:] if cycle.stop < data.n - 1]
    if len(same) < 5 or (same[-1].stop - same[0].start) < 0.15 * data.n:
        return CyclesOverTime("no motion is repeated often enough, over long enough a time")
    t = np.array([0.5 * (c.start + c.stop) * data.dt_s for c in same])
    # Samples of a cycle that count in all cycles, and by how much each cycle is taller than the usual one.
    at = np.array([np.linspace(c.start, c.stop, min(c.stop - c.start for c in same), endpoint=False) for c in same])
    turns = np.interp(at, np.arange(data.n), data.y_um)[:, readings.mask[np.rint(at).astype(np.int64)].all(axis=0)]
    if turns.shape[1] < at.shape[1] // 2:
        return CyclesOverTime("too few samples count in all cycles")
    means_um = turns.mean(axis=1)
    usual = turns.mean(axis=0) - float(turns.mean())
    relative = turns @ usual / float(usual @ usual) - 1.0
    change, error = _slope(t, relative)
    # What of the mean goes with the height is a change of the gain, about some displacement that the stage reaches.
    if abs(change) > _SIGMAS * error:
        level_um = float(relative @ means_um) / float(relative @ relative)
        means_um -= relative * float(np.clip(level_um, -data.range_um, data.range_um))
    shift, shift_error = _slope(t, means_um)
    span = float(t[-1] - t[0])
    grew = abs(change * span) if abs(change) > _SIGMAS * error else 0.0
    gained = _beyond(grew, 3e-4, USUAL)
    since = np.log10(t - same[0].start * data.dt_s + (t[1] - t[0]))
    settles = bool(gained) and _misfit(since, relative) < 0.9 * _misfit(t, relative)
    # A drift is a line or settles exponentially, creep goes with the logarithm; a mean that follows neither wanders.
    drift = min(_misfit(t, means_um), *(_misfit(np.exp(-t / (share * span)), means_um) for share in _SETTLES))
    creep, white = _misfit(since, means_um), float(np.sum(np.square(np.diff(means_um, n=2)))) / 6.0
    wanders = min(drift, creep) > _CLEARLY * white
    varies = abs(shift) > _SIGMAS * shift_error or _misfit(0.0 * t, means_um) > _CLEARLY * white
    way_um, sigma_um = float(np.ptp(means_um)) if varies else 0.0, readings.sigma_um
    moved = _beyond(way_um, max(sigma_um, 1e-4 * data.range_um), max(2.0 * sigma_um, USUAL * data.range_um))
    creeps = bool(moved) and drift > _CLEARLY * (creep + white)
    goes_on = bool(moved) and (creep > _CLEARLY * (drift + white) or wanders)
    n = len(same)
    per_decade, per_decade_error = _slope(since, means_um)
    manner = "the logarithm of time" if creeps else "time" if goes_on else "time or its logarithm"
    mean_words = (
        f"the mean of {n} equal cycles changes by {shift * span:.2g} µm in {span:.3g} s, and goes with {manner}"
    )
    height_words = (
        f"the height of {n} equal cycles changes by {100 * change * span:.2g} ± {196 * error * span:.1g} % in "
        f"{span:.3g} s"
    )
    also = () if data.begins_at_rest else ("creep",)
    as_creep = "; creep that began before the recording may do the same" if also else ""
    if settles:
        height_words += ", and settles with the logarithm of time"
    elif gained:
        height_words += as_creep
    if goes_on:
        mean_words += as_creep
    settled = creeps and abs(per_decade) > 5.0 * per_decade_error
    words = height_words, None if settles else gained, mean_words
    return CyclesOverTime("", *words, moved, settled, goes_on, also, _course(readings, same))


def _beyond(size: float, least: float, usual: float) -> bool | None:
    """Whether a change is as large as usual; None where it is smaller, and more than nothing."""
    return True if size > usual else None if size > least else False


def _course(readings: Readings, same: list[Cycle]) -> tuple[FloatArray, FloatArray]:
    """Mean over one period (µm) at eight times (s) a period. Where each cycle repeats the last, that of its motion is
    the same at any phase."""
    data, period = readings.data, float(np.mean([c.stop - c.start for c in same]))
    if same[-1].stop - same[0].start > (len(same) + 0.5) * period:
        return np.empty(0), np.empty(0)
    index = np.arange(data.n)
    total = np.append(0.0, np.cumsum(np.interp(index, index[readings.mask], data.y_um[readings.mask])))
    first = np.arange(same[0].start, same[-1].stop - period, period / 8.0)
    at = np.arange(data.n + 1)
    means_um = (np.interp(first + period, at, total) - np.interp(first, at, total)) / period
    return (first + 0.5 * period) * data.dt_s, means_um


def _misfit(t: FloatArray, v: FloatArray) -> float:
    """Squared error of a straight line of v over t."""
    slope, _ = _slope(t, v)
    return float(np.sum(np.square(v - v.mean() - slope * (t - t.mean()))))


def _slope(t: FloatArray, v: FloatArray) -> tuple[float, float]:
    """Slope of v over t and its standard error."""
    x = t - t.mean()
    slope = float(x @ v / max(float(x @ x), 1e-300))
    left = v - v.mean() - slope * x
    return slope, float(np.sqrt(left @ left / max(1, t.size - 2) / max(float(x @ x), 1e-300)))
