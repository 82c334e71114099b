"""The frequency response matrix by least squares over realisations, and the level of what it cannot explain.

The realisations of one amplitude need drives of different phases, at least as many as there are drives: orthogonal or
random phases. What the realisations have in common is the best linear approximation at this amplitude; what differs is
noise plus stochastic nonlinear distortion. Source: Pintelon and Schoukens (2012), chapters 2 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.modal.periods import ComplexArray, LineSpectra

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
        """(p,) rms of noise and distortion in one realisation, µm: no linear model of this amplitude is below it."""
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
