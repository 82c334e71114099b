"""How late the readings are, and where that changes, in motion that is slow for its sampling.

The motion is described by columns that are linear in their weights: the voltage, plays, slow changes. Readings that are
early by ``a`` samples differ from it by ``a`` times its speed. So lost samples are a step of that column at their date,
and a wrong clock is a ramp. All dates are tried at once by sums up to the end. What the description lacks repeats with
the motion and moves neither; standard errors come from sums over blocks of a second and more. Where windows of half a
second tell the lateness (`Readings.lateness`), they are asked instead: they need no such description of fast motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.baselines.prandtl_ishlinskii.operators import play_run
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.lags import resample_by, slow_poles
from dehyst.sim.readings.readings import RADII, Readings

#: Standard errors from which a step or a ramp counts.
_SIGMAS = 5.0
#: Most of a sample by which a slip may miss a whole number.
_WHOLE = 0.3
#: Two slips are at least so many samples apart.
_NEAR = 64
#: More slips than this are something else.
MOST_SLIPS = 16
#: Most by which the trend of a clock's lateness may differ in half of the record, relative to it.
_HALVES = 0.5
#: Passes of a fit of the lateness: the readings are moved by what was found, and described again.
_PASSES = 4

#: Slips in order: first sample, and number of samples lost (negative: gained).
SlipList = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Lateness:
    """``slips``: lost samples by their dates, or none. ``ppm``: by how much the clock is fast, 0 where it is not seen;
    ``change_ppm``, ``error_ppm``: the trend of the lateness over the record and its standard error."""

    slips: SlipList = ()
    ppm: float = 0.0
    change_ppm: float = 0.0
    error_ppm: float = float("inf")


class _Description:
    """What the columns (m, n) can say of readings, on the samples of ``mask`` (n,)."""

    def __init__(self, columns: FloatArray, mask: BoolArray) -> None:
        self.use = mask.astype(np.float64)
        rows = columns * self.use
        rows /= np.maximum(np.sqrt(np.sum(rows * rows, axis=1)), 1e-300)[:, None]
        size, turn = np.linalg.eigh(rows @ rows.T)
        kept = size > 1e-10 * size[-1]
        self.basis = np.ascontiguousarray((turn[:, kept] / np.sqrt(size[kept])).T @ rows)

    def of(self, y_um: FloatArray, early: FloatArray) -> _Described:
        """Readings moved by ``early`` samples (n,), described."""
        moved = np.asarray(resample_by(np.ascontiguousarray(y_um), -early)) if np.any(early) else y_um
        y = moved * self.use
        described = (self.basis @ y) @ self.basis
        return _Described(self, y - described, np.gradient(described) * self.use)


@dataclass(frozen=True)
class _Described:
    """``left_um``: readings less their description; ``speed_um``: motion of the description per sample, (n,) each."""

    by: _Description
    left_um: FloatArray
    speed_um: FloatArray

    def moved_by(self, late: FloatArray) -> FloatArray:
        """(k, n) what a lateness of the form ``late`` (k, n) does that the description cannot imitate."""
        rows = late * self.speed_um
        return np.asarray(rows - (rows @ self.by.basis.T) @ self.by.basis)

    def best_step(self, found: FloatArray) -> int:
        """The sample from which on a step of the lateness explains most beside those of the form ``found`` (k, n)."""
        basis, left, v = self.by.basis, self.left_um, self.speed_um
        if found.size:
            q = np.linalg.qr(self.moved_by(found).T)[0].T
            basis, left = np.concatenate([basis, q]), left - (q @ left) @ q
        slope = np.cumsum((left * v)[::-1])[::-1]
        power = np.cumsum((v * v)[::-1])[::-1]
        for row in basis:
            power -= np.square(np.cumsum((row * v)[::-1])[::-1])
        # Too near to the ends a step is a shift of the whole record, or nothing.
        known = power > 1e-3 * float(v @ v)
        return int(np.argmax(np.where(known, np.square(slope) / np.where(known, power, 1.0), 0.0)))

    def solved(self, late: FloatArray, block: int) -> tuple[FloatArray, FloatArray, float]:
        """(k,) sizes of the lateness of the forms ``late`` (k, n), their standard errors, and what is left, µm²."""
        rows = self.moved_by(late)
        inverse = np.linalg.pinv(rows @ rows.T)
        sizes = inverse @ (rows @ self.left_um)
        left = self.left_um - sizes @ rows
        # The largest of several lengths: what the description lacks may wander slowly.
        errors = []
        for size in {block, max(block, left.size // 20), max(block, left.size // 10)}:
            sums = np.add.reduceat(rows * left, np.arange(0, left.size, size), axis=1)
            errors.append(np.sqrt(np.maximum(np.diag(inverse @ (sums @ sums.T) @ inverse), 0.0)))
        return sizes, np.max(errors, axis=0), float(left @ left)


def lateness(readings: Readings) -> Lateness:
    """Slips or a wrong clock in the readings, by their description with plays of the voltage."""
    data = readings.data
    if data.swing_V == 0.0:
        return Lateness()
    by, block, n = _Description(_columns(readings), readings.mask), _block(data), data.n
    ramp = np.arange(n) / n
    first = now = by.of(data.y_um, np.zeros(n))
    total, error, left_of_clock = 0.0, 0.0, float("inf")
    for _ in range(_PASSES):
        (step,), (error,), left_of_clock = now.solved(ramp[None], block)
        total += float(step)
        now = by.of(data.y_um, total * ramp)
        if abs(step) < 0.5 * error:
            break
    change_ppm, error_ppm = 1e6 * total / n, 1e6 * float(error) / n
    slips, left_of_slips = _slips(by, first, data.y_um, block)
    if slips and left_of_slips < left_of_clock:
        return Lateness(slips, 0.0, change_ppm, error_ppm)
    # Lateness that wanders has a trend, too. A clock's is the same in both halves, and no step explains it as well.
    halves = np.array([np.minimum(ramp, 0.5), np.maximum(ramp - 0.5, 0.0)])
    other, errors, _ = now.solved(halves, block)
    steady = bool(np.all(np.abs(other) < _HALVES * abs(total) + 2.0 * errors))
    *_, left_of_step = first.solved((np.arange(n) >= first.best_step(np.empty((0, n))))[None].astype(float), block)
    clear = abs(total) > _SIGMAS * error and steady and left_of_clock < left_of_step
    return Lateness((), change_ppm if clear else 0.0, change_ppm, error_ppm)


def _block(data: FitData) -> int:
    return max(8, round(1.0 / data.dt_s))


def _columns(readings: Readings) -> FloatArray:
    """(m, n) the loop by plays, also weighted by the voltage; slow lags; an offset and a gain that change slowly; a
    constant lateness."""
    data, felt_V = readings.data, readings.felt_V
    x, u = np.linspace(-1.0, 1.0, data.n), (felt_V - 0.5 * (data.u_low_V + data.u_high_V)) / (0.5 * data.swing_V)
    plays = list(play_run(felt_V, RADII * data.swing_V, np.full(RADII.size, felt_V[0])).T / data.swing_V)
    slow = slow_poles(u, data.dt_s / np.array([0.1, 1.0, 10.0]))
    rate = np.gradient(u)
    rows = [np.ones(data.n), u, u**2, u**3, *plays, *(u * p for p in plays[::2]), *slow]
    return np.array([*rows, x, x**2, x**3, x * u, x**2 * u, rate, np.gradient(rate), rate * u])


def _slips(by: _Description, now: _Described, y_um: FloatArray, block: int) -> tuple[SlipList, float]:
    """Slips of whole samples that explain the lateness, and the squared error that they leave; none where the changes
    that are found are no whole samples."""
    index = np.arange(y_um.size)
    dates: list[int] = []
    sizes, left = np.zeros(0), float("inf")

    def steps(dates: list[int]) -> FloatArray:
        return np.array([index >= at for at in dates], dtype=np.float64).reshape(-1, index.size)

    def fitted(sizes: FloatArray) -> tuple[_Described, FloatArray, FloatArray, float]:
        """The description beside the present dates, sizes and their errors, and the squared error that is left."""
        now = by.of(y_um, sizes @ steps(dates))
        for _ in range(2):
            more, errors, left = now.solved(steps(dates), block)
            sizes = sizes + more
            now = by.of(y_um, sizes @ steps(dates))
        return now, sizes, errors, left

    while len(dates) < MOST_SLIPS:
        at = now.best_step(steps(dates))
        if any(abs(at - other) < _NEAR for other in dates):
            # What is left lies at a date that is not exact.
            break
        dates.append(at)
        new = fitted(np.append(sizes, 0.0))
        if abs(new[1][-1]) < max(0.5, _SIGMAS * new[2][-1]):
            dates.pop()
            break
        now, sizes, _, left = new
        # The first dates stood for slips that were found since.
        for i in range(len(dates) if len(dates) > 1 else 0):
            others, before = [*dates[:i], *dates[i + 1 :]], dates[i]
            dates[i] = by.of(y_um, np.delete(sizes, i) @ steps(others)).best_step(steps(others))
            if dates[i] != before:
                now, sizes, _, left = fitted(sizes)
        keep = np.abs(sizes) > 0.5
        if not keep.all():
            dates = [at for at, kept in zip(dates, keep, strict=True) if kept]
            now, sizes, _, left = fitted(sizes[keep])
    whole = np.rint(sizes)
    if not dates or np.any(np.abs(sizes - whole) > _WHOLE) or not np.all(whole):
        return (), float("inf")
    return tuple((at, int(size)) for at, size in sorted(zip(dates, whole, strict=True))), left
