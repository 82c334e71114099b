"""Periodic recordings: the mean period, its spectrum, the noise between periods, and the response matrix.

Scaling: ``X[k] = rfft(x)[k] / n``, so that a line of complex amplitude ``X`` is ``2 Re(X e^{jωt})`` and the squared rms
of a signal is the sum of ``2 |X|²`` over its lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray, IntArray

ComplexArray = NDArray[np.complex128]

#: A line belongs to the drive where its magnitude is above this share of the strongest line.
EXCITED_SHARE = 0.03
#: Largest spread of the drive between its periods, as a share of its rms: beyond it the drive is not periodic.
MOST_DRIVE_SPREAD = 0.02


@dataclass(frozen=True, slots=True)
class PeriodicRecord:
    """Whole periods of one or several realisations of a periodic drive, in steady state.

    Attributes
    ----------
    name : of the recording.
    u_V : (n, m, R, P), n samples a period, m drives, R realisations, P periods.
    y_um : (n, p, R, P), p outputs.
    dt_s : sample time, s.

    Raises InputError on shapes that do not match, on values that are not finite, and on a drive that does not repeat.
    """

    name: str
    u_V: FloatArray
    y_um: FloatArray
    dt_s: float

    def __post_init__(self) -> None:
        for label, values in (("u_V", self.u_V), ("y_um", self.y_um)):
            if values.ndim != 4 or values.size == 0:
                raise InputError(
                    f"{self.name}: {label}: got shape {values.shape}, expected (samples, channels, realisations, "
                    "periods): give the length of a period"
                )
            if not np.isfinite(values).all():
                raise InputError(f"{self.name}: {label}: got values that are not finite: cut them out or repair them")
        if (self.u_V.shape[0], *self.u_V.shape[2:]) != (self.y_um.shape[0], *self.y_um.shape[2:]):
            raise InputError(
                f"{self.name}: y_um: got shape {self.y_um.shape}, expected the samples, realisations and periods of "
                f"u_V, {self.u_V.shape}"
            )
        if self.u_V.shape[0] < 16:
            raise InputError(f"{self.name}: period: got {self.u_V.shape[0]} samples, expected 16 or more")
        if not self.dt_s > 0.0:
            raise InputError(f"{self.name}: dt_s: got {self.dt_s!r}, expected a positive sample time in s")
        spread = float(np.sqrt(np.mean((self.u_V - self.u_V.mean(axis=3, keepdims=True)) ** 2)))
        level = float(np.sqrt(np.mean((self.u_V - self.u_V.mean(axis=0)) ** 2)))
        if level == 0.0:
            raise InputError(f"{self.name}: u_V: got a constant drive, expected a periodic one: nothing is excited")
        if spread > MOST_DRIVE_SPREAD * level:
            raise InputError(
                f"{self.name}: u_V: got periods that differ by {100.0 * spread / level:.3g} % of the drive's rms, "
                f"expected at most {100.0 * MOST_DRIVE_SPREAD:g} %: check the length of the period"
            )

    @property
    def amplitude_V(self) -> float:
        """Rms of the drive about its mean, V: over the samples of all drives, realisations and periods."""
        return float(np.sqrt(np.mean((self.u_V - self.u_V.mean(axis=0)) ** 2)))


def cut_into_periods(x: FloatArray, samples: int, skip: int = 0) -> FloatArray:
    """Columns ``x`` (N, channels) as (samples, channels, 1, periods), without the first ``skip`` periods.

    An incomplete period at the end is left out. Raises InputError where no whole period is left.
    """
    periods = len(x) // samples if samples > 0 else 0
    if samples <= 0 or periods - skip < 1:
        raise InputError(
            f"period: got {samples} samples with {skip} periods skipped, expected one whole period or more within the "
            f"recording's {len(x)} samples: correct the length of the period"
        )
    whole = x[skip * samples : periods * samples].reshape(periods - skip, samples, x.shape[1])
    return np.ascontiguousarray(whole.transpose(1, 2, 0))[:, :, None, :]


@dataclass(frozen=True, slots=True)
class LineSpectra:
    """Spectra of the mean period at the excited lines.

    Attributes
    ----------
    name, amplitude_V : of the record.
    samples, dt_s : length of a period in samples, sample time.
    lines : (F,), indices of the excited lines, ascending; line k is at ``k / (samples dt_s)`` Hz.
    u, y : (F, m, R) and (F, p, R), complex amplitudes of the mean period, V and µm.
    noise : (F, p), variance of the noise of ``y``, µm², mean of the realisations; nan for a single period.
    unexcited : (p, R), mean square of the mean period at all other lines but line 0, µm².
    noise_um : (p,), rms of the noise of a single reading, µm; nan for a single period.
    periods : P.
    """

    name: str
    amplitude_V: float
    samples: int
    dt_s: float
    lines: IntArray
    u: ComplexArray
    y: ComplexArray
    noise: FloatArray
    unexcited: FloatArray
    noise_um: FloatArray
    periods: int

    @property
    def freq_hz(self) -> FloatArray:
        """(F,) frequencies of the lines, Hz."""
        return np.asarray(self.lines / (self.samples * self.dt_s), dtype=np.float64)

    @property
    def z(self) -> ComplexArray:
        """(F,) points ``exp(j ω dt)`` of the lines on the unit circle."""
        return np.asarray(np.exp(2j * np.pi * self.lines / self.samples), dtype=np.complex128)

    @property
    def signal_um(self) -> FloatArray:
        """(p,) rms of the output's mean period about its mean value, µm."""
        squares = 2.0 * np.sum(np.abs(self.y) ** 2, axis=0) + self.unexcited
        return np.asarray(np.sqrt(squares.mean(axis=1)), dtype=np.float64)

    @property
    def floor_um(self) -> FloatArray:
        """(p,) rms of the noise of the mean period, µm: the least error of any model."""
        return np.asarray(self.noise_um / np.sqrt(self.periods), dtype=np.float64)


def joined(parts: Sequence[LineSpectra]) -> LineSpectra:
    """The realisations of several records of the same amplitude and period as one. Raises InputError."""
    first = parts[0]
    if len(parts) == 1:
        return first
    for part in parts[1:]:
        for name, got, expected in (
            ("period, samples", part.samples, first.samples),
            ("sample time, s", part.dt_s, first.dt_s),
            ("periods", part.periods, first.periods),
            ("drives and outputs", _channels(part), _channels(first)),
        ):
            if got != expected:
                raise InputError(
                    f"{part.name}: {name}: got {got}, expected {expected} as in {first.name}, a record of the same "
                    "amplitude: cut both alike"
                )
    lines = first.lines
    for part in parts[1:]:
        lines = np.intersect1d(lines, part.lines)
    if lines.size == 0:
        raise InputError(f"{first.name}: excited lines: got none in common with the records of the same amplitude")
    counts = np.array([part.u.shape[2] for part in parts], dtype=np.float64)
    chosen = [np.searchsorted(part.lines, lines) for part in parts]
    share = counts / counts.sum()
    unexcited = [
        part.unexcited + 2.0 * (np.sum(np.abs(part.y) ** 2, axis=0) - np.sum(np.abs(part.y[at]) ** 2, axis=0))
        for part, at in zip(parts, chosen, strict=True)
    ]
    return LineSpectra(
        name=", ".join(part.name for part in parts),
        amplitude_V=float(np.sqrt(np.sum(share * np.array([part.amplitude_V for part in parts]) ** 2))),
        samples=first.samples,
        dt_s=first.dt_s,
        lines=lines,
        u=np.concatenate([part.u[at] for part, at in zip(parts, chosen, strict=True)], axis=2),
        y=np.concatenate([part.y[at] for part, at in zip(parts, chosen, strict=True)], axis=2),
        noise=np.sum([s * part.noise[at] for s, part, at in zip(share, parts, chosen, strict=True)], axis=0),
        unexcited=np.concatenate(unexcited, axis=1),
        noise_um=np.sqrt(np.sum([s * part.noise_um**2 for s, part in zip(share, parts, strict=True)], axis=0)),
        periods=first.periods,
    )


def _channels(spectra: LineSpectra) -> tuple[int, int]:
    return spectra.u.shape[1], spectra.y.shape[1]


def realisations(spectra: LineSpectra, chosen: slice) -> LineSpectra:
    """Some of the realisations."""
    return replace(
        spectra, u=spectra.u[:, :, chosen], y=spectra.y[:, :, chosen], unexcited=spectra.unexcited[:, chosen]
    )


def excited_lines(u_V: FloatArray, share: float = EXCITED_SHARE) -> IntArray:
    """Indices of the lines at which a drive (n, m, R), a mean period, has power; without the mean, line 0."""
    power = np.abs(np.fft.rfft(u_V, axis=0)).max(axis=(1, 2))
    power[0] = 0.0
    if u_V.shape[0] % 2 == 0:
        power[-1] = 0.0
    return np.flatnonzero(power > share * power.max())


def average(record: PeriodicRecord) -> LineSpectra:
    """The mean period's spectra at the excited lines, and the noise from the spread between the periods.

    With P periods the noise of a line is the sample variance over periods divided by P. A drift of the mean value
    is not noise of the lines and is left out. Source: Pintelon and Schoukens, System Identification: A Frequency Domain
    Approach (2012), section 2.5.
    """
    n, outputs, _, periods = record.y_um.shape
    lines = excited_lines(record.u_V.mean(axis=3))
    u = np.fft.rfft(record.u_V.mean(axis=3), axis=0) / n
    y = np.fft.rfft(record.y_um, axis=0) / n
    if periods > 1:
        spread = np.var(y, axis=3, ddof=1).mean(axis=2)
        noise = spread[lines] / periods
        noise_um = np.sqrt(2.0 * spread[1:].sum(axis=0) - (spread[-1] if n % 2 == 0 else 0.0))
    else:
        noise, noise_um = np.full((lines.size, outputs), np.nan), np.full(outputs, np.nan)
    mean = y.mean(axis=3)
    squares = 2.0 * np.abs(mean) ** 2
    squares[0] = 0.0
    if n % 2 == 0:
        squares[-1] /= 2.0
    return LineSpectra(
        name=record.name,
        amplitude_V=record.amplitude_V,
        samples=n,
        dt_s=record.dt_s,
        lines=lines,
        u=u[lines],
        y=mean[lines],
        noise=noise,
        unexcited=squares.sum(axis=0) - squares[lines].sum(axis=0),
        noise_um=noise_um,
        periods=periods,
    )


# --- The frequency response matrix by least squares over realisations, and the level of what it cannot explain.
#
# The realisations of one amplitude need drives of different phases, at least as many as there are drives: orthogonal or
# random phases. What the realisations have in common is the best linear approximation at this amplitude; what differs
# is noise plus stochastic nonlinear distortion. Source: Pintelon and Schoukens (2012), chapters 2 and 4.

#: Lines on either side over which a variance is averaged.
SMOOTHING_LINES = 12
#: Largest condition number of the drives' spectra at a line.
MOST_CONDITION = 1e4


@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """The response matrix at the lines of one amplitude.

    Attributes
    ----------
    spectra : the mean periods of all realisations of this amplitude.
    g : (F, p, m), µm/V.
    total : (F, p), variance of what a realisation's ``y`` has beside ``g u``, µm²: noise and distortion, averaged over
        neighbouring lines; that of the noise alone where there are as many realisations as drives; nan where that is
        unknown too.
    power : (F,), mean over drives of the squared magnitude of the drive summed over realisations, V².
    """

    spectra: LineSpectra
    g: ComplexArray
    total: FloatArray
    power: FloatArray

    @property
    def knows_distortion(self) -> bool:
        """There are more realisations than drives, so that their spread shows the distortion."""
        return bool(self.spectra.u.shape[2] > self.spectra.u.shape[1])

    @property
    def distortion_um(self) -> FloatArray:
        """(p,) rms of noise and distortion in one realisation, µm: the least error of a linear model."""
        return np.asarray(np.sqrt(2.0 * self.total.sum(axis=0)), dtype=np.float64)


def smoothed(values: FloatArray, half: int = SMOOTHING_LINES) -> FloatArray:
    """(F, p) mean over ``half`` neighbours on either side, fewer at the ends."""
    sums = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return np.asarray((sums[high] - sums[low]) / (high - low)[:, None], dtype=np.float64)


def frequency_response(spectra: LineSpectra) -> FrequencyResponse:
    """Least squares over the realisations, line by line.

    Raises InputError where there are fewer realisations than drives, or where the drives' phases do not differ.
    """
    drives, count = spectra.u.shape[1:]
    if count < drives:
        raise InputError(
            f"{spectra.name}: realisations: got {count} for {drives} drives, expected {drives} or more of different "
            "phases at one amplitude: record more realisations (orthogonal random-phase multisines need the fewest)"
        )
    condition = np.linalg.cond(spectra.u)
    if not np.median(condition) < MOST_CONDITION:
        raise InputError(
            f"{spectra.name}: drives: got phases that are alike in all realisations (median condition "
            f"{np.median(condition):.3g}), expected different ones: record realisations with other phases"
        )
    inverse = np.linalg.pinv(spectra.u, rcond=1.0 / MOST_CONDITION)
    g = spectra.y @ inverse
    if count > drives:
        left = spectra.y - g @ spectra.u
        total = smoothed(np.sum(np.abs(left) ** 2, axis=2) / (count - drives))
    else:
        total = smoothed(spectra.noise)
    # The variance of an entry of g is that of y times this sum's inverse, mean over the drives.
    spread = np.mean(np.sum(np.abs(inverse) ** 2, axis=1), axis=1)
    return FrequencyResponse(spectra, g, total, 1.0 / spread)
