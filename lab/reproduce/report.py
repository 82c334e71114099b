"""``report.md``: the chapter's numbers beside ours, in the order of the chapter, and ``tables.json`` with all of them.

Why ours differ is told once, on the page *The chapter reproduced* of the documentation.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.baselines.bouc_wen.model import BoucWenParameters
from dehyst.baselines.prandtl_ishlinskii.model import MpiParameters, inverse_thresholds, inverse_weights
from dehyst.lab.reproduce.figures import LABELS, draw_control, draw_models, stack_figure
from dehyst.lab.reproduce.measured import WINDOWS, PresetStudy, Stack, Study
from dehyst.service.reports.tables import json_form, markdown
from dehyst.sim.chapter import published
from dehyst.sim.chapter.control import CHANGE_S, FROZEN, GAIN_CHANGE
from dehyst.sim.chapter.forward_lssvm import MemoryLssvm, TwoInputLssvm

Numbers = dict[str, Any]

# --- ``tables.json``: every number of the report, published and computed, and whether the targets are met.

SCHEMA = 1
_TABLE_2_2 = ("r", "w_h", "d", "w_s")


def table_2_1(p: BoucWenParameters) -> dict[str, float]:
    """m kg, b N s/m, k N/m, d m/V, alpha, beta 1/V, gamma 1/V. Of m, b, k only the ratios m/k and b/k are seen."""
    values = (p.m_kg, p.b_N_s_per_m, p.k_N_per_m, 1e-6 * p.d_um_per_V, p.alpha, p.beta_per_V, p.gamma_per_V)
    return dict(zip(published.TABLE_2_1, values, strict=True))


def table_2_2(p: MpiParameters) -> Numbers:
    """r_i V, w_hi, d_j µm, w_sj of the identified model."""
    return dict(zip(_TABLE_2_2, (p.r_, p.w_h_, p.d_, p.w_s_), strict=True))


def table_2_3(p: MpiParameters) -> Numbers:
    """The same of its inverse, (2.12)-(2.14), (2.16)-(2.18)."""
    plays = inverse_thresholds(p.w_h_, p.r_), inverse_weights(p.w_h_)
    dead_zones = inverse_thresholds(p.w_s_, p.d_), inverse_weights(p.w_s_)
    return dict(zip(_TABLE_2_2, (*plays, *dead_zones), strict=True))


def preset_tables(study: PresetStudy) -> Numbers:
    """All numbers of one stage."""
    character, control, models = study.characterisation, study.control, {run.key: run.model for run in study.forward}
    loops: Numbers = {}
    for loop in control.loops:
        loops.setdefault(loop.reference, {}).setdefault(loop.model, {})[loop.controller] = asdict(loop.score)
    hyper: Numbers = {}
    for key, model in models.items():
        if isinstance(model, TwoInputLssvm | MemoryLssvm) and model.evidence is not None:
            hyper[key] = {"gamma": model.evidence.gamma, "sigma": model.evidence.widths, "J3": model.evidence.J3}
    for key, inverse in control.inverses.items():
        if isinstance(inverse.model, LssvmInverse):
            hyper[f"inverse_{key}"] = {"gamma": inverse.model.gamma, "sigma": inverse.model.widths}
    return {
        "range_um": study.data.range_um,
        "seconds": study.seconds,
        "characterisation": {
            "triangles": [asdict(width) | {"width_pct": width.width_pct} for width in character.triangle_widths],
            "sines": [asdict(width) | {"width_pct": width.width_pct} for width in character.sine_widths],
            "cross_talk_pct": character.cross_talk_pct,
            "cross_talk_back_pct": character.cross_talk_back_pct,
        },
        "table_2_1": {key: table_2_1(model) for key, model in models.items() if isinstance(model, BoucWenParameters)},
        "table_2_2": {key: table_2_2(model) for key, model in models.items() if isinstance(model, MpiParameters)},
        "table_2_3": {key: table_2_3(model) for key, model in models.items() if isinstance(model, MpiParameters)},
        "table_2_4": {
            run.key: {name: getattr(run, name) for name in ("label", "route", "parameters", "seconds")}
            | {"modelling": asdict(run.training), "generalisation": asdict(run.generalisation)}
            | {"third_family": {name: asdict(score) for name, score in run.third.items()}}
            | {"third_family_mae_pct": run.third_mae_pct}
            for run in study.forward
        },
        "hyper_parameters": hyper,
        "gains": {
            "ultimate_gain_V_per_um": control.ultimate.gain_V_per_um,
            "ultimate_period_s": control.ultimate.period_s,
            "k_p_V_per_um": control.pid.k_p,
            "k_i_V_per_um_s": control.pid.k_i,
            "chapter_gains_stable": control.chapter_gains_stable,
        },
        "table_2_5": loops,
        "inverse_seconds": {key: inverse.seconds for key, inverse in control.inverses.items()},
        "after_gain_change": {loop.model: asdict(loop.score) for loop in control.changed},
    }


def stack_tables(stack: Stack) -> Numbers:
    """The measured stack: the authors' figures, recomputed from the file, and the models' equivalent errors, µm."""
    return {
        "published_rmse_um": {name: entry[2] for name, entry in WINDOWS.items()},
        "reproduced_rmse_um": stack.reproduced_um,
        "range_um": stack.range_um,
        "models": {
            result.name: {
                "name": result.name,
                "seconds": result.seconds,
                "whole_rmse_um": None if result.score is None else result.score.rmse_um,
                "whole_rmse_pct": None if result.score is None else 100.0 * result.score.rmse_um / stack.range_um,
                "windows_rmse_um": stack.windows_rmse_um(result),
                "failed": result.failed or None,
            }
            for result in stack.results
        },
    }


def targets(study: Study) -> list[Numbers]:
    """The targets: name, limit, result, and whether it is met."""
    found: list[tuple[str, float, float]] = []
    limits = {"bouc_wen": 5.0, "mpi": 2.0, "lssvm": 2.0, "bouc_wen_pso": 60.0, "mpi_pso": 60.0}
    for preset in study.presets:
        found += [
            (f"{preset.name}: {run.label} by {run.route}, s of one core", limits[run.key], run.seconds)
            for run in preset.forward
            if run.key in limits
        ]
        if preset.name != "rich":
            continue
        memory, control, first = preset.model("lssvm_memory"), preset.control, preset.control.loops[0].reference
        worst = max(score.mae_pct for score in memory.third.values())
        forward, hybrid = (control.loop("lssvm_memory", name, first).score.mae_pct for name in ("FF", "FF+FB"))
        found += [
            ("rich: LSSVM with memory on (2.45), MAE %", 0.10, memory.generalisation.mae_pct),
            ("rich: LSSVM with memory, worst of the third family, MAE %", 0.5, worst),
            (f"rich: feedforward alone on {first!r}, LSSVM with memory, MAE %", 0.10, forward),
            (f"rich: feedforward and feedback on {first!r}, LSSVM with memory, MAE %", 0.010, hybrid),
        ]
    return [{"what": what, "limit": limit, "found": got, "met": bool(got <= limit)} for what, limit, got in found]


def tables(study: Study) -> Numbers:
    """The whole of ``tables.json``."""
    whole = {
        "schema": SCHEMA,
        "quick": study.config.quick,
        "epochs": study.config.epochs if study.config.pso else None,
        "seconds": study.seconds,
        "machine": study.machine,
        "labels": {key: label for key, label in LABELS.items() if key != "none"},
        "published": {
            "models": {key: asdict(model) for key, model in published.MODELS.items()},
            "table_2_1": {key: value for key, (_, _, value) in published.TABLE_2_1.items()},
            "table_2_2": dict(zip(_TABLE_2_2, published.TABLE_2_2, strict=True)),
            "table_2_3": dict(zip(_TABLE_2_2, published.TABLE_2_3, strict=True)),
            "hyper_parameters": {"forward": published.FORWARD_HYPER, "inverse": published.INVERSE_HYPER},
            "gains": published.GAINS,
            "cross_talk_pct": published.CROSS_TALK_PCT,
        },
        "presets": {preset.name: preset_tables(preset) for preset in study.presets},
        "picma_stack": stack_tables(study.stack) if study.stack is not None else None,
        "targets": targets(study),
    }
    done: Numbers = json_form(whole)
    return done


# --- Markdown: a section is a heading and what follows it. Pictures that were not drawn are left out.


def number(value: Any, digits: int = 3) -> str:
    """A number with ``digits`` decimals; a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def short(value: Any) -> str:
    """A number with four significant digits; a dash for None."""
    return "–" if value is None else f"{value + 0.0:.4g}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column to the left, the others to the right."""
    return markdown(head, list(rows), left=(0,)) + "\n"


def images(pictures: dict[str, str], *keys: str) -> str:
    """The figures of the chapter by their numbers."""
    return "".join(f"![Fig. {key}]({pictures[key]})\n" for key in keys if key in pictures)


#: Table 2.4: our model -> the chapter's column.
_PUBLISHED = {"bouc_wen_pso": "bouc_wen", "bouc_wen": "bouc_wen", "mpi_pso": "mpi", "mpi": "mpi", "lssvm": "lssvm"}


def models_section(ours: Numbers, theirs: Numbers, pictures: dict[str, str]) -> list[str]:
    """Everything up to Table 2.4: characterisation and forward models."""
    talk, back = ours["characterisation"]["cross_talk_pct"], ours["characterisation"]["cross_talk_back_pct"]
    shapes = (("triangles", "triangle to", "amplitude_V", "V"), ("sines", "sine", "frequency_Hz", "Hz"))
    loops = [
        table(
            [title, "width / µm", "% of its stroke"],
            [
                [f"{width[key]:g} {unit}", number(width["width_um"], 2), number(width["width_pct"], 2)]
                for width in ours["characterisation"][name]
            ],
        )
        for name, title, key, unit in shapes
    ]
    return [
        "## Characterisation\n",
        "The width is the largest distance between both branches at one voltage: the lag of mechanics, amplifier and "
        "sensor counts in it.",
        "This stage has one axis, hence no cross-talk.\n"
        if talk is None
        else f"Cross-talk: {talk:.2f} % from x to y, {back:.2f} % back (published: {theirs['cross_talk_pct']} %).\n",
        *loops,
        "## Bouc-Wen and MPI: Tables 2.1 to 2.3\n",
        _table_2_1(ours["table_2_1"], theirs["table_2_1"]),
        "A recording sees only m/k and b/k. Least squares keeps the chapter's k, and sets m/k as good as none unless "
        "the record shows it.\n",
        _weights_table("Table 2.2: MPI", "", ours["table_2_2"]["mpi"], theirs["table_2_2"]),
        _weights_table("Table 2.3: its inverse", "*", ours["table_2_3"]["mpi"], theirs["table_2_3"]),
        "The scale is fixed: the inverse saturation maps the recorded stroke onto itself. The published weights have "
        "another one (w_s0 = 99.9999), and their dead zones are of no effect (w_s1 to w_s6 about 1e-4).\n",
        "## LSSVM\n",
        _hyper_parameters(ours["hyper_parameters"], theirs["hyper_parameters"]),
        "## Modelling and generalisation: Table 2.4\n",
        _table_2_4(ours["table_2_4"], theirs["models"]),
        "All models are identified from the same 500 displacements at 0.02 s; times are seconds of one core. The third "
        "family is minor loops, a plain 5 Hz sine and random multi-tones; its column is the mean MAE over them.\n",
        images(pictures, "2.15"),
        "## What the chapter did not test\n",
        _third_family(ours["table_2_4"]),
        images(pictures, "third"),
    ]


def _third_family(found: Numbers) -> str:
    """MAE by model and record."""
    records = list(next(iter(found.values()))["third_family"])
    rows = [
        [f"{run['label']}, {run['route']}", *(number(run["third_family"][name]["mae_pct"]) for name in records)]
        for run in found.values()
    ]
    return table(["MAE, %", *records], rows)


def _table_2_1(found: Numbers, theirs: Numbers) -> str:
    columns = [theirs, *found.values()]
    rows = [[name, *(short(column[name]) for column in columns)] for name in theirs]
    rows += [
        [title, *(short(column[top] / column["k"]) for column in columns)]
        for title, top in (("m/k, s²", "m"), ("b/k, s", "b"))
    ]
    return table(["Table 2.1", "published", *found], rows)


def _weights_table(title: str, mark: str, mine: Numbers, theirs: Numbers) -> str:
    """Table 2.2 or 2.3: thresholds and weights of both, by their number."""
    columns = [source[name] for source in (theirs, mine) for name in _TABLE_2_2]
    rows = [
        [str(i), *(short(column[i]) if i < len(column) else "" for column in columns)]
        for i in range(max(map(len, columns)))
    ]
    head = [f"{whose} {name}{mark}" for whose in ("published", "ours") for name in _TABLE_2_2]
    return f"**{title}** (forward: r in V, d in the unit between both operators; inverse: r* in that, d* in µm)\n\n" + (
        table(["i", *head], rows)
    )


def _hyper_parameters(found: Numbers, theirs: Numbers) -> str:
    rows = [[f"published, {name}", *map(short, theirs[name])] for name in ("forward", "inverse")]
    for key, one in found.items():
        widths = dict.fromkeys(map(short, one["sigma"]))
        rows.append([key, short(one["gamma"]), ", ".join(widths)])
    return table(["hyper-parameters", "gamma", "sigma"], rows)


def _table_2_4(found: Numbers, theirs: Numbers) -> str:
    rows = []
    for key, run in found.items():
        cells = [f"{run['label']}, {run['route']}", number(run["seconds"])]
        for part in ("modelling", "generalisation"):
            cells += [number(run[part]["mae_pct"], 4), number(run[part]["rmse_pct"], 4)]
        cells += [number(run["modelling"]["max_um"], 2), number(run["third_family_mae_pct"])]
        other = theirs.get(_PUBLISHED.get(key, ""), {})
        cells += [short(other.get("identification_s")), number(other.get("modelling_mae_pct"))]
        cells += [number(other.get("generalisation_mae_pct")), number(other.get("max_um"), 2)]
        rows.append(cells)
    head = ["Table 2.4", "time / s", "modelling MAE", "RMSE", "generalisation MAE", "RMSE", "max / µm", "third family"]
    head += [f"published {name}" for name in ("time / s", "modelling", "generalisation", "max / µm")]
    return table(head, rows)


# Control: Table 2.5, Fig. 2.17, and the value of adaptation.


def control_section(ours: Numbers, theirs: Numbers, pictures: dict[str, str]) -> list[str]:
    """Section 2.5 of the chapter."""
    gains, changed = ours["gains"], ours["after_gain_change"]
    first, *others = [_table_2_5(name, ours, theirs["models"]) for name in ours["table_2_5"]]
    times = ", ".join(f"{FROZEN[key]} {seconds:.2f} s" for key, seconds in ours["inverse_seconds"].items())
    return [
        "## Control: Table 2.5\n",
        "Ziegler and Nichols' experiment on the stage at T = 1 ms: ultimate gain "
        f"{gains['ultimate_gain_V_per_um']:.4f} V/µm, period {1e3 * gains['ultimate_period_s']:.2f} ms, hence PI gains "
        f"K_p = {gains['k_p_V_per_um']:.4f} V/µm, K_i = {gains['k_i_V_per_um_s']:.2f} V/(µm s) (published: "
        f"{theirs['gains']['K_p']} and {theirs['gains']['K_i']}). The chapter's K_p is " + _with_chapter_gains(ours),
        first,
        images(pictures, "2.17"),
        *others,
        f"Frozen models are those identified from the 10 s of (2.37) at 1 ms ({times}). Learning ones start from them "
        "at rest and learn along the reference they are judged on: voltages of 20 ms are answered by a snapshot that "
        "has seen no sample of the last 40 ms.\n",
        "## When the stage changes\n",
        f"Feedforward alone on the last reference, while the gain of the stage drops by {-100 * GAIN_CHANGE:g} % "
        f"at {CHANGE_S:g} s; errors from one second after it on.\n",
        table(
            ["model", "MAE, %", "max / µm"],
            [[LABELS[key], number(score["mae_pct"], 4), short(score["max_um"])] for key, score in changed.items()],
        ),
        images(pictures, "change"),
    ]


def _with_chapter_gains(ours: Numbers) -> str:
    """What the chapter's gains do on this stage."""
    if not ours["gains"]["chapter_gains_stable"]:
        return "above that, unstable here, and not used.\n"
    loop = next(iter(ours["table_2_5"].values()))["lssvm_memory"]["FF+FB, chapter's gains"]
    return f"stable here: with its gains FF+FB of the LSSVM with memory has a MAE of {loop['mae_pct']:.4f} %.\n"


def _table_2_5(reference: str, ours: Numbers, theirs: Numbers) -> str:
    """Errors of every model with every controller on one reference; the published ones beside the first."""
    found, rows = ours["table_2_5"][reference], []
    for key, label in {**LABELS, "none": "feedback alone"}.items():
        scores = [
            None if key == "none" else found.get(key, {}).get("FF"),
            found[key].get("FB" if key == "none" else "FF+FB"),
        ]
        other = theirs.get(key, {}) if reference == next(iter(ours["table_2_5"])) else {}
        cells = [number(score and score[name], 4) for score in scores for name in ("mae_pct", "rmse_pct")]
        rows.append([label, *cells, *(number(other.get(name)) for name in ("feedforward_mae_pct", "hybrid_mae_pct"))])
    head = ["FF MAE", "FF RMSE", "FF+FB MAE", "FF+FB RMSE", "published FF", "published FF+FB"]
    return table([f"Reference {reference}", *head], rows)


# Data that were not simulated here.

_NAMES = {
    "linear": "linear gain",
    "bouc_wen": "Bouc-Wen",
    "mpi": "MPI",
    "lssvm_frozen": "LSSVM (y, dy/dt)",
    "lssvm_adaptive": "LSSVM with memory, frozen",
    "bouc_wen_online": "Bouc-Wen, learning",
    "mpi_online": "MPI, learning",
    "lssvm_adaptive_online": "LSSVM with memory, learning",
}


def stack_section(found: Numbers, pictures: dict[str, str]) -> list[str]:
    """The measured stack actuator."""
    windows = list(found["published_rmse_um"])
    rows = [
        ["the authors' own experiment", "–", "–", *(f"{found['published_rmse_um'][name]}" for name in windows)],
        ["the same from their file", "–", "–", *(number(found["reproduced_rmse_um"][name]) for name in windows)],
    ]
    for name, model in found["models"].items():
        cells = [number(model["whole_rmse_um"]), number(model["whole_rmse_pct"], 2)]
        rows.append([_NAMES.get(name, name), *cells, *(number(model["windows_rmse_um"].get(at)) for at in windows)])
    return [
        "# Measured: a stack actuator\n",
        "A PICMA stack moving a flexure, capacitive sensor, 5 ms (data by Aye and Ang, 2018, MIT licence). Models are "
        "identified on `model_sine_1hz.csv` and tested on `test_ramped_sine_ff.csv`. Each is given the motion that the "
        "stage really made; the error of its voltage, times the mean gain, is what a feedforward of that voltage would "
        "have been off, to first order. In the windows the mean is removed. Learning models answer 20 ms from "
        "snapshots that are at least 40 ms old; their settings were chosen after seeing this recording.\n",
        table(["inverse model, RMSE", "whole test / µm", "% of range", *(f"{name} / µm" for name in windows)], rows),
        images(pictures, "stack"),
    ]


INTRODUCTION = """\
# The chapter reproduced

Every table of *Feedforward Control Based on Inverse Hysteresis Models*, computed anew by `dehyst reproduce`
on simulated stages: compare patterns, not digits. Why they differ, and which choices were made after seeing results, is
on the page *The chapter reproduced* of the documentation. `published` columns are the chapter's numbers. Errors are MAE
(2.43) and RMSE (2.44) in percent of the motion range, unless stated otherwise.
"""


#: What takes the place of a section that this report had.
BENCHMARK = (
    "The Bouc-Wen benchmark (Noël and Schoukens, 2016) is no longer in this report: `dehyst diagnose` finds and "
    "measures its hysteresis, see the page *Diagnosis*.\n"
)


def report(numbers: Numbers) -> str:
    """The whole report from the content of ``tables.json``."""
    pictures, theirs = numbers["pictures"], numbers["published"]
    quick = " A quick run: shorter records, fewer epochs." if numbers["quick"] else ""
    rows = [
        [row["what"], f"{row['limit']:g}", f"{row['found']:.3g}", "yes" if row["met"] else "**no**"]
        for row in numbers["targets"]
    ]
    parts = [INTRODUCTION, f"Computed in {numbers['seconds']:.0f} s on {numbers['machine']}.{quick}\n"]
    parts += ["## Targets\n", table(["target", "at most", "result", "met"], rows)]
    for name, ours in numbers["presets"].items():
        parts.append(f"# Stage `{name}`\n")
        parts += models_section(ours, theirs, pictures[name]) + control_section(ours, theirs, pictures[name])
    stack = numbers["picma_stack"]
    nothing = ["Measured data were not found; set `DEHYST_DATA` to the folder that holds them.\n"]
    parts += stack_section(stack, pictures["measured"]) if stack else nothing
    parts.append(BENCHMARK)
    return "\n".join(part for part in parts if part)


# --- A study onto the disk: ``report.md``, ``tables.json``, and one PNG a figure in a folder for each stage.


def write_study(study: Study, out: Path, progress: Callable[[str], None] = lambda _: None) -> Numbers:
    """Write all files into ``out``; returns the content of ``tables.json``. Raises OSError from the disk."""
    numbers, pictures = tables(study), dict[str, dict[str, str]]()
    for preset in study.presets:
        progress(f"[{preset.name}] drawing the figures")
        folder = out / preset.name
        folder.mkdir(exist_ok=True)
        drawn = {**draw_models(folder, preset), **draw_control(folder, preset)}
        pictures[preset.name] = {key: path.relative_to(out).as_posix() for key, path in drawn.items()}
    pictures["measured"] = {}
    if study.stack is not None:
        pictures["measured"]["stack"] = stack_figure(out / "measured_stack.png", study.stack).name
    numbers["pictures"] = pictures
    (out / "tables.json").write_text(json.dumps(numbers, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    (out / "report.md").write_text(report(numbers), encoding="utf-8")
    return numbers
