"""Whether a cause has one size in all stretches of a recording that excite it.

What the stage has acts alike wherever the motion excites it. A cause that is fitted to what another model error leaves
takes from some stretches what it gains in others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.search.held_out import Split


@dataclass(frozen=True)
class StretchSizes:
    """``sizes`` (s,): the size of a cause in each stretch that excites it, in units of that in the whole recording.

    ``spread``: RMS distance of the sizes from 1, weighted with what the cause does in each stretch, less what white
    noise alone would give.
    """

    sizes: FloatArray
    spread: float


def sizes_by_stretch(without_um: FloatArray, residual_um: FloatArray, parts: Split, sigma_um: float) -> StretchSizes:
    """Fit the size of a cause to each stretch alone.

    ``without_um`` and ``residual_um`` (n,) are the residuals (µm) without the cause, everything else fitted again, and
    with it; zero where a sample does not count. Their difference is what the cause changes. A stretch excites it where
    the difference has a tenth of the mean energy of a stretch, and five noise floors ``sigma_um`` (µm) as its norm.
    """
    changed_um = without_um - residual_um
    energy = parts.stretch_sums(parts.blocks(np.square(changed_um)))
    excited = (energy > 0.1 * energy.mean()) & (energy > (5.0 * sigma_um) ** 2)
    energy = energy[excited]
    if energy.size == 0:
        return StretchSizes(np.empty(0), 0.0)
    off = parts.stretch_sums(parts.blocks(changed_um * residual_um))[excited] / energy
    beyond_noise = float(energy @ np.square(off)) - energy.size * sigma_um**2
    return StretchSizes(1.0 + off, float(np.sqrt(max(beyond_noise, 0.0) / energy.sum())))
