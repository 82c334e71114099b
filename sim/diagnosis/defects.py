"""Defects of the recording itself: repeated readings and lost samples. They are listed and never named as causes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scipy import stats

from sim.diagnosis.model.readings import RepeatedReadings


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
        p = float(stats.poisson.sf(doubles.count - 1, max(chance, 1e-12)))
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
