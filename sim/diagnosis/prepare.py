"""From a recording to the data of a diagnosis: checked, repaired onto its time grid, filled samples marked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.diagnosis.nominal import NAMED
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.recordings import Finding, Recording, check, repaired, require_usable
from dehyst.sim.stage.config import StageConfig

#: A longer recording is cut to its first samples, so that memory stays below 1 GB.
MOST_SAMPLES = 200_000


@dataclass(frozen=True)
class Prepared:
    """A recording ready for a diagnosis. ``mask`` (n,) is False where a sample was filled in."""

    data: FitData
    mask: BoolArray
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    #: Number of samples that the recorder lost or doubled according to its time base.
    dropped: int
    #: Nominal stage: "bouc_wen", "linear", or the stage of a stage file.
    nominal: str | StageConfig = "bouc_wen"
    #: Another recording of the same stage, for held-out errors.
    test: Prepared | None = None


def prepare(
    recording: Recording, *, nominal: str | StageConfig = "bouc_wen", test: Recording | None = None
) -> Prepared:
    """Check, repair and cut a recording.

    ``nominal``: ``"bouc_wen"`` (the chapter's stage), ``"linear"`` (one mode), or a stage
    (`sim.stage.file.load_stage`).
    ``test``: another recording of the same stage with the same sample time, on which the held-out errors are taken.
    Raises InputError, with advice, if the recording cannot be diagnosed.
    """
    if not isinstance(nominal, StageConfig) and nominal not in NAMED:
        raise InputError(f"nominal: got {nominal!r}, expected one of {', '.join(NAMED)}, or a stage of a stage file")
    own = _prepared(recording, nominal)
    if test is None:
        return own
    if abs(test.dt_s - recording.dt_s) > 1e-6 * recording.dt_s:
        raise InputError(
            f"{test.source or 'test recording'}: got a sample time of {test.dt_s:g} s, expected {recording.dt_s:g} s "
            "as in the recording; record both alike"
        )
    return replace(own, test=_prepared(test, nominal))


def _prepared(recording: Recording, nominal: str | StageConfig) -> Prepared:
    findings = check(recording)
    require_usable(recording, findings)
    where = recording.source or "recording"
    for finding in findings:
        if finding.kind == "swapped":
            raise InputError(
                f"{where}: {finding.message}; a diagnosis of exchanged columns would name causes that are not there"
            )
    bad = int(np.sum(~(np.isfinite(recording.u_V) & np.isfinite(recording.y_um))))
    if bad > 0.05 * len(recording):
        raise InputError(
            f"{where}: got {bad} of {len(recording)} samples that are no finite numbers, expected at most 5 %: "
            "record again, or give the part that is whole (--range)"
        )
    fixed = repaired(recording)
    whole = fixed.recording
    notes = list(fixed.done)
    if len(whole) < 1000:
        raise InputError(
            f"{where}: got {len(whole)} usable samples, expected at least 1000: too few to name a cause; record longer"
        )
    if len(whole) > MOST_SAMPLES:
        notes.append(f"the first {MOST_SAMPLES} of {len(whole)} samples were used (--range chooses others)")
        whole = whole.part(0, MOST_SAMPLES)
    lost = sum(f.count for f in findings if f.kind in ("gap", "doubled"))
    data = FitData(
        dt_s=recording.dt_s,
        u_V=np.ascontiguousarray(whole.u_V),
        y_um=np.ascontiguousarray(whole.y_um),
        u2_V=_moving(whole.u2_V),
        y2_um=_moving(whole.y2_um),
        u3_V=_moving(whole.u3_V),
        temperature_C=whole.temperature_C,
        monitor_V=_moving(whole.monitor_V),
    )
    return Prepared(data, fixed.valid[: len(whole)], tuple(findings), tuple(notes), lost, nominal)


def _moving(values: FloatArray | None) -> FloatArray | None:
    """The column, or None if it is constant or not finite."""
    if values is None or not np.all(np.isfinite(values)) or float(np.ptp(values)) == 0.0:
        return None
    return np.ascontiguousarray(values, dtype=np.float64)
