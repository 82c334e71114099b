"""What the direct tests share: rests, cycles, a quasi-static description, and the frequency response.

Nothing here knows the nominal stage or a fitted cause. The quasi-static description is a linear regression of the
readings on plays of the voltage; it takes the loop out of the readings before a small effect is looked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray, IntArray
from dehyst.baselines.prandtl_ishlinskii.operators import play_run
from dehyst.sim.fitting.fit_data import EARLY_S, DerivedArrays, FitData
from dehyst.sim.fitting.lags import lag_ends
from dehyst.sim.masks import runs, samples_since, samples_until

T = TypeVar("T")

#: A drive counts as standing after this time without a change of voltage, s: lags and modes have settled.
SETTLE_S = 0.15
#: Radii of the plays, relative to the swing.
RADII = np.array([0.02, 0.05, 0.09, 0.14, 0.2, 0.27, 0.35, 0.45, 0.6, 0.8])
#: Lags (s) and whole-sample latencies among which the quasi-static description chooses.
_LAGS_S = (0.0, 1e-3, 2.5e-3, 5e-3, 10e-3)
_LATE = (0, 1, 3, 6)
#: Largest lateness that is looked for, samples.
_MOST_LATE = 40
#: A motion over fewer samples is a step.
_STEP_SAMPLES = 30.0


@dataclass(frozen=True)
class Rest:
    """Samples ``first`` to ``last`` (excluded) in which the drive stands at ``level_V``."""

    first: int
    last: int
    level_V: float


@dataclass(frozen=True)
class Cycle:
    """One closed cycle of the drive: bottom, top, bottom (samples), both bottoms at one voltage."""

    start: int
    top: int
    stop: int

    def amplitude_V(self, u_V: FloatArray) -> float:
        return float(u_V[self.top] - u_V[self.start])

    def period_s(self, dt_s: float) -> float:
        return (self.stop - self.start) * dt_s


@dataclass(frozen=True)
class Response:
    """Frequency response from voltage to reading: frequencies (Hz), complex gain (µm/V) and coherence, (m,) each."""

    f_hz: FloatArray
    gain: np.ndarray[tuple[int], np.dtype[np.complex128]]
    coherence: FloatArray
    segments: int

    @property
    def sigma(self) -> FloatArray:
        """(m,) relative standard error of the gain, from the coherence."""
        c = np.clip(self.coherence, 1e-6, 1.0 - 1e-9)
        return np.asarray(np.sqrt((1.0 - c) / (2.0 * c * max(1, self.segments))))


class Readings:
    """A recording as the direct tests see it. Each part is computed at its first use."""

    def __init__(self, data: FitData, mask: BoolArray, sigma_um: float) -> None:
        self.data, self.mask, self.sigma_um = data, mask, sigma_um
        self._results = DerivedArrays()

    def with_readings(self, y_um: FloatArray) -> Readings:
        """The same drive with other readings (n,)."""
        return Readings(replace(self.data, y_um=y_um), self.mask, self.sigma_um)

    def once(self, look: Callable[[Readings], T]) -> T:
        """``look(self)``, computed at its first use: several direct tests share it."""
        return self._results.get(look, lambda: look(self))

    @cached_property
    def still(self) -> BoolArray:
        """(n,) True where the drive has not changed for `SETTLE_S` and does not for another `EARLY_S`."""
        data = self.data
        moved = data.rate_V_per_s > 1e-6 * data.swing_V / data.dt_s
        quiet = (samples_since(moved) >= SETTLE_S / data.dt_s) & (samples_until(moved) > EARLY_S / data.dt_s)
        return np.asarray(quiet) & self.mask

    @cached_property
    def alone(self) -> BoolArray:
        """(n,) True where neither a second nor a third drive has changed for `SETTLE_S`."""
        out = np.ones(self.data.n, dtype=np.bool_)
        for other in (self.data.u2_V, self.data.u3_V):
            if other is not None:
                moved = np.abs(np.diff(other, prepend=other[0])) > 1e-6 * float(np.ptp(other))
                out &= samples_since(moved, before=10**9) >= SETTLE_S / self.data.dt_s
        return out

    @cached_property
    def rests(self) -> tuple[Rest, ...]:
        """Rests of all drives of at least 0.3 s after settling."""
        least = max(8, round(0.3 / self.data.dt_s))
        return tuple(
            Rest(int(a), int(b), float(self.data.u_V[a])) for a, b in runs(self.still & self.alone) if b - a >= least
        )

    @cached_property
    def parked(self) -> tuple[tuple[int, int], ...]:
        """First and last (excluded) sample of each stretch in which this axis' own voltage stands still."""
        return tuple((int(a), int(b)) for a, b in runs(self.still & (self.data.rate_V_per_s == 0.0)))

    @cached_property
    def cycles(self) -> tuple[Cycle, ...]:
        """Closed cycles of at least 10 % of the swing whose two bottoms differ by less than 3 % of their height."""
        u = self.data.u_V
        least = 0.1 * self.data.swing_V
        turns, out = self.data.turns, []
        for a, b, c in zip(turns[:-2], turns[1:-1], turns[2:], strict=True):
            # A standing voltage before the first rise does not belong to the cycle.
            a += int(np.flatnonzero(u[a : b + 1] <= u[a] + 1e-6 * least)[-1])
            height = u[b] - u[a]
            if height > least and abs(u[c] - u[a]) < 0.03 * height:
                out.append(Cycle(a, b, c))
        return tuple(out)

    @cached_property
    def felt_V(self) -> FloatArray:
        """(n,) the voltage through the lag and latency that make the quasi-static description fit best."""
        return self._quasi_static[1]

    @cached_property
    def left_um(self) -> FloatArray:
        """(n,) readings less their quasi-static description."""
        return np.asarray(self.data.y_um - self._quasi_static[0])

    @property
    def memory_um(self) -> FloatArray:
        """(n,) the quasi-static description of the readings."""
        return self._quasi_static[0]

    @property
    def lag_s(self) -> float:
        """Lag and latency (s) of the quasi-static description."""
        return self._quasi_static[2]

    @cached_property
    def _quasi_static(self) -> tuple[FloatArray, FloatArray, float]:
        data, use = self.data, self.mask
        thin = max(1, data.n // 20_000)
        best: tuple[float, FloatArray, FloatArray, float] | None = None
        for lag_s in _LAGS_S:
            lagged = data.u_V if lag_s == 0.0 else np.asarray(lag_ends(data.u_V, lag_s / data.dt_s, False))
            for late in _LATE:
                u = np.concatenate([np.full(late, lagged[0]), lagged[: data.n - late]]) if late else lagged
                plays = play_run(u, RADII * data.swing_V, np.full(RADII.size, u[0]))
                columns = np.stack([np.ones(data.n), u, *plays.T])
                part = columns[:, use][:, ::thin]
                target = data.y_um[use][::thin]
                weights = _ridge(part, target)
                error = float(np.sum(np.square(target - weights @ part)))
                if best is None or error < best[0]:
                    best = (error, np.asarray(weights @ columns), np.ascontiguousarray(u), lag_s + late * data.dt_s)
        assert best is not None
        return best[1:]

    @cached_property
    def response(self) -> Response | None:
        """The frequency response above 5 Hz, from differenced signals; None where nothing is coherent.

        Differencing takes hysteresis and drift out: at high frequency the motion is small and the loop hardly opens.
        """
        data = self.data
        length = 1 << int(np.log2(max(64.0, min(0.5 / data.dt_s, data.n / 8))))
        u, y = np.diff(data.u_V), np.diff(data.y_um)
        u = np.where(self.mask[1:], u, 0.0)
        fs = 1.0 / data.dt_s
        kept: list[tuple[FloatArray, FloatArray]] = []
        size = 0.02 * data.swing_V * length * data.dt_s
        for first in range(0, u.size - length + 1, length // 2):
            piece = u[first : first + length]
            if float(np.sum(np.abs(piece))) > size and np.all(self.mask[first : first + length]):
                kept.append((piece, y[first : first + length]))
        if len(kept) < 3:
            return None
        window = np.hanning(length)
        f = np.fft.rfftfreq(length, 1.0 / fs)
        pieces_u = np.array([np.fft.rfft(window * a) for a, _ in kept])
        pieces_y = np.array([np.fft.rfft(window * b) for _, b in kept])
        power_u = np.sum(np.abs(pieces_u) ** 2, axis=0)
        power_y = np.sum(np.abs(pieces_y) ** 2, axis=0)
        cross = np.sum(pieces_y * np.conj(pieces_u), axis=0)
        coherence = np.abs(cross) ** 2 / np.maximum(power_u * power_y, 1e-300)
        good = (f >= 5.0) & (f <= 0.45 * fs) & (coherence > 0.6) & (power_u > 1e-9 * float(np.max(power_u)))
        if int(good.sum()) < 8:
            return None
        gain = cross[good] / power_u[good]
        return Response(f[good], gain, coherence[good], len(kept))

    def bins(self, width_s: float) -> tuple[FloatArray, FloatArray, IntArray]:
        """Means over bins of about ``width_s`` inside the rests: time (s), reading (µm) and index of the rest."""
        t: list[float] = []
        y: list[float] = []
        of: list[int] = []
        width = max(1, round(width_s / self.data.dt_s))
        for i, rest in enumerate(self.rests):
            for first in range(rest.first, rest.last - width + 1, width):
                t.append((first + 0.5 * (width - 1)) * self.data.dt_s)
                y.append(float(np.mean(self.data.y_um[first : first + width])))
                of.append(i)
        return np.array(t), np.array(y), np.array(of, dtype=np.int64)

    @cached_property
    def lateness(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Time (s), lateness of the readings and its standard error (samples) in half-second windows of fast motion.

        Where the motion is smooth, readings that are late differ by the lateness times the speed. After a step
        this does not hold: the whole samples that leave the smallest error are taken off first.
        """
        data = self.data
        window = max(50, round(0.5 / data.dt_s))
        # Windows overlap by half, and fade: a step at the edge of one would show in the readings or in the description
        # alone.
        step = window // 2
        first = np.arange(0, data.n - window + 1, step)

        def windows(x: FloatArray, rows: BoolArray) -> FloatArray:
            return np.asarray(np.lib.stride_tricks.sliding_window_view(x, window)[first[rows]])

        every = np.ones(first.size, dtype=np.bool_)
        weights = windows(self.mask.astype(np.float64), every) * np.hanning(window)
        sums = np.maximum(weights.sum(axis=1), 1e-9)[:, None]

        def centred(x: FloatArray, rows: BoolArray) -> FloatArray:
            part = windows(x, rows)
            return np.asarray((part - (part * weights[rows]).sum(axis=1, keepdims=True) / sums[rows]) * weights[rows])

        speed = np.gradient(self.memory_um)
        index = np.arange(data.n)

        def late_by(whole: int, rows: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Lateness, squared error that is left, and power of the speed in each window of ``rows``."""
            at = np.clip(index - whole, 0, data.n - 1)
            v, r = centred(speed[at], rows), centred(data.y_um - self.memory_um[at], rows)
            power = np.maximum(np.sum(v * v, axis=1), 1e-300)
            part = -np.sum(v * r, axis=1) / power
            return whole + part, np.sum(np.square(r + part[:, None] * v), axis=1), power

        # At a high rate the motion of one sample is small, but a window has more of them.
        least_um = 20.0 * self.sigma_um * min(1.0, float(np.sqrt(1000.0 / window)))
        fast = np.max(np.abs(centred(speed, every)), axis=1, initial=0.0) >= least_um
        if not fast.any():
            return np.empty(0), np.empty(0), np.empty(0)
        found = np.array(late_by(0, fast))
        # Over how many samples the motion of a window goes on.
        lasts = found[2] ** 2 / np.maximum(np.sum(centred(speed, fast) ** 4, axis=1), 1e-300)
        short = lasts < _STEP_SAMPLES
        steps = fast.copy()
        steps[fast] = short
        for whole in range(-_MOST_LATE, _MOST_LATE + 1) if short.any() else ():
            other = np.array(late_by(whole, steps))
            better = (other[1] < found[1, short]) & (np.abs(other[0] - whole) < 1.0)
            found[:, short] = np.where(better, other, found[:, short])
        shift, left, power = found
        # About twenty neighbouring samples of the remaining error go together.
        error = np.sqrt(left / power / max(1, window // 20))
        t_s = np.asarray((first[fast] + 0.5 * (window - 1)) * data.dt_s)
        return t_s, np.asarray(shift), np.asarray(np.maximum(error, 1e-3))


def _ridge(columns: FloatArray, target: FloatArray) -> FloatArray:
    gram = columns @ columns.T
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    system = gram / scale[:, None] / scale[None, :] + 1e-9 * np.eye(scale.size)
    return np.asarray(np.linalg.solve(system, columns @ target / scale) / scale)
