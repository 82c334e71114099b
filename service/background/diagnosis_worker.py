"""The process that diagnoses (see `service.background.job`).

``python -m dehyst.service.background.diagnosis_worker FOLDER``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.service.background.job import run_worker


def _diagnosed(job: dict[str, Any], arrays: dict[str, FloatArray]) -> dict[str, Any]:
    from dehyst.sim.changes import TooFewSamples

    try:
        return diagnose(job, arrays["reference"], arrays["recent"])
    except TooFewSamples as error:
        # More recent samples will arrive; the reference does not grow.
        return {"error": str(error), "wait": error.stretch == "recent"}


def diagnose(job: dict[str, Any], reference: FloatArray, recent: FloatArray) -> dict[str, Any]:
    """The verdict on (4, n) samples ``recent`` (seq, t_s, u_V, y_um) against ``reference``.

    ``job`` holds ``model`` (model file), ``name`` (of the model in it), ``from_seq`` (first recent sample) and
    ``report`` (folder for a full report, or empty). Raises InputError and ModelFileError.
    """
    from dehyst.service.storage.model_file import read_bundle
    from dehyst.sim.changes import compare

    bundle = read_bundle(job["model"])
    model = bundle.models[job["name"]]
    result = compare(
        model, stretch_of(reference, model.dt_s, -1), stretch_of(recent, model.dt_s, int(job["from_seq"]))
    ).as_dict()
    if job.get("report"):
        result["report"] = full_report(Path(job["report"]), recent, model.dt_s)
    return result


def stretch_of(samples: FloatArray, dt_s: float, from_seq: int) -> Any:
    """Samples (4, n) as a stretch for the comparison; those before ``from_seq`` only settle the hysteresis memory.

    A long gap splits the samples: then the part with most samples from ``from_seq`` on is taken.
    """
    from dehyst.adaptive.smoothing import SmootherConfig, smooth_recording
    from dehyst.sim.changes import Stretch

    first = int(np.searchsorted(samples[0], from_seq))
    whole, valid = _repaired(samples, dt_s, first)
    numbers = np.rint(whole.t_s / dt_s) + samples[0, 0]
    scored = valid & (numbers >= from_seq)
    config = SmootherConfig.for_rate(dt_s)
    # At its ends the smoother extrapolates.
    scored[: config.lag] = scored[-config.lag :] = False
    motion = smooth_recording(whole.y_um, config)
    return Stretch(dt_s, whole.t_s, np.ascontiguousarray(whole.u_V), motion, scored)


def _repaired(samples: FloatArray, dt_s: float, since: int = 0) -> tuple[Any, BoolArray]:
    from dehyst.sim.recordings import Recording, repaired

    # Sample numbers give the time, as in the learner: the clock of the stage may have been set.
    recording = Recording(
        t_s=dt_s * (samples[0] - samples[0, :1]), u_V=samples[2], y_um=samples[3], dt_s=dt_s, source="recent samples",
        seq=samples[0].astype(np.int64),
    )  # fmt: skip
    fixed = repaired(recording, since)
    return fixed.recording, fixed.valid


def full_report(out: Path, samples: FloatArray, dt_s: float) -> dict[str, Any]:
    """The diagnosis of the recent samples as measured data, with its report in the folder ``out``."""
    from dehyst.service.reports.diagnosis import Source, write_report
    from dehyst.sim.diagnosis.diagnose import diagnose_prepared
    from dehyst.sim.diagnosis.prepare import prepare

    recording, _ = _repaired(samples, dt_s)
    prepared = prepare(recording)
    source = Source("recent samples", (*(f.message for f in prepared.findings), *prepared.notes))
    return {"folder": str(out), **write_report(out, diagnose_prepared(prepared), source)}


if __name__ == "__main__":
    sys.exit(run_worker(_diagnosed))
