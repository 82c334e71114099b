"""What `dehyst diagnose` leaves on the disk: report.json, report.md, its pictures, the extended stage, and an .rrd."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from adaptive.errors import InputError
from service.reports.diagnosis_page import Source, page, picture_name
from service.reports.diagnosis_pictures import draw_cause, draw_residual
from sim.diagnosis.export import export_stage
from sim.diagnosis.result import Diagnosis
from sim.stage.file import save_stage

__all__ = ["Source", "write_report"]


def write_report(out: Path, diagnosis: Diagnosis, source: Source, *, rrd: bool = True) -> dict[str, Any]:
    """Write everything into the folder ``out`` and return report.json's content.

    ``rrd``: also ``diagnosis.rrd`` for the Rerun viewer. Raises InputError where the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        # What an earlier diagnosis left in this folder would be taken for this one's.
        for old in (*out.glob("[0-9]-*.png"), *out.glob("diagnosis.rrd")):
            old.unlink()
        data = diagnosis.as_dict()
        (out / "report.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        exported = export_stage(diagnosis)
        save_stage(exported.config, out / "stage.toml")
        draw_residual(out / "residual.png", diagnosis, f"{source.data}: {diagnosis.verdict}")
        for place, cause in enumerate(diagnosis.causes):
            draw_cause(out / picture_name(place, cause), cause, diagnosis)
        text = page(diagnosis, exported, source, viewer=rrd)
        (out / "report.md").write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out: cannot write into {out}: {error.strerror}; name a folder you may write to") from error
    if rrd:
        from service.reports.diagnosis_viewer import write_viewer

        write_viewer(out / "diagnosis.rrd", diagnosis, source.data, text)
    return data
