"""What a diagnosis fits: recorded data, nominal stages, cause models, and their calibration."""

from sim.diagnosis.model.calibration import ModelFit, calibrate, calibrate_nominal
from sim.diagnosis.model.fit_data import FitData, ModelParameter
from sim.diagnosis.model.stage_model import CauseModel, StageModel

__all__ = ["CauseModel", "FitData", "ModelFit", "ModelParameter", "StageModel", "calibrate", "calibrate_nominal"]
