"""What `dehyst diagnose` leaves on the disk: report.json, report.md, its pictures and the extended stage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from adaptive.errors import InputError
from service.diagnosis_pictures import draw_cause, draw_residual
from sim.diagnosis.export import Exported, export
from sim.diagnosis.result import Cause, Diagnosis
from sim.effects import KINDS
from sim.stagefile import save_stage

VERDICTS = {
    "adequate": "The nominal stage explains this recording down to its noise.",
    "effects": "The nominal stage lacks what follows.",
    "unexplained": "Something is in this recording that no cause of the catalogue explains.",
}


def write_report(out: Path, diagnosis: Diagnosis, source: str, findings: list[str]) -> dict[str, Any]:
    """Write everything into the folder ``out`` and return report.json's content.

    Raises InputError where the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        data = diagnosis.as_dict()
        (out / "report.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        exported = export(diagnosis)
        save_stage(exported.config, out / "stage.toml")
        draw_residual(out / "residual.png", diagnosis, f"{source}: {diagnosis.verdict}")
        # Pictures of an earlier diagnosis in this folder would be taken for this one's.
        for old in out.glob("[0-9]-*.png"):
            old.unlink()
        for place, cause in enumerate(diagnosis.causes):
            draw_cause(out / picture_name(place, cause), cause, diagnosis)
        (out / "report.md").write_text(markdown(diagnosis, exported, source, findings), encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out: cannot write into {out}: {error.strerror}; name a folder you may write to") from error
    return data


def picture_name(place: int, cause: Cause) -> str:
    return f"{place + 1}-{cause.name}.png"


def length(value_um: float) -> str:
    """A length with the unit that suits it."""
    return f"{1e3 * value_um:.3g} nm" if abs(value_um) < 1.0 else f"{value_um:.3g} µm"


def markdown(diagnosis: Diagnosis, exported: Exported, source: str, findings: list[str]) -> str:
    """The page that an engineer reads in two minutes."""
    d = diagnosis
    setting = d.nominal.model.setting
    lines = [
        f"# What the simulation lacks: {source}",
        "",
        f"**Verdict: {d.verdict}.** {VERDICTS[d.verdict]}",
        "",
        f"{setting.n} samples of {setting.dt_s:g} s; range {length(setting.range_um)}; nominal stage: "
        f"{d.nominal.model.nominal.name}.",
        "",
        "| free-run error, rms | on all of the record | held out |",
        "|---|---|---|",
        f"| nominal stage, calibrated | {length(d.nominal_rmse_um)} | {length(d.nominal_heldout_um)} |",
        f"| extended stage | {length(d.extended_rmse_um)} | {length(d.extended_heldout_um)} |",
        f"| noise floor (from {d.floor_source}) | {length(d.noise_floor_um)} | |",
        "",
        "![residual before and after](residual.png)",
        "",
    ]
    for place, cause in enumerate(d.causes):
        lines += _section(place, cause)
    if d.verdict == "unexplained":
        lines += ["## What is left", "", "The residual above repeats with the drive and is far above the noise."]
        if d.partial:
            lines += [
                f"Of the causes tried, {', '.join(d.partial)} came closest, but together they leave more than 60 % of "
                "the excess over the noise: none of them is named."
            ]
        lines.append("")
    lines += ["## What this recording cannot say", ""]
    lines.append(
        f"Not excited (its usual size would not show here): {', '.join(d.not_excited)}."
        if d.not_excited
        else "Every cause of the catalogue would have shown."
    )
    sets = [f"{c.name} and {', '.join(c.alternatives)}" for c in d.causes if c.alternatives]
    if sets:
        lines += ["", f"Inseparable here: {'; '.join(sets)}."]
    lines += [
        "",
        "## The next experiment",
        "",
        d.next_experiment or "Nothing is open that another drive would settle.",
        "",
    ]
    lines += [
        "## The extended stage",
        "",
        f"`stage.toml` runs with `dehyst stage --file stage.toml`. Its free run is {length(exported.rms_um)} rms "
        "from the model that was fitted here (the recorder's latch and the noise left out).",
        "",
    ]
    if findings:
        lines += ["## The recording itself", "", *(f"- {text}" for text in findings), ""]
    return "\n".join(lines)


def _section(place: int, cause: Cause) -> list[str]:
    kind = KINDS.get(cause.name)
    lines = [f"## {place + 1}. {cause.name}", ""]
    lines.append(
        f"Removes {100.0 * cause.heldout_gain:.3g} % of the held-out squared error that is left before it; chance "
        f"does as well in {100.0 * cause.p_value:.2g} % of cases at most."
    )
    if cause.alternatives:
        lines.append(f"This recording cannot tell it from: **{', '.join(cause.alternatives)}**.")
    lines += ["", "| parameter | value | 95 % interval |", "|---|---|---|"]
    for name, value in cause.parameters.items():
        low, high = cause.intervals[name]
        lines.append(f"| {name} | {value:.5g} | {low:.5g} to {high:.5g} |")
    lines += ["", f"![{cause.name}]({picture_name(place, cause)})", ""]
    if kind is not None:
        lines.append(f"Signature: {kind.signature}.")
        if kind.mistaken_for:
            lines.append(f"Easily mistaken for {', '.join(kind.mistaken_for)}; {kind.tells_apart}.")
        lines.append("")
    return lines
