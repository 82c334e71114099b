"""The files of `dehyst modes`: report.json, report.md, and pictures of the response matrix and of what is left."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.service.reports.tables import markdown
from dehyst.service.viewer.colours import AFTER, BEFORE, MEASURED, NOISE_BAND, SERIES
from dehyst.sim.modal import ModalStudy
from dehyst.sim.modal.periods import smoothed
from dehyst.sim.modal.study import RAYLEIGH_RATIO, Level, Mode


def write_modes(out: Path, study: ModalStudy, *, pictures: bool = True) -> dict[str, Any]:
    """Write all files into the folder ``out`` and return the content of report.json.

    Raises InputError if the folder cannot be written.
    """
    data = study.as_dict()
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        (out / "report.md").write_text(page(study, pictures=pictures), encoding="utf-8")
        if pictures:
            draw_response(out / "response.png", study)
            draw_left(out / "left.png", study)
    except OSError as error:
        raise InputError(f"--out: cannot write into {out}: {error.strerror}; name a folder you may write to") from error
    return data


def page(study: ModalStudy, *, pictures: bool = True) -> str:
    """The content of report.md. ``pictures``: they are written as well."""
    model, levels = study.fit.model, study.levels
    low, high = levels[0].response.spectra.amplitude_V, levels[-1].response.spectra.amplitude_V
    outputs, drives = model.coefficients.shape[2:]
    several, reals = len(levels) > 1, len(model.theta) - 2 * model.modes
    parts = [
        f"# {len(study.modes)} modes of {_count(drives, 'drive')} and {_count(outputs, 'output')}",
        f"One model for all recordings: {model.modes} pole pairs and {_count(reals, 'real pole')}, common to all "
        "drives and outputs.",
        f"Poles and residues are polynomials of degree {model.degree} in the rms of the drive, {low:.3g} to {high:.3g} "
        "V." * several,
        "" if study.fit.converged else NOT_CONVERGED,
        "## Errors",
        errors_table(levels),
        ERRORS + ONE_LINEAR * several,
        _verdict(levels),
        PICTURES if pictures else "",
        "## Modes",
        modes_table(study.modes),
        _changes(study.modes, low, high) if several else "",
        "## The recordings" if study.notes else "",
        "\n".join(f"- {note}" for note in study.notes),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


NOT_CONVERGED = "**The search ended at its last step, not at a minimum**: start from fewer modes (`--start-modes`)."
ERRORS = (
    "Rms over realisations, mean of the outputs, of measured minus computed mean period in steady state. *Noise*: of "
    "the mean period, from the spread between periods; no model can be better. *Noise and distortion*: what the "
    "realisations of one amplitude do not have in common; no linear model of that amplitude can be better."
)
ONE_LINEAR = (
    " *One linear model*: the same poles, held constant, with one set of residues for all amplitudes; what it has more "
    "is what changes with the amplitude."
)
PICTURES = "![measured and computed response](response.png)\n\n![what is left, and the noise](left.png)"
CHANGES = f"""\
A hysteresis loop in a mode's stiffness makes it softer and more damped: for Rayleigh's loop the damping ratio rises \
by 4/(3π) = {RAYLEIGH_RATIO:.2f} of the relative fall of the frequency. An elastic softening adds no damping. A loop \
in front of the modes (in the actuator) changes their gain and leaves frequency and damping."""
#: A held-out error within this factor of noise and distortion is at the limit of linear models.
AT_THE_LIMIT = 1.25


def _verdict(levels: Sequence[Level]) -> str:
    """What the remaining error is, where the realisations show it."""
    known = [(level.test_um, level.response) for level in levels if level.response.knows_distortion]
    judged = [(test_um, response) for test_um, response in known if test_um is not None]
    if not judged:
        return ""
    ratios = [float(test_um.mean() / response.distortion_um.mean()) for test_um, response in judged]
    text = f"Held-out error over noise and distortion: {', '.join(f'{ratio:.2f}' for ratio in ratios)}. " + (
        "The modes explain all that a linear model of each amplitude can explain."
        if max(ratios) <= AT_THE_LIMIT
        else "There is more to explain by linear dynamics: start from more modes, or record more realisations."
    )
    floors = [(response.distortion_um.mean(), response.spectra.floor_um) for _, response in judged]
    over = max((distortion / floor.mean() for distortion, floor in floors if np.isfinite(floor).all()), default=0.0)
    if over > 2.0:
        text += (
            f" Noise and distortion are up to {over:.2g} times the noise alone: this part is nonlinear within one "
            "amplitude, and only a nonlinear model can explain it."
        )
    return text


def _count(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def errors_table(levels: Sequence[Level]) -> str:
    """Errors by amplitude, µm, in Markdown."""
    head = ["drive / V rms", "output / µm rms", "noise", "noise and distortion", "training", "held out", "by output"]
    rows = []
    for level in levels:
        spectra, distortion_um = level.response.spectra, level.response.distortion_um
        shown = level.train_um if level.test_um is None else level.test_um
        rows.append([
            f"{spectra.amplitude_V:.4g}",
            f"{spectra.signal_um.mean():.3f}",
            f"{spectra.floor_um.mean():.4f}" if np.isfinite(spectra.floor_um).all() else "not known",
            f"{distortion_um.mean():.4f}" if level.response.knows_distortion else "not known",
            f"{level.train_um.mean():.4f}",
            "none" if level.test_um is None else f"{level.test_um.mean():.4f}",
            ", ".join(f"{value:.4f}" for value in shown),
            f"{level.constant_um.mean():.4f}",
        ])  # fmt: skip
    columns = len(head) + (len(levels) > 1)
    return markdown([*head, "one linear model"][:columns], [row[:columns] for row in rows], left=(len(head) - 1,))


def modes_table(modes: Sequence[Mode]) -> str:
    """Frequencies, dampings and participation in Markdown, and what they mean."""
    if not modes:
        return "No pair is weakly damped and large enough to be called a mode."
    outputs = [f"y{i + 1} / µm" for i in range(modes[0].participation_um.size)]
    head = ["frequency / Hz", "damping / %", *outputs, "softening / %", "damping at the end / %", "gain change / %"]
    rows = [
        [
            f"{mode.frequency_hz[0]:.2f} ± {mode.frequency_half_hz[0]:.2g}",
            f"{100.0 * mode.damping[0]:.3f} ± {100.0 * mode.damping_half[0]:.2g}",
            *(f"{value:.3f}" for value in mode.participation_um),
            f"{-100.0 * mode.frequency_change:.3f} ± {100.0 * mode.frequency_change_half:.2g}",
            f"{100.0 * mode.damping[-1]:.3f} ± {100.0 * mode.damping_half[-1]:.2g}",
            f"{100.0 * mode.gain_change:+.1f}",
        ]
        for mode in modes
    ]
    several = modes[0].frequency_hz.size > 1
    columns = len(head) if several else len(head) - 3
    end = (
        " Frequency and damping are those at the smallest amplitude; softening is the fall of the frequency to the "
        "largest one, gain change that of the residues' norm."
    )
    return markdown(head[:columns], [row[:columns] for row in rows], left=()) + (
        "\n\n± is half of the 95 % interval. yN: the mode's rms contribution to an output for flat lines on all drives "
        f"at the middle amplitude; contributions of close modes overlap.{end * several}"
    )


def _changes(modes: Sequence[Mode], low_V: float, high_V: float) -> str:
    changing = sorted((mode for mode in modes if mode.finding != "steady"), key=lambda mode: -mode.error_share)
    steady = [f"{mode.frequency_hz[0]:.4g}" for mode in modes if mode.finding == "steady"]
    lines = [f"- {mode.sentence(low_V, high_V)}" for mode in changing]
    if steady:
        lines.append(f"- No measurable change: {_count(len(steady), 'mode')} at {', '.join(steady)} Hz.")
    return "\n".join(["## Change with the amplitude", "", *lines, "", CHANGES])


def _db(values: FloatArray) -> FloatArray:
    return np.asarray(20.0 * np.log10(np.maximum(values, 1e-12)), dtype=np.float64)


def draw_response(path: Path, study: ModalStudy) -> None:
    """Magnitude of each entry of the response matrix, measured at the smallest and largest amplitude, and the model."""
    model = study.fit.model
    outputs, drives = model.coefficients.shape[2:]
    ends = [study.levels[0]] if len(study.levels) == 1 else [study.levels[0], study.levels[-1]]
    drawn, grid = figure(
        outputs, drives, (3.6 * drives + 0.6, 2.3 * outputs + 0.9), "Response, measured and model", sharex=True
    )
    for level, colour, dark in zip(ends, (NOISE_BAND, SERIES[3]), (MEASURED, AFTER), strict=False):
        spectra = level.response.spectra
        computed = model.response(spectra.z, spectra.amplitude_V)
        for o in range(outputs):
            for j in range(drives):
                name = f"{spectra.amplitude_V:.3g} V"
                measured = _db(np.abs(level.response.g[:, o, j]))
                grid[o][j].plot(spectra.freq_hz, measured, ".", ms=1.5, color=colour, label=f"{name} measured")
                grid[o][j].plot(
                    spectra.freq_hz, _db(np.abs(computed[:, o, j])), color=dark, lw=0.7, label=f"{name} model"
                )
    for o in range(outputs):
        for j in range(drives):
            label(grid[o][j], "frequency / Hz" if o == outputs - 1 else "", f"y{o + 1}/u{j + 1} / dB(µm/V)")
    legend(grid[0][0], markerscale=6)
    save(drawn, path)


def draw_left(path: Path, study: ModalStudy) -> None:
    """Spectra of the output, of what the model leaves, of noise with distortion, and of the noise; by amplitude."""
    model = study.fit.model
    count = len(study.levels)
    drawn, grid = figure(count, 1, (9.0, 2.6 * count + 0.8), "What the model leaves, mean of the outputs", sharex=True)
    for level, axis in zip(study.levels, grid[:, 0], strict=True):
        spectra = level.response.spectra
        judged = spectra if level.test is None else level.test
        left = np.abs(judged.y - model.predict(judged)) ** 2
        f = judged.freq_hz
        curves = [
            (np.mean(np.abs(judged.y) ** 2, axis=2), f, MEASURED, "output"),
            (np.mean(left, axis=2), f, BEFORE, "left" if level.test is None else "left, held out"),
        ]
        if level.response.knows_distortion:
            curves.append((level.response.total, spectra.freq_hz, AFTER, "noise and distortion"))
        if np.isfinite(judged.noise).all():
            curves.append((judged.noise, f, NOISE_BAND, "noise, from periods"))
        for values, at, colour, name in curves:
            line(axis, at, 0.5 * _db(smoothed(values, 3).mean(axis=1)), color=colour, label=name)
        label(axis, "", "rms of a line / dB(µm)", f"{spectra.amplitude_V:.3g} V rms")
    grid[-1, 0].set_xlabel("frequency / Hz", fontsize=9)
    legend(grid[0, 0], ncols=4)
    save(drawn, path)
