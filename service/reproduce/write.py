"""A study onto the disk: ``report.md``, ``tables.json``, and one PNG a figure in a folder for each stage."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.errors import FieldError
from service.reproduce.figures_control import draw_control
from service.reproduce.figures_measured import benchmark_figure, stack_figure
from service.reproduce.figures_models import draw_models
from service.reproduce.report import report, write_report
from service.reproduce.study import Study
from service.reproduce.tables import tables


def prepare(out: Path) -> Path:
    """The folder for the results, made where it is missing. Raises InputError where it cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FieldError("--out", str(out), f"a folder that can be written ({error.strerror})") from error
    return out


def write_study(study: Study, out: Path, progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Write all files into ``out``; returns the content of ``tables.json``. Raises OSError from the disk."""
    pictures: dict[str, dict[str, str]] = {}
    for preset in study.presets:
        progress(f"[{preset.name}] drawing the figures")
        folder = out / preset.name
        folder.mkdir(exist_ok=True)
        drawn = {**draw_models(folder, preset), **draw_control(folder, preset)}
        pictures[preset.name] = {key: path.relative_to(out).as_posix() for key, path in drawn.items()}
    measured = {}
    if study.stack is not None:
        measured["stack"] = stack_figure(out / "measured_stack.png", study.stack).name
    if study.benchmark is not None:
        measured["benchmark"] = benchmark_figure(out / "boucwen_benchmark.png", study.benchmark).name
    pictures["measured"] = measured
    numbers = tables(study)
    numbers["pictures"] = pictures
    (out / "tables.json").write_text(json.dumps(numbers, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    write_report(out / "report.md", report(study, numbers, pictures))
    return numbers
