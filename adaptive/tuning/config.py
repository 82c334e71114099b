"""Settings of re-tuning. Imports neither scipy nor numba, because every configuration file is read with it."""

from __future__ import annotations

from dataclasses import dataclass

from dehyst.adaptive.errors import InputError


@dataclass(frozen=True, slots=True)
class RetuneConfig:
    """Settings of `adaptive.tuning.retuning`: how far to search, and when a proposal is better.

    Attributes
    ----------
    starts : descents on a part of the samples; the first begins at the present values.
    rows : size of that part.
    iterations : most of each descent.
    least : fewest samples to tune on.
    gamma_reach, width_reach : largest factors from the present values.
    gamma_range, width_range : absolute limits.
    gain : share by which the rms error on fresh samples must fall.
    sigmas : of its own deviations by which the mean difference of the errors' sizes must lie above zero.
    looks : comparisons, each with twice the samples; three with 2.29 are as strict as one with 2 (Pocock 1977).
    """

    starts: int = 8
    rows: int = 200
    iterations: int = 30
    least: int = 60
    gamma_reach: float = 1e6
    width_reach: float = 30.0
    gamma_range: tuple[float, float] = (1e-2, 1e7)
    width_range: tuple[float, float] = (0.02, 50.0)
    gain: float = 0.02
    sigmas: float = 2.29
    looks: int = 3

    def __post_init__(self) -> None:
        if min(self.starts, self.iterations) < 1 or min(self.rows, self.least) < 20:
            raise InputError(
                f"starts, iterations, rows, least: got {self.starts}, {self.iterations}, {self.rows}, {self.least}, "
                "expected at least 1, 1, 20, 20"
            )
        if not (self.gamma_reach > 1.0 and self.width_reach > 1.0 and 0.0 <= self.gain < 1.0 and self.sigmas >= 0.0):
            raise InputError(
                f"gamma_reach, width_reach, gain, sigmas: got {self.gamma_reach}, {self.width_reach}, {self.gain}, "
                f"{self.sigmas}, expected more than 1, more than 1, 0 to 1, at least 0"
            )
        if not 1 <= self.looks <= 8:
            raise InputError(f"looks: got {self.looks}, expected 1 to 8")
        for name, (low, high) in (("gamma_range", self.gamma_range), ("width_range", self.width_range)):
            if not 0.0 < low < high:
                raise InputError(f"{name}: got {(low, high)}, expected 0 < low < high")
