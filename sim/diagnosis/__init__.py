"""Diagnosis of a recording: which effects a real stage has that its simulation lacks.

`prepare` checks a recording; `diagnose_prepared` calibrates a nominal stage, searches for causes and returns a
`Diagnosis`; `export_stage` turns it into a stage file.

    from dehyst.sim.diagnosis import diagnose_prepared, export_stage, prepare
    from dehyst.sim.recordings import read

    diagnosis = diagnose_prepared(prepare(read(path)))
    print(diagnosis.verdict, [cause.name for cause in diagnosis.causes])
    stage = export_stage(diagnosis).config
"""

from dehyst.sim.diagnosis.diagnose import Options, diagnose, diagnose_prepared
from dehyst.sim.diagnosis.export import ExportedStage, export_stage
from dehyst.sim.diagnosis.prepare import Prepared, prepare
from dehyst.sim.diagnosis.result import Diagnosis, NamedCause
from dehyst.sim.diagnosis.search.search import Thresholds
from dehyst.sim.fitting.fit_data import FitData

__all__ = [
    "Diagnosis",
    "ExportedStage",
    "FitData",
    "NamedCause",
    "Options",
    "Prepared",
    "Thresholds",
    "diagnose",
    "diagnose_prepared",
    "export_stage",
    "prepare",
]
