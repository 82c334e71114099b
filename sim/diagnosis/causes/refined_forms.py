"""Forms with more numbers, for a cause that is accepted: what a coarse form leaves must not pass for another cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.causes.static import HysteresisShape, RateDependence
from sim.diagnosis.model.forms import Form
from sim.diagnosis.model.measured import Setting

#: Error left, in noise floors, above which a finer form is worth its time.
_LEFT = {"hysteresis_shape": 1.5, "rate_dependence": 1.2}


def finer(form: Form, p: FloatArray, left_floors: float, setting: Setting) -> tuple[Form, list[FloatArray]] | None:
    """A finer form of the same cause and the starts of its fit, or None where it has none or needs none.

    ``p`` are the fitted numbers of ``form``; ``left_floors`` is the error left beside it, in noise floors.
    """
    if left_floors <= _LEFT.get(form.name, np.inf):
        return None
    if isinstance(form, HysteresisShape) and not form.variant:
        fine = replace(form, variant="fine")
        return fine, [np.zeros(len(fine.slots(setting)))]
    if isinstance(form, RateDependence) and not form.felt_free:
        # Over what time the rate is felt is no constant of nature.
        free = replace(form, variant="width", felt_free=True)
        width, slope, pace = p if form.variant == "width" else (0.02, 0.0, float(np.log(2.0 * setting.swing_V)))
        return free, [np.array([width, slope, pace, np.log(felt_s)]) for felt_s in (0.004, 0.02)]
    return None
