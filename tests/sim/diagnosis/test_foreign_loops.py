"""A loop of another class than the nominal stage must not hide a cause, take its name, or drive the lag away."""

from __future__ import annotations

import numpy as np

from sim.diagnosis import prepare
from sim.diagnosis.nominal import calibrate_nominal
from sim.diagnosis.search.search import first_fits
from sim.effects.hysteresis_shape import HysteresisShape
from sim.fitting.calibration import with_new_columns
from tests.hidden.foreign.cases import single
from tests.hidden.foreign.score import recording_of

#: Elasto-slide elements that begin relaxed and a bent sensor, at 500 Hz: a sample is longer than the stage's lag.
CURVED = single(18)


def test_the_memory_at_the_start_is_chosen_by_fits_that_have_converged() -> None:
    prepared = prepare(recording_of(CURVED), nominal="bouc_wen")
    base = with_new_columns(calibrate_nominal("bouc_wen", prepared.data, prepared.mask), prepared.mask)
    shape = HysteresisShape()
    start = np.zeros(len(shape.parameters(prepared.data)))
    chosen, _ = first_fits(shape, start, base, prepared.mask)
    assert isinstance(chosen, HysteresisShape)
    assert chosen.before_V == 0.0
