"""What the readings alone tell, before a model is fitted: noise floor, converter grid, repeats, spectral lines."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import special

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.masks import runs


@dataclass(frozen=True)
class NoiseFloor:
    """Standard deviation of the noise (µm) and its source: "repeated periods", "rests" or "differences"."""

    sigma_um: float
    source: str


def repeated_period(u_V: FloatArray) -> int:
    """Period of the drive in samples, if the whole drive repeats exactly at least twice; else 0."""
    n = u_V.size
    x = u_V - u_V.mean()
    if n < 64 or not np.any(x):
        return 0
    size = 1 << (2 * n - 1).bit_length()
    likeness = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: n // 2 + 1] / np.arange(n, n - n // 2 - 1, -1)
    # Skip small lags, where a smooth drive is similar to itself.
    fall = int(np.argmax(likeness < 0.5 * likeness[0]))
    if fall == 0:
        return 0
    # Take the first of the highest peaks: multiples of the period are peaks as well.
    lag = fall + int(np.argmax(likeness[fall:] > (1.0 - 1e-6) * np.max(likeness[fall:])))
    same = np.max(np.abs(u_V[lag:] - u_V[:-lag])) <= 1e-3 * np.ptp(u_V)
    return lag if same else 0


#: Spread of the usual window at rest, in that of the calmest tenth, from which on a mode rings there: 1.0 to 1.4 for
#: white, correlated and pink noise.
_RINGS = 2.0


#: How often noise may look like a line.
_NO_LINE = 1e-3


def noise_floor(data: FitData, y_um: FloatArray | None = None) -> NoiseFloor:
    """The noise floor from repeated periods, else from windows at rest (spread about a line), else from differences.

    ``y_um`` (n,): what to look at in place of the readings, such as what a model leaves of them.
    """
    y_um = data.y_um if y_um is None else y_um
    period = repeated_period(data.u_V)
    others = [u for u in (data.u2_V, data.u3_V) if u is not None]
    if period and all(repeated_period(u) == period for u in others):
        # With more than two periods, leave out the first one: the stage still settles.
        y = y_um[period:] if data.n >= 3 * period else y_um
        # Median over blocks: the beginning of a first period from rest differs by more than noise.
        d = y[period:] - y[:-period]
        block = max(8, d.size // 100)
        return NoiseFloor(float(np.median(_spread(d, block)) / np.sqrt(2.0)), "repeated periods")
    window = max(16, round(0.1 / data.dt_s))
    quiet = data.standing()
    starts = np.arange(0, data.n - window, window)
    whole = [int(s) for s in starts if quiet[s : s + window].all()]
    if len(whole) >= 4:
        t = np.linspace(-1.0, 1.0, window)
        pieces = np.array([y_um[s : s + window] for s in whole])
        pieces = pieces - pieces.mean(axis=1, keepdims=True)
        pieces -= (pieces @ t)[:, None] * t / (t @ t)
        spread = np.sqrt(np.sum(pieces**2, axis=1) / (window - 2))
        usual, least = float(np.median(spread)), float(np.quantile(spread, 0.1))
        if usual > _RINGS * least:
            # A mode rings on in the rests: where it has died down, the noise is left.
            return NoiseFloor(least, "rests")
        return NoiseFloor(max(usual, _of_whole_rests(data, y_um, quiet)), "rests")
    # Fourth differences remove the motion in the smoothest quarter of the record.
    d = np.diff(y_um, n=4) / np.sqrt(70.0)
    return NoiseFloor(float(np.quantile(_spread(d, max(8, d.size // 200)), 0.25)), "differences")


def _of_whole_rests(data: FitData, y_um: FloatArray, quiet: BoolArray) -> float:
    """Standard deviation (µm) in whole rests of at least a second about a line and the logarithm of time; 0 if few.

    Windows of a tenth of a second miss noise that is correlated over longer. The logarithm takes creep out.
    """
    spreads = []
    for a, b in runs(quiet):
        if (b - a) * data.dt_s < 1.0:
            continue
        t = np.arange(1, b - a + 1) * data.dt_s
        columns = np.stack([np.ones(b - a), t, np.log(t + 0.3), np.log(t + 3.0)])
        left = y_um[a:b] - np.linalg.lstsq(columns.T, y_um[a:b], rcond=None)[0] @ columns
        spreads.append(float(np.sqrt(left @ left / (b - a - 4))))
    return float(np.median(spreads)) if len(spreads) >= 3 else 0.0


def _spread(d: FloatArray, block: int) -> FloatArray:
    """Standard deviation in each whole block."""
    n = d.size // block * block
    return np.asarray(np.std(d[:n].reshape(-1, block), axis=1))


def monitor_noise_V(data: FitData) -> float:
    """Noise (V) of the voltage monitor while the drive is constant, at least the step of a 16-bit converter."""
    assert data.monitor_V is not None
    still = data.standing(0.1)
    d = np.diff(data.monitor_V)[still[1:]]
    least = float(np.ptp(data.monitor_V)) / 65536.0
    return max(float(np.std(d)) / np.sqrt(2.0) if d.size > 20 else 0.0, least)


@dataclass(frozen=True)
class ConverterGrid:
    """Step of the converter grid (µm, 0 if no grid is visible) and the number of levels in use."""

    step_um: float
    levels: int


def converter_grid(y_um: FloatArray) -> ConverterGrid:
    """The grid that all readings lie on, if there is one.

    The smallest distance between levels is refined to the step that fits all distances. A record with nearly as many
    levels as readings has no grid that matters.
    """
    levels = np.unique(y_um)
    if levels.size < 3 or levels.size > 0.9 * y_um.size:
        return ConverterGrid(0.0, int(levels.size))
    gaps = np.diff(levels)
    # Leave out distances that are rounding errors of doubles.
    gaps = gaps[gaps > 1e-9 * max(float(np.max(np.abs(levels))), 1e-12)]
    if gaps.size < 2:
        return ConverterGrid(0.0, int(levels.size))
    step = float(np.min(gaps))
    for _ in range(3):
        counts = np.rint(gaps / step)
        step = float(gaps.sum() / counts.sum())
    counts = np.rint(gaps / step)
    off = np.abs(gaps - counts * step) / step
    return ConverterGrid(step if float(np.quantile(off, 0.99)) < 0.05 else 0.0, int(levels.size))


def reading_limits(data: FitData) -> tuple[float, float]:
    """The lower and the upper limit (µm) at which readings stand while the voltage moves; infinite if there is none.

    Twenty readings stand there, and ten times as many as on the next level: the noise of a stage and the levels of a
    converter have no such step.
    """
    levels, count = np.unique(data.y_um[data.rate_V_per_s > 0.0], return_counts=True)
    if count.size < 3:
        return -math.inf, math.inf
    low = float(levels[0]) if count[0] >= max(20, 10 * count[1]) else -math.inf
    return low, float(levels[-1]) if count[-1] >= max(20, 10 * count[-2]) else math.inf


@dataclass(frozen=True)
class RepeatedReadings:
    """Readings that repeat the one before during motion: ``count`` of ``of`` readings where it could be seen."""

    count: int
    of: int
    where: FloatArray

    @property
    def probability(self) -> float:
        return self.count / self.of if self.of else 0.0


def repeated_readings(y_um: FloatArray, sigma_um: float, step_um: float) -> RepeatedReadings:
    """Exact repeats between two steps of the readings that are far larger than the noise and the grid.

    A clamp or friction that holds the stage is not counted: the readings are constant before or after it.
    """
    moved = np.diff(y_um)
    least = 8.0 * max(sigma_um, 1e-12) + 1.5 * step_um
    # Both steps in one direction: at the top of a fast sine a step of zero is no repeat.
    candidate = (np.minimum(moved[:-2], moved[2:]) > least) | (np.maximum(moved[:-2], moved[2:]) < -least)
    where = np.flatnonzero(candidate & (moved[1:-1] == 0.0)) + 2
    return RepeatedReadings(int(where.size), int(candidate.sum()), where.astype(np.float64))


def _amplitude(residual: FloatArray, t_s: FloatArray, f_hz: float) -> tuple[float, float]:
    """Amplitude of a spectral line and its standard error, about a slow parabola."""
    x = t_s - t_s.mean()
    span = max(float(np.ptp(x)), 1e-12)
    z = 2.0 * np.pi * f_hz * t_s
    columns = np.stack([np.sin(z), np.cos(z), np.ones_like(x), x / span, (x / span) ** 2])
    solved = np.linalg.lstsq(columns.T, residual, rcond=None)[0]
    left = residual - solved @ columns
    error = float(np.std(left)) * np.sqrt(2.0 / max(1, residual.size - 5))
    return float(np.hypot(solved[0], solved[1])), error


def has_spectral_line(
    residual_um: FloatArray, data: FitData, f_hz: float, sigmas: float = 5.5, ratio: float = 3.0
) -> bool:
    """True if a line at ``f_hz`` exceeds the noise of the fast residual at rest, and its neighbours in frequency.

    The spectra of steps and ringing are broad and contain the mains frequency too; hum is narrow and permanent.
    """
    quiet: BoolArray = data.standing(0.1)
    width = max(3, round(0.04 / data.dt_s))
    fast = residual_um - np.convolve(residual_um, np.ones(width) / width, "same")
    where = quiet
    if int(quiet.sum()) * data.dt_s < 1.0:
        # Without rests: a periodic drive has lines as well, so require three times the ratio.
        where, sigmas, ratio = np.ones(data.n, dtype=np.bool_), 3.0 * sigmas, 3.0 * ratio
    t, r = data.t_s[where], fast[where]
    size, error = _amplitude(r, t, f_hz)
    if size < sigmas * error:
        return False
    beside = [_amplitude(r, t, f_hz + d)[0] for d in (-4.3, -3.1, -2.2, 2.2, 3.1, 4.3)]
    return size > ratio * float(np.median(beside))


def is_noise(residual_um: FloatArray, mask: BoolArray) -> bool:
    """Whether the spectrum of a residual (n,) on the samples of ``mask`` (n,) is that of noise of some colour.

    Over its level (a curve over the logarithm of frequency, then a running median of 101 frequencies) the power of
    noise is exponentially distributed. An error of a model follows the drive and has lines. The slowest ten frequencies
    do not count.
    """
    r = np.where(mask, residual_um, 0.0)
    power = np.square(np.abs(np.fft.rfft((r - r.mean()) * np.hanning(r.size))))[10:-1]
    power = np.maximum(power, 1e-300)
    bend = np.polynomial.Polynomial.fit(np.log(np.arange(10.0, 10.0 + power.size)), np.log(power), 3)
    power = power / np.exp(bend(np.log(np.arange(10.0, 10.0 + power.size))))
    around = np.lib.stride_tricks.sliding_window_view(np.pad(power, 50, mode="reflect"), 101)
    level = np.median(around, axis=1) / math.log(2.0)
    return bool(np.max(power / level) < math.log(power.size / _NO_LINE))


# --- Defects of the recording itself: repeated readings and lost samples. They are listed and never named as causes.


@dataclass(frozen=True)
class Defect:
    """One defect: ``kind`` "repeats" or "gaps", how many samples, how many chance would give, and a sentence."""

    kind: str
    count: int
    by_chance: float
    words: str


def recording_defects(
    doubles: RepeatedReadings, sigma_um: float, step_um: float, lost: int, n: int
) -> tuple[Defect, ...]:
    """What is wrong with the recording. ``step_um``: converter grid (0 if none); ``lost``: missing or doubled samples.

    With noise sigma and resolution q a reading equals the one before it by chance with the probability
    q / (2 sigma sqrt(pi)) while the stage stands; in fast motion, where they are counted, far less often.
    """
    out = []
    if doubles.count:
        spread = max(sigma_um, 1e-12)
        chance = doubles.of * min(1.0, step_um / (2.0 * spread * math.sqrt(math.pi))) * math.exp(-16.0)
        p = float(special.pdtrc(doubles.count - 1, max(chance, 1e-12)))
        out.append(
            Defect(
                "repeats",
                doubles.count,
                chance,
                f"{doubles.count} of {doubles.of} readings in fast motion repeat the one before exactly; chance gives "
                f"{chance:.1g} (probability {p:.1g}); they are left out of the fit",
            )
        )
    if lost:
        out.append(
            Defect(
                "gaps", lost, 0.0, f"{lost} samples ({100 * lost / n:.2g} %) are missing or doubled in its time base"
            )
        )
    return tuple(out)
