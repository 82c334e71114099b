"""How much a sample counts: doubtful and old ones less, by their noise weight (weighted LSSVM).

A weight w stands for 1/w times the noise variance, in the window and in the filter alike; 1 is an ordinary sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError


@dataclass(frozen=True, slots=True)
class WeightConfig:
    """All weights 1, but for samples from before a change.

    near_bad : weight of a pair whose smoothing has looked at a reading that was refused.
    on_probation : weight for as long as a jump may still be undone.
    acceleration : noise that acceleration adds, as a share of the ordinary, at full scale of the feature map: the
    weight is 1/(1 + (acceleration a/scale)²). What the smoother leaves is worst where the motion turns fast.
    half_life_s : time after which a sample of the window counts half, s; 0 for never.
    before_change : most that a sample counts from before a change of the stage that was found; 1 to keep them all.
    """

    near_bad: float = 1.0
    on_probation: float = 1.0
    acceleration: float = 0.0
    half_life_s: float = 0.0
    before_change: float = 0.05

    def __post_init__(self) -> None:
        for name in ("near_bad", "on_probation", "before_change"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InputError(f"weights.{name}: got {getattr(self, name)}, expected a weight above 0, up to 1")
        for name in ("acceleration", "half_life_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"weights.{name}: got {value}, expected a finite number, not negative")

    def of(self, near_bad: bool, on_probation: bool, a_share: float) -> float:
        """Weight of a pair that may teach; ``a_share`` is its acceleration, full scale being 1."""
        weight = (self.near_bad if near_bad else 1.0) * (self.on_probation if on_probation else 1.0)
        if self.acceleration > 0.0:
            weight /= 1.0 + (self.acceleration * a_share) ** 2
        return weight

    def faded(self, weight: float, age_s: float) -> float:
        """Weight of a sample that has been in the window for so long; never below a thousandth of its own."""
        return weight * max(float(0.5 ** (age_s / self.half_life_s)), 1e-3) if self.half_life_s > 0.0 else weight
