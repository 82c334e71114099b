"""Identifies a plant, as ``dehyst identify`` does from a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from adaptive.identification import IdentifyConfig, identify_lssvm
from adaptive.types import FloatArray, InverseModel
from baselines.fit import fit_bouc_wen, fit_linear, fit_mpi
from lab.rehearsal.config import RehearsalConfig
from lab.rehearsal.plant import Plant, PlantFactory, check_numbers, run_checked
from service.answers.guard import Limits
from service.config.settings import LEARN
from service.protocol.errors import FieldError
from sim.signals.voltages import CHAPTER_AMPLITUDE_V, training_input

#: Time of the ramp from the voltage at rest to the lowest voltage, and of the rest there, s.
APPROACH_S, REST_S = 0.5, 0.5
#: The largest voltage of the chapter's excitation as a share of twice its amplitude.
_PEAK: Final = 0.981
#: Default slew limit, spans of the drive per second.
SLEW_SPANS_PER_S: Final = 500.0


@dataclass(frozen=True, slots=True)
class IdentifiedPlant:
    """What is known of a plant before the loop is closed.

    Attributes
    ----------
    models : by name; ``lssvm_adaptive`` is the one that learns. u_V, y_um : (n,) the recording, V and µm.
    limits : of the axis. low_um, high_um : the identified displacement range. rest_um : reading at rest.
    heldout_mae_pct : error of the model on the last quarter of the recording, percent of the voltage span.
    """

    models: dict[str, InverseModel]
    u_V: FloatArray
    y_um: FloatArray
    dt_s: float
    limits: Limits
    low_um: float
    high_um: float
    rest_um: float
    heldout_mae_pct: float


def identify(
    plant_factory: PlantFactory, config: RehearsalConfig, progress: Callable[[float], None] = lambda _: None
) -> IdentifiedPlant:
    """Identify the models from the chapter's excitation on a new plant.

    Raises FieldError if the answer of the plant is no motion, InputError if no model can be identified.
    """
    plant = plant_factory()
    check_numbers(plant)
    dt_s = plant.dt_s
    low_V, high_V = excitation_range(plant, config)
    progress(0.0)
    go_to_lowest(plant, low_V)
    wave_V = training_input(dt_s, config.identify_s)[1] / (2.0 * CHAPTER_AMPLITUDE_V * _PEAK)
    u_V = np.asarray(low_V + (high_V - low_V) * np.clip(wave_V, 0.0, 1.0))
    _, y_um = run_checked(plant, u_V)
    if not np.isfinite(y_um).all():
        k = int(np.argmin(np.isfinite(y_um)))
        raise FieldError(f"plant: read_um[{k}]", f"{y_um[k]:g} µm", "finite readings while a model is identified")
    if not np.ptp(y_um) > 0.0:
        raise FieldError(
            "plant: read_um", f"{y_um[0]:g} µm throughout", f"a motion under {low_V:g} to {high_V:g} V",
            "is the voltage applied, and is the displacement in µm?",
        )  # fmt: skip
    progress(0.3)
    support = max(10, min(config.support, u_V.size // 2))
    model, report = identify_lssvm(u_V, y_um, dt_s, config=IdentifyConfig(n=support), name=LEARN)
    models: dict[str, InverseModel] = {LEARN: model}
    for name in config.compete:
        progress(0.8)
        models[name] = _FITS[name](u_V, y_um, dt_s)
    features = model.features
    slew = config.slew_V_per_s or SLEW_SPANS_PER_S * (plant.u_max_V - plant.u_min_V)
    limits = Limits(plant.u_min_V, plant.u_max_V, slew)
    progress(1.0)
    return IdentifiedPlant(
        models, u_V, y_um, dt_s, limits, features.y_min_um, features.y_max_um, features.y_rest_um,
        report.heldout_mae_pct,
    )  # fmt: skip


def excitation_range(plant: Plant, config: RehearsalConfig) -> tuple[float, float]:
    """Lowest and highest voltage of the excitation, V. Raises FieldError if they are beyond the drive."""
    low = plant.u_min_V if config.excite_low_V is None else config.excite_low_V
    high = plant.u_max_V if config.excite_high_V is None else config.excite_high_V
    if not plant.u_min_V <= low < high <= plant.u_max_V:
        raise FieldError(
            "excite_low_V, excite_high_V", f"{low:g} V, {high:g} V",
            f"two voltages within the drive, {plant.u_min_V:g} to {plant.u_max_V:g} V, the first one lower",
        )  # fmt: skip
    return low, high


def go_to_lowest(plant: Plant, low_V: float) -> None:
    """Move a plant from its rest to the lowest voltage of the excitation, and let it rest there."""
    rest_V = min(max(0.0, plant.u_min_V), plant.u_max_V)
    if rest_V == low_V:
        return
    q = np.linspace(0.0, 1.0, max(2, round(APPROACH_S / plant.dt_s)))
    run_checked(plant, rest_V + (low_V - rest_V) * q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3))
    run_checked(plant, np.full(max(1, round(REST_S / plant.dt_s)), low_V))


def _linear(u_V: FloatArray, y_um: FloatArray, dt_s: float) -> InverseModel:
    return fit_linear(u_V, y_um, dt_s)[0]


def _mpi(u_V: FloatArray, y_um: FloatArray, dt_s: float) -> InverseModel:
    return fit_mpi(u_V, y_um, dt_s)[0]


def _bouc_wen(u_V: FloatArray, y_um: FloatArray, dt_s: float) -> InverseModel:
    return fit_bouc_wen(u_V, y_um, dt_s)[0]


_FITS: Final[dict[str, Callable[[FloatArray, FloatArray, float], InverseModel]]] = {
    "linear": _linear,
    "mpi": _mpi,
    "bouc_wen": _bouc_wen,
}
