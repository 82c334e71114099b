"""The causes that a diagnosis may name, and the models that are fitted for them."""

from __future__ import annotations

from sim.diagnosis.causes.drive import AmplifierLag, Saturation, SlewLimit
from sim.diagnosis.causes.hysteresis import Asymmetry, HysteresisShape, RateDependence, RestoringForceLoop
from sim.diagnosis.causes.mechanics import CrossModes, Delay, PayloadChange, Resonance, SensorLag, StructureModes
from sim.diagnosis.causes.motion import Creep, CrossTalk, GainDrift, StickSlip, ThermalDrift
from sim.diagnosis.causes.reading import MainsHum, SensorNonlinearity, Timing
from sim.diagnosis.causes.slips import Slips
from sim.diagnosis.model.stage_model import CauseModel
from sim.effects import CAUSES

#: Every model that is tried. Models of one name are variants of one cause.
CAUSE_MODELS: tuple[CauseModel, ...] = (
    HysteresisShape(),
    HysteresisShape(variant="restoring"),
    RestoringForceLoop(),
    Asymmetry(),
    RateDependence(),
    RateDependence(rate_lag_s=0.04),
    RateDependence(variant="thresholds"),
    RateDependence(variant="added"),
    RateDependence(variant="added", rate_lag_s=0.04),
    Creep(),
    ThermalDrift(),
    ThermalDrift(variant="temperature", of_one_recording=False),
    GainDrift(),
    GainDrift(variant="temperature", of_one_recording=False),
    Resonance(),
    StructureModes(),
    PayloadChange(),
    PayloadChange(variant="midway"),
    AmplifierLag(),
    SlewLimit(),
    Saturation(),
    Delay(),
    SensorLag(),
    SensorNonlinearity(),
    CrossTalk(),
    CrossModes(),
    MainsHum(variant="50"),
    MainsHum(variant="60"),
    StickSlip(),
    Timing(),
    Slips(),
)
#: Causes that one voltage and one sensor cannot tell apart: beside one of them the other is not added.
SETS: tuple[frozenset[str], ...] = (
    frozenset({"asymmetry", "sensor_nonlinearity"}),
    frozenset({"amplifier_lag", "sensor_lag"}),
)


def same_set(names: set[str]) -> set[str]:
    """The names, with those that cannot be told from one of them."""
    return names.union(*(s for s in SETS if s & names))


#: The names of the catalogue, in the order of the chain. Quantisation has no model; it is found in the readings.
NAMES: tuple[str, ...] = tuple(CAUSES)
