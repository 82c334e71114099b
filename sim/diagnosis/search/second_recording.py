"""A second recording of the same stage: what a fitted model errs on it, with nothing of the stage fitted there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.chain import Model
from sim.diagnosis.model.fit import Fit, calibrate
from sim.diagnosis.model.measured import Setting
from sim.diagnosis.model.nominal import BoucWen
from sim.diagnosis.model.nominal_fit import begins_at_rest, with_other_axis
from sim.diagnosis.search.evidence import HeldOut, Split

#: Numbers of the nominal stage that belong to one recording: the sensor's offset and what happened before it.
OF_ONE_RECORDING = ("offset_um", "h0", "start_um")


def elsewhere(fit: Fit, setting: Setting, mask: BoolArray) -> Fit:
    """The fitted model on another recording; only what belongs to one recording alone is calibrated there.

    That is the sensor's offset, the memory at the start, and the numbers of causes that do not carry over (drift over
    time, a hum's phase, a clock). ``mask`` (n,) is False where samples do not count.
    """
    home = fit.model
    _, static_um = home.nominal.static(
        fit.signals.drive_V, home.part(fit.p, -1), home.setting.fine(home.substeps, home.nominal.hold)
    )
    there = replace(
        setting,
        fitted_low_um=float(np.min(static_um)),
        fitted_loop_um=float(np.max(np.abs(fit.signals.h_um))),
        input_is_linear=home.setting.input_is_linear,
        nominal_kind=home.setting.nominal_kind,
        known_modes_hz=home.setting.known_modes_hz,
        has_mode=home.setting.has_mode,
    ).scaled_as(home.setting)
    nominal = home.nominal
    if isinstance(nominal, BoucWen):
        nominal = replace(nominal, free_memory=not begins_at_rest(setting))
    model = Model(there, nominal, home.forms)
    known = {slot.name: fit.p[i] for i, slot in enumerate(home.slots[: home.n_nominal])}
    start = np.array([known.get(slot.name, slot.neutral) for slot in model.slots[: model.n_nominal]])
    own = {i for i, slot in enumerate(model.slots[: model.n_nominal]) if slot.name in OF_ONE_RECORDING}
    for i, form in enumerate(model.forms):
        # How many numbers such a cause has may depend on the length of the recording.
        fresh = np.array([slot.neutral for slot in form.slots(there)])
        start = np.concatenate([start, fresh if form.of_one_recording else home.part(fit.p, i)])
        first = start.size - fresh.size
        for k, slot in enumerate(form.slots(there)):
            if form.of_one_recording or slot.name in OF_ONE_RECORDING:
                own.add(first + k)
                start[first + k] = slot.neutral
    bare = Fit(model, start, fit.signals, there.y_um, 0.0, [])
    known_axis = with_other_axis(bare, mask, refit=False)
    return calibrate(known_axis.model, start, mask, 20, 1e-6, frozenset(own))


def second_error(fit: Fit, setting: Setting, mask: BoolArray, parts: Split) -> HeldOut:
    """Squared error of the fitted model on another recording, by blocks and in sum."""
    there = elsewhere(fit, setting, mask)
    residual: FloatArray = np.where(mask, there.residual_um, 0.0)
    per_block = parts.blocks(np.square(residual))
    return HeldOut(per_block, float(per_block.sum()))
