"""Modes of a stage from periodic recordings: several drives, outputs, realisations, periods and amplitudes in one fit.

    from dehyst.sim.modal import PeriodicRecord, study
    found = study([PeriodicRecord("100 mV", u_V, y_um, dt_s), ...], tests=[...])
    print(found.levels[0].test_um, [mode.sentence(0.1, 0.3) for mode in found.modes])

``periods`` averages, measures the noise and solves for the response matrix, ``model`` has the start of the fit and
predicts, ``fit`` fits, ``study`` judges and names, ``reading`` reads files.
"""

from dehyst.sim.modal.fit import FitSettings, ModalFit, fit_modes
from dehyst.sim.modal.model import ModalModel, output_errors
from dehyst.sim.modal.periods import (
    FrequencyResponse,
    LineSpectra,
    PeriodicRecord,
    average,
    cut_into_periods,
    frequency_response,
)
from dehyst.sim.modal.study import Level, ModalStudy, Mode, study

__all__ = [
    "FitSettings",
    "FrequencyResponse",
    "Level",
    "LineSpectra",
    "ModalFit",
    "ModalModel",
    "ModalStudy",
    "Mode",
    "PeriodicRecord",
    "average",
    "cut_into_periods",
    "fit_modes",
    "frequency_response",
    "output_errors",
    "study",
]
