"""One mean period of a force and the displacement that it makes: noise, best linear approximation, finer steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from baselines.validation import positive, series


def between_samples(u: FloatArray, factor: int) -> FloatArray:
    """A periodic signal (n,) at ``factor`` times its rate, (n factor,), by its Fourier series: exact in its band."""
    n = u.size
    spectrum = np.fft.rfft(u)
    if n % 2 == 0:
        spectrum[-1] *= 0.5  # the Nyquist line is shared between both of its frequencies
    padded = np.zeros(n * factor // 2 + 1, dtype=np.complex128)
    padded[: spectrum.size] = spectrum
    return np.asarray(np.fft.irfft(padded, n * factor) * factor, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class PeriodicRecord:
    """One period of force (n,) N and the mean displacement (n,) m of ``periods`` periods, ``dt_s`` apart.

    noise_m : standard deviation of that mean, from how the periods differ.
    """

    u_N: FloatArray
    y_m: FloatArray
    dt_s: float
    periods: int
    noise_m: float

    @staticmethod
    def of(u_N: FloatArray, y_m: FloatArray, dt_s: float, length: int, skip: int = 0) -> PeriodicRecord:
        """From whole periods of ``length`` samples, the first ``skip`` of them left out.

        Raises InputError where the force is not periodic or there are no whole periods.
        """
        u, y = series("u_N", u_N, 8), series("y_m", y_m, 8)
        count = u.size // length if length > 0 else 0
        if u.size != y.size or count * length != u.size or count <= skip:
            raise InputError(f"u_N, y_m: got {u.size} and {y.size} samples, expected whole periods of {length}")
        us, ys = u.reshape(count, length)[skip:], y.reshape(count, length)[skip:]
        if float(np.max(np.abs(us - us[0]))) > 1e-9 * float(np.max(np.abs(u))):
            raise InputError("u_N: differs from period to period, expected one period repeated")
        kept = count - skip
        noise = float(np.sqrt(np.mean(np.var(ys, axis=0, ddof=1)) / kept)) if kept > 1 else math.nan
        return PeriodicRecord(us[0].copy(), ys.mean(axis=0), positive("dt_s", dt_s, "s"), kept, noise)


def linear_part(records: Sequence[PeriodicRecord]) -> tuple[float, float, float]:
    """m, c, k of the best linear approximation: force spectrum on those of y'', y', y, by least squares."""
    rows, targets = [], []
    for record in records:
        force, motion = np.fft.rfft(record.u_N), np.fft.rfft(record.y_m)
        used = np.abs(force) > 1e-3 * np.abs(force).max()
        s = 2j * np.pi * np.fft.rfftfreq(record.u_N.size, record.dt_s)[used]
        x, f = motion[used], force[used]
        rows += [np.column_stack([s * s * x, s * x, x]).view(np.float64).reshape(x.size, 3, 2)]
        targets += [f.view(np.float64).reshape(f.size, 2)]
    table = np.concatenate([np.swapaxes(row, 1, 2).reshape(-1, 3) for row in rows])
    size = np.linalg.norm(table, axis=0)
    m, c, k = np.linalg.lstsq(table / size, np.concatenate(targets).ravel(), rcond=None)[0] / size
    return float(m), float(c), float(k)
