"""Faults of the time base: readings that repeat the one before, a sensor clock that runs slow, and lost samples.

In a diagnosis a clock error is one form, and *slips* another: from some sample on the readings are late or early by
whole samples. The functions that find and date slips compare readings with a model's readings; `fit_slips` alternates
them with calibrations. Readings that repeat are a defect of the recording (`sim.readings.noise`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.effects.counter_noise import uniform
from dehyst.sim.fitting.calibration import calibrate, evaluate
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.lags import resample_by
from dehyst.sim.fitting.stage_model import CauseModel, Guess, ModelFit, StageModel, single_guesses
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.lateness import SlipList
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


#: Largest lateness of a slow clock, s; it stays there.
LATEST_S = 0.05


def _clock_slots(context: Context) -> int:
    return math.ceil(LATEST_S / context.dt_s) + 2


@block
def run_timing(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: probability of a repeat, lateness per sample, slots, seed. s: last reading, slot (-1: not begun), ring."""
    slots = int(p[2])
    for k in range(n):
        index = k0 + k
        if s[1] < 0.0:
            s[0] = x[k]
            for j in range(slots):
                s[2 + j] = x[k]
        newest = (int(s[1]) + 1) % slots
        s[1] = newest
        s[2 + newest] = x[k]
        late = min(p[1] * index, slots - 2.0)
        whole = int(late)
        first = s[2 + (newest - whole + slots) % slots]
        second = s[2 + (newest - whole - 1 + 2 * slots) % slots]
        reading = first + (late - whole) * (second - first)
        if p[0] > 0.0 and uniform(p[3], index) < p[0]:
            reading = s[0]
        s[0] = reading
        x[k] = reading


def derive_timing(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["repeat_probability"], values["slow_ppm"] * 1e-6, float(_clock_slots(context)), float(context.seed)


# Its first form in a diagnosis: a clock error.


@compiled
def resample(x: FloatArray, stretch: float, shift: float) -> FloatArray:
    """(n,) x at the instants k (1 + stretch) + shift, see `resample_by`."""
    shifts = stretch * np.arange(x.shape[0], dtype=np.float64) + shift
    return resample_by(x, shifts.astype(np.float64))


@dataclass(frozen=True)
class Clock(CauseModel):
    """A recorder's clock that runs fast or slow against the stage's: t' = (1 + e) t."""

    test_answers_to_others: bool = True
    imitates_others: bool = True
    must_be_seen: bool = True
    of_one_recording: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 3.0 <= abs(float(p[0])) <= 1500.0

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        """A change of the lateness by three standard errors that is within a quarter of the fitted one."""
        change = readings.once(change_of_lateness)
        fits = abs(float(p[0]) + change.ppm) < 0.25 * abs(change.ppm)
        # In a description of all motion a loop's own lateness wanders: there only a clear trend counts.
        clear = change.steady if change.count == 0 else abs(change.ppm) > 3.0 * change.sigma_ppm
        return f"the fit by {-float(p[0]):.3g} ppm" if fits and clear else ""

    def borne_out(self, readings: Readings) -> bool:
        return not readings.once(change_of_lateness).slips

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (ModelParameter("clock_ppm", "ppm", 0.0, -2000.0, 2000.0, 5.0, ActsOn.READING),)

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([-200.0, -60.0, -15.0, 15.0, 60.0, 200.0])

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return y_um if p[0] == 0.0 else np.asarray(resample(y_um, 1e-6 * float(p[0]), 0.0))


# Its second form: slips.

#: Largest total shift of a column, samples.
MOST = 12
#: More slips than this are taken for another cause.
MOST_SLIPS = 16
_BLOCK = 8
#: A slip before this sample cannot be told from the recorder's latch.
_FIRST = 100
#: Least distance of two slips, samples: a shift that is soon taken back is a model error.
_SHORTEST = 64
#: Rounds in which slips of size zero are dropped; each is a calibration.
_ROUNDS_OF_DROPPING = 3
IntArray = NDArray[np.int64]
#: Least share of the squared error that a further slip must remove.
_LEAST_GAIN = 0.002
#: Largest share of the squared error that the first fit may leave for the search to go on.
_PROMISING = 0.6


@compiled
def _path(cost: FloatArray, price: float) -> FloatArray:
    """(blocks,) cheapest path through ``cost`` (blocks, shifts) if a change by one shift costs ``price`` (Viterbi)."""
    n, m = cost.shape
    back = np.zeros((n, m), dtype=np.int8)
    total = cost[0].copy()
    for b in range(1, n):
        for j in range(1, m):  # A change by several shifts pays for each.
            if total[j - 1] + price < total[j]:
                total[j] = total[j - 1] + price
                back[b, j] = back[b, j - 1] - 1
        for j in range(m - 2, -1, -1):
            if total[j + 1] + price < total[j]:
                total[j] = total[j + 1] + price
                back[b, j] = back[b, j + 1] + 1
        for j in range(m):
            total[j] += cost[b, j]
    out = np.empty(n)
    j = int(np.argmin(total))
    for b in range(n - 1, -1, -1):
        out[b] = j
        j += int(back[b, j])
    return out


def find_slips(y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> SlipList:
    """The slips of the readings ``y_um`` (n,) against the model ``model_um`` (n,), by a coarse search.

    Asked of first differences, so that slow errors of the model do not matter, in blocks of eight samples. A slip has
    to save far more than the typical error of a block.
    """
    n = y_um.size // _BLOCK * _BLOCK
    best_slip_move = np.diff(y_um, prepend=y_um[:1])
    there = np.diff(model_um, prepend=model_um[:1])
    inside = mask & np.append(mask[:1], mask[:-1])
    cost = np.empty((n // _BLOCK, 2 * MOST + 1))
    for j in range(2 * MOST + 1):
        shift = j - MOST
        ahead = np.roll(there, -shift)
        error = np.square(np.where(inside, best_slip_move - ahead, 0.0))
        cost[:, j] = np.add.reduceat(error[:n], np.arange(0, n, _BLOCK))
    least = cost.min(axis=1)
    if not np.all(np.isfinite(least)):
        return ()
    cost -= least[:, None]
    # A wrong model makes many blocks expensive: raise the price until few slips remain.
    price = 12.0 * max(float(np.quantile(least, 0.9)), 1e-18)
    for _ in range(12):
        path = _path(np.ascontiguousarray(cost), price)
        at = np.flatnonzero(np.diff(path)) + 1
        if at.size <= MOST_SLIPS:
            return tuple((int(b * _BLOCK), int(path[b] - path[b - 1])) for b in at)
        price *= 3.0
    return ()


@compiled
def _best_cut(before_um: FloatArray, after_um: FloatArray, first: int) -> int:
    """The sample k that minimises the squared error of ``before_um`` up to k and of ``after_um`` from k on."""
    total, least, at = 0.0, 0.0, first
    for k in range(before_um.shape[0]):
        total += before_um[k] * before_um[k] - after_um[k] * after_um[k]
        if total < least:
            least, at = total, first + k + 1
    return at


def date_slips(found: SlipList, y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> SlipList:
    """The slips with their first samples fitted, each between its neighbours, by least squares.

    ``model_um`` (n,) is the reading without any slip. While the stage rests, a slip cannot be dated.
    """
    out = list(found)
    n = y_um.size
    index = np.arange(n)
    for _ in range(3):
        before = list(out)
        shift = 0
        for i, (_, size) in enumerate(out):
            first = out[i - 1][0] if i > 0 else 0
            last = out[i + 1][0] if i + 1 < len(out) else n
            k = index[first:last]
            error = [
                np.where(mask[first:last], y_um[first:last] - model_um[np.clip(k + s, 0, n - 1)], 0.0)
                for s in (shift, shift + size)
            ]
            out[i] = (max(int(_best_cut(error[0], error[1], first)), 1), size)
            shift += size
        if out == before:
            break
    sizes: dict[int, int] = {}
    for at, size in out:
        sizes[at] = sizes.get(at, 0) + size
    return tuple((at, size) for at, size in sizes.items() if size)


@compiled
def _best_stretch(before_um: FloatArray, after_um: FloatArray, ends: IntArray, first: int) -> tuple[float, int, int]:
    """(gain, begin, end): the stretch up to one of ``ends`` over which ``after_um`` has the largest gain (µm²)."""
    best, begin, end = 0.0, 0, 0
    least, at, late, total, e = 0.0, first, 0.0, 0.0, 0
    for k in range(first, before_um.shape[0]):
        j = k - _SHORTEST
        if j >= first:
            late += before_um[j] * before_um[j] - after_um[j] * after_um[j]
            if late < least:
                least, at = late, j + 1
        total += before_um[k] * before_um[k] - after_um[k] * after_um[k]
        while e < ends.shape[0] and ends[e] <= k + 1:
            if ends[e] == k + 1 and total - least > best:
                best, begin, end = total - least, at, k + 1
            e += 1
    return best, begin, end


def best_slip_move(found: SlipList, y_um: FloatArray, model_um: FloatArray, mask: BoolArray) -> tuple[SlipList, float]:
    """The slips after the best single change, and by how much it reduces the squared error, µm².

    A change shifts one stretch by some samples. The stretch ends at a slip or at the last sample, or begins at a slip;
    so a slip is added or split in two.
    """
    n = y_um.size
    index = np.arange(n)
    shifts = np.zeros(n, dtype=np.int64)
    for at, size in found:
        shifts[at:] += size
    ends = np.array([*(at for at, _ in found), n], dtype=np.int64)
    # In reversed time the begin of a stretch is its end.
    begins = np.array([n - at for at, _ in reversed(found)], dtype=np.int64)

    def error(extra: int) -> FloatArray:
        return np.where(mask, y_um - model_um[np.clip(index + shifts + extra, 0, n - 1)], 0.0)

    now = error(0)
    back = np.ascontiguousarray(now[::-1])
    best = (0.0, 0, n, 0)
    for extra in (d for d in range(-MOST, MOST + 1) if d):
        other = error(extra)
        gain, begin, end = _best_stretch(now, other, ends, _FIRST)
        best = max(best, (gain, begin, end, extra))
        if begins.size:
            gain, late, early = _best_stretch(back, np.ascontiguousarray(other[::-1]), begins, 0)
            best = max(best, (gain, n - early, n - late, extra))
    gain, begin, end, extra = best
    sizes = dict(found)
    for at, by in ((begin, extra), (end, -extra)):
        if at < n:
            sizes[at] = sizes.get(at, 0) + by
    return tuple((at, size) for at, size in sorted(sizes.items()) if size), gain


def merge_close_slips(found: SlipList) -> SlipList:
    """The slips without those at the beginning, and with slips that are too close together merged into one."""
    out: list[tuple[int, int]] = []
    for at, size in found:
        if at < _FIRST:
            continue
        if out and at - out[-1][0] <= _SHORTEST:
            before, its = out.pop()
            at, size = before, its + size
        if size:
            out.append((at, size))
    return tuple(out)


@dataclass(frozen=True)
class Slips(CauseModel):
    """Samples lost or doubled in one column, while the time column continues without a gap."""

    test_answers_to_others: bool = True
    imitates_others: bool = True
    beside_its_kind: bool = True
    variant: str = "slips"
    of_one_recording: bool = True
    #: The slips, found again in every residual unless the readings themselves date them.
    found: SlipList = ()
    dated: bool = False

    def missing(self, data: FitData) -> str:
        return "" if self.found else "a lasting jump of the timing"

    def borne_out(self, readings: Readings) -> bool:
        return slips_are_borne_out(readings, self.found)

    def shown(self, readings: Readings) -> Slips:
        slips = readings.once(change_of_lateness).slips
        return replace(self, found=slips, dated=True) if slips else self

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        """The fit loses as many samples at the dates that the readings give."""
        slips = readings.once(change_of_lateness).slips
        fits = len(slips) == p.size and all(abs(q - size) < 0.4 for q, (_, size) in zip(p, slips, strict=True))
        return f"the fit loses {p.sum():.3g}" if slips and fits else ""

    def found_again(self, fit: ModelFit, mask: BoolArray) -> Slips:
        if self.dated or any(cause.name == self.name for cause in fit.model.causes):
            return self
        return replace(self, found=find_slips(fit.model.data.y_um, fit.signals.reading_um, mask))

    def own_fit(self, bare: StageModel, base: ModelFit, mask: BoolArray) -> ModelFit:
        if self.dated:
            start = np.append(base.p, [float(size) for _, size in self.found])
            return calibrate(bare.with_cause(self), start, mask, 8, 1e-3)
        return fit_slips(self, bare, base, mask)

    def fitted_again(self, fit: ModelFit, index: int, mask: BoolArray) -> ModelFit:
        """The fit with its slips searched again beside all its causes, if that is better.

        An earlier model that lacked some causes may have dated slips wrongly or missed one.
        """
        if self.dated:
            return fit
        bare = fit.model.without_cause(index)
        where = fit.model.slice_of(index)
        # `fit_slips` appends the slips at the end of the causes.
        base = evaluate(bare, np.concatenate([fit.p[: where.start], fit.p[where.stop :]]), mask)
        there = reading_without_slips(fit, index)
        tried = fit_slips(self, bare, base, mask, date_slips(self.found, fit.model.data.y_um, there, mask))
        return tried if tried.sse_um2 < (1.0 - 1e-4) * fit.sse_um2 else fit

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        """True if every slip is a whole number of samples."""
        return bool(np.all(np.abs(p - np.rint(p)) < 0.4) and np.all(np.abs(p) > 0.5))

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return tuple(
            ModelParameter(f"slip{i + 1}_samples", "1", 0.0, -MOST - 1.0, MOST + 1.0, 0.2, ActsOn.READING)
            for i in range(len(self.found))
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return [[np.array([float(size) for _, size in self.found])]]

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if not np.any(p):
            return y_um
        shifts = np.zeros(data.n)
        for (at, _), size in zip(self.found, p, strict=True):
            shifts[at:] += size
        return np.asarray(resample_by(y_um, shifts))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        one = np.ones(p.size)
        still = np.zeros(p.size)
        return {
            "slips": (float(p.size), still),
            "lost_samples": (float(p.sum()), one),
            "first_slip_s": (self.found[0][0] * data.dt_s, still),
            "clock_ppm": (0.0, still),
        }


def reading_without_slips(fit: ModelFit, index: int) -> FloatArray:
    """(n,) the model's reading without the slips of ``causes[index]``."""
    p = fit.p.copy()
    p[fit.model.slice_of(index)] = 0.0
    return fit.model.simulate(p, ActsOn.READING, fit.signals).reading_um


def fit_slips(cause: Slips, bare: StageModel, base: ModelFit, mask: BoolArray, known: SlipList = ()) -> ModelFit:
    """Fit slips of whole samples together with the model ``base``; slips found first make others visible.

    ``known`` slips are the start. Without them the search starts beside ``base`` and beside a fit with a clock error:
    many slips of one sign resemble a clock error, which then distorts the other parameters less.
    """
    y_um, own, index = base.model.data.y_um, base.p.size, len(bare.causes)

    def fitted(p: FloatArray, found: SlipList, iterations: int, sizes_too: bool = False) -> ModelFit:
        sizes = [float(size) for _, size in found]
        only = None if sizes_too else frozenset(range(own))
        model = bare.with_cause(replace(cause, found=found))
        return calibrate(model, np.concatenate([p[:own], sizes]), mask, iterations, 1e-3, only)

    starts = [base.p]
    if not known:
        clock = calibrate(bare.with_cause(Clock()), np.append(base.p, 0.0), mask, 6, 1e-2)
        starts.append(clock.p[:own])
    fits: list[tuple[ModelFit, SlipList]] = []
    for p in starts:
        there = bare.simulate(p).reading_um
        found = date_slips(
            merge_close_slips(date_slips(known or find_slips(y_um, there, mask), y_um, there, mask)), y_um, there, mask
        )
        if found:
            fits.append((fitted(p, found, 4), found))
    fit, found = min(fits, key=lambda pair: pair[0].sse_um2, default=(base, ()))
    promising = bool(known) or fit.sse_um2 < _PROMISING * base.sse_um2
    for _ in range(2 * MOST_SLIPS if promising else 0):
        there = reading_without_slips(fit, index) if found else fit.signals.reading_um
        after, gain = best_slip_move(found, y_um, there, mask)
        if gain < _LEAST_GAIN * fit.sse_um2 or len(after) > MOST_SLIPS:
            break
        found = merge_close_slips(date_slips(after, y_um, there, mask))
        fit = fitted(fit.p, found, 4)
    # The sizes are free in the last fit: whole numbers then confirm that these are slips.
    found = found or cause.found
    fit = fitted(fit.p, found, 8, sizes_too=not known)
    return fit if known else without_small_slips(fit, found, own, lambda p, f: fitted(p, f, 8, sizes_too=True))


def without_small_slips(
    fit: ModelFit, found: SlipList, own: int, fitted: Callable[[FloatArray, SlipList], ModelFit]
) -> ModelFit:
    """The fit without the slips that a wrong loop called for: beside a better one they shrink to nothing.

    The others then become whole. If they do not within a few rounds, or the error doubles, ``fit`` stays.
    """
    fewer = fit
    for _ in range(_ROUNDS_OF_DROPPING):
        sizes = np.rint(fewer.p[own:]).astype(int)
        kept = merge_close_slips(tuple((at, int(n)) for (at, _), n in zip(found, sizes, strict=True) if n))
        if not kept or len(kept) == len(found):
            break
        found, fewer = kept, fitted(fewer.p, kept)
    whole = bool(np.all(np.abs(fewer.p[own:] - np.rint(fewer.p[own:])) < 0.4))
    return fewer if whole and fewer.sse_um2 < 2.0 * fit.sse_um2 else fit


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    ppm, _ = form.reported(p, data)["clock_ppm"]
    return InLibrary((TIMING.clipped(repeat_probability=0.0, slow_ppm=max(0.0, -ppm)),))


# Its signature in the readings.


#: Passes in which the clock error that was found is taken off and the lateness is asked again.
_PASSES = 6


@dataclass(frozen=True)
class LatenessChange:
    """By how much the lateness of the readings changes over the record, in ``count`` windows of fast motion.

    ``count`` 0: by a description of all motion. ``steady``: in both halves of the record alike. ``slips``: lost samples
    by their dates.
    """

    count: int
    ppm: float = 0.0
    sigma_ppm: float = 0.0
    steady: bool = False
    slips: SlipList = ()


def change_of_lateness(readings: Readings) -> LatenessChange:
    """The time by which the readings are late, in windows of fast motion: its change over the record.

    A clock error makes it grow in proportion to time; lost or doubled samples make it jump by whole samples.
    """
    from scipy import stats  # a simulated stage waits for neither

    from dehyst.sim.readings.lateness import lateness

    data = readings.data
    t, d, e = readings.lateness
    if t.size < 6:
        found = readings.once(lateness)
        return LatenessChange(0, -found.change_ppm, found.error_ppm, bool(found.ppm), found.slips)
    to_ppm = 1e6 * data.dt_s
    off, slope, sigma = 0.0, *_trend(t, d, e)
    now = readings
    for _ in range(_PASSES):
        # The description of late readings takes a part of their lateness over, all of it where the motion is a sine:
        # the median of the slopes between windows is taken off the readings, and they are described again.
        step = float(stats.theilslopes(d, t).slope)
        if abs(step) < 1.96 * sigma:
            break
        other = readings.with_readings(np.asarray(resample(data.y_um, (off + step) * data.dt_s, 0.0)))
        if float(np.std(other.left_um)) > float(np.std(now.left_um)):
            # What is taken off was not late: the description is worse.
            break
        off, now = off + step, other
        t, d, e = now.lateness
        slope, sigma = _trend(t, d, e)
    ppm, sigma = to_ppm * (off + slope), to_ppm * sigma
    half = t < 0.5 * (t[0] + t[-1])
    parts = [to_ppm * (off + _trend(t[p], d[p], e[p])[0]) for p in (half, ~half) if int(p.sum()) >= 4]
    steady = off != 0.0 and len(parts) == 2 and all(abs(part - ppm) < 0.5 * abs(ppm) for part in parts)
    return LatenessChange(t.size, ppm, sigma, steady)


def seen(readings: Readings) -> Sight:
    """A clock error by the change of the lateness of the readings (`change_of_lateness`)."""
    change = readings.once(change_of_lateness)
    if change.slips:
        dt_s = readings.data.dt_s
        dates = ", ".join(f"{n:+d} from {at * dt_s:.4g} s on" for at, n in change.slips)
        return Sight(True, f"the readings are early by whole samples: {dates}")
    where = f"over {change.count} stretches of motion" if change.count else "by a description of all motion"
    words = f"the readings' lateness changes by {change.ppm:.3g} ± {1.96 * change.sigma_ppm:.2g} ppm {where}"
    if change.steady and abs(change.ppm) > 5.0 * change.sigma_ppm and abs(change.ppm) > 12.0:
        return Sight(True, words)
    # Slips have dates of their own and are judged by whole samples; without a trend nothing is decided here.
    return Sight(None, words)


def _trend(t: FloatArray, d: FloatArray, e: FloatArray) -> tuple[float, float]:
    """Weighted slope of d over t, and its standard error by what a line leaves."""
    columns = np.stack([np.ones_like(t), t]) / e
    solved = np.linalg.lstsq(columns.T, d / e, rcond=None)[0]
    left = d / e - solved @ columns
    cover = np.linalg.pinv(columns @ columns.T) * max(1.0, float(left @ left) / max(1, t.size - 2))
    return float(solved[1]), float(np.sqrt(cover[1, 1]))


def slips_are_borne_out(readings: Readings, slips: tuple[tuple[int, int], ...]) -> bool:
    """False where the lateness of the readings does not follow dated slips (first sample, number of samples).

    Whole samples lost or doubled stay until the end of the record. Lateness that wanders by more than they explain is
    a lag, or a limit of the amplifier.
    """
    t, d, _ = readings.lateness
    count = np.zeros_like(t)
    for first, size in slips:
        count += size * (t > first * readings.data.dt_s)
    if t.size < 6 or float(np.ptp(count)) == 0.0:
        # The lateness is not known on both sides of a slip: nothing speaks against it.
        return True
    # The sign of a count is the recorder's; a stage model's own errors are lateness too, of a sample or so.
    wanders = min(float(np.median(np.abs(x - np.median(x)))) for x in (d - count, d + count))
    return wanders < 2.0


TIMING = Kind(
    name="timing",
    place=Place.TIMING,
    parameters=(
        Parameter("repeat_probability", "1", 0.0, 0.5, 0.001, "share of readings that repeat the one before"),
        Parameter("slow_ppm", "ppm", 0.0, 1000.0, 0.0, "how slow the sensor's clock is"),
    ),
    derive=derive_timing,
    rest=lambda values, context: [0.0, -1.0] + [0.0] * _clock_slots(context),
    block=run_timing,
    signature="gaps, zero differences; a phase that grows with time",
    mistaken_for=("delay",),
    tells_apart="a delay is constant",
    source="10 to 100 ppm between two crystals (common knowledge of the field)",
    cause=Cause(
        sign="the readings get later and later, or late by whole samples",
        forms=(Clock(), Slips()),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.lag_over_time,
    ),
)
