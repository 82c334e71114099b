"""The next experiment: of a few simple drives, the one that separates rival causes best in a simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.catalogue import Catalogue
from dehyst.sim.diagnosis.witnesses import witnesses
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import CauseModel, ModelFit, StageModel
from dehyst.sim.readings.readings import Readings

#: Resolution of a voltage monitor relative to the swing.
MONITOR_NOISE = 2e-4
RATES = "triangles and sines at three rates over two decades and at two amplitudes"


@dataclass(frozen=True)
class Experiment:
    """A drive of the length and swing of the recording: a description and its voltages (n,)."""

    words: str
    u_V: FloatArray
    u2_V: FloatArray


@dataclass(frozen=True)
class Rival:
    """Two fitted causes that explain one recording equally well."""

    name: str
    other: str
    mine: ModelFit
    theirs: ModelFit


def experiments(data: FitData) -> list[Experiment]:
    """Drives between the lowest and highest voltage of the recording, with as many samples."""
    n, dt, low, swing = data.n, data.dt_s, data.u_low_V, data.swing_V
    t, total, zero = data.t_s, data.duration_s, np.zeros(data.n)
    x = t / total
    triangle = 1.0 - np.abs(2.0 * np.mod(x * 3.0, 1.0) - 1.0)
    fast = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.minimum(20.0, 0.02 / dt) * t)
    medium = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.minimum(2.0, 0.002 / dt) * t)
    levels = np.array([0.0, 0.5, 1.0, 0.25, 0.0])
    short = np.array([0.0, 1.0, 0.2, 0.8, 0.4, 0.6, 0.0])
    every = max(4, round(0.4 / dt))
    top = 0.3 / dt
    sweep = np.sin(2.0 * np.pi * (0.5 * t + (top - 0.5) / (2.0 * total) * t * t))
    nested = np.interp(x, np.linspace(0.0, 1.0, 12), [0, 1, 0.1, 0.9, 0.2, 0.8, 0.3, 0.7, 0.4, 0.6, 0.5, 0])
    rates = np.where(x < 0.4, triangle, np.where(x < 0.7, medium, fast)) * np.where(np.mod(x, 0.3) < 0.15, 1.0, 0.4)
    shapes = [
        (f"steps to four levels, each held for {total / 5.0:.3g} s", levels[np.minimum((x * 5.0).astype(int), 4)]),
        ("full steps every 0.4 s", short[(np.arange(n) // every) % 7]),
        (RATES, rates),
        ("nested triangles, every loop inside the one before", nested),
        (f"a small chirp of 5 % of the range up to {top:.3g} Hz", 0.5 + 0.025 * sweep),
    ]
    out = [Experiment(words, np.ascontiguousarray(low + swing * s), zero) for words, s in shapes]
    out.append(Experiment("the same record once more after a minute at zero input", data.u_V, zero))
    if data.u2_V is None and data.y2_um is None:
        # Nothing says that this rig has another axis.
        return out
    out.append(Experiment("the other axis driven alone over its range, this one at zero", zero, low + swing * medium))
    return out


def _at(model: StageModel, p: FloatArray, experiment: Experiment) -> FloatArray:
    home = model.data
    data = replace(home, u_V=experiment.u_V, u2_V=experiment.u2_V, scales_from=home.scales)
    if np.any(experiment.u2_V):
        other = home.gain_um_per_V * (experiment.u2_V - experiment.u2_V[0])
        data = replace(data, other_um=other, other_um_per_s=np.gradient(other, data.dt_s))
    return StageModel(data, model.nominal, model.causes).simulate(p).reading_um


def next_experiment(
    rivals: list[Rival],
    sets: list[tuple[str, ...]],
    missing: tuple[str, ...],
    untested: tuple[str, ...],
    unexplained: bool,
    fit: ModelFit,
    sigma_um: float,
    catalogue: Catalogue,
) -> str | None:
    """What to record next, as a sentence with the simulated difference; None if nothing is open.

    ``sets``: named causes with their alternatives; ``unexplained``: a part of the error has no name; ``missing``: names
    of the causes that the recording does not excite; ``untested``: those of named causes whose
    direct test it does not excite.
    """
    data = fit.model.data
    if rivals:
        rival = rivals[0]
        here = _apart(rival.mine.signals.reading_um, rival.theirs.signals.reading_um)
        best, size = "", 0.0
        for experiment in experiments(data):
            both = [_at(f.model, f.p, experiment) for f in (rival.mine, rival.theirs)]
            apart = _apart(both[0], both[1])
            if np.isfinite(apart) and apart > size:
                best, size = experiment.words, apart
        drive = _apart(rival.mine.drive_at_samples(), rival.theirs.drive_at_samples()) / max(data.swing_V, 1e-12)
        if drive / MONITOR_NOISE > size / sigma_um:
            return (
                f"the same record with a voltage monitor at the actuator (monitor_V): simulated, {rival.name} and "
                f"{rival.other} then differ there by {drive * data.swing_V * 1e3:.3g} mV rms"
            )
        if size < 2.0 * max(here, 0.2 * sigma_um):
            return (
                f"{best or RATES}: {rival.name} and {rival.other} then differ most, simulated {size * 1e3:.2g} nm rms. "
                "No drive of this stage separates them; a second sensor, a voltage monitor or a temperature log would"
            )
        return (
            f"{best}: simulated, {rival.name} and {rival.other} then differ by {size * 1e3:.3g} nm rms "
            f"({size / sigma_um:.2g} times the noise), against {here * 1e3:.2g} nm in this record"
        )
    if unexplained:
        return f"{RATES}, with rests between them: what is left then shows whether it goes with rate, height or time"
    shown = _excite([f for f in catalogue.forms if f.name in missing], fit, sigma_um)
    shown = shown or (_test(untested, fit, sigma_um, catalogue) if untested else None)
    if shown or not sets:
        return shown
    (name, other, *_), hint = sets[0], catalogue.kind(sets[0][0]).tells_apart
    return f"no drive of this stage separates {name} from {other}, but: {hint}"


def _apart(a: FloatArray, b: FloatArray) -> float:
    """RMS difference without a common offset."""
    d = a - b
    return float(np.std(d))


def _excite(missing: list[CauseModel], fit: ModelFit, sigma_um: float) -> str | None:
    """The drive that shows most of the causes that this recording does not excite, as a sentence."""
    wanted = [f for f in missing if f.shown_by_a_drive]
    best: tuple[str, list[str]] = ("", [])
    for experiment in experiments(fit.model.data):
        base, data = _at(fit.model, fit.p, experiment), fit.model.data
        there = replace(data, u_V=experiment.u_V, scales_from=data.scales)
        names: list[str] = []
        for cause in wanted:
            crossing = cause.of_other_axis and bool(np.any(experiment.u2_V))
            if cause.missing(there) and not crossing:
                continue
            model = fit.model.with_cause(cause)
            for trial in cause.guesses(data, fit.residual_um)[:3]:
                moved = _at(model, np.concatenate([fit.p, trial[0]]), experiment)
                if np.all(np.isfinite(moved)) and np.std(moved - base) * np.sqrt(data.n) > 30.0 * sigma_um:
                    names.append(cause.name)
                    break
        if len(set(names)) > len(set(best[1])):
            best = (experiment.words, sorted(set(names)))
    if not best[1]:
        return None
    return f"{best[0]}: simulated, it would show {', '.join(best[1])}, which this record does not excite"


def _test(untested: tuple[str, ...], fit: ModelFit, sigma_um: float, catalogue: Catalogue) -> str | None:
    """The drive under which direct tests see most of the named causes that only the fit names, as a sentence.

    A test counts that sees the cause in the simulation with it, and not in the one without it.
    """
    best: tuple[str, list[str]] = ("", [])
    for experiment in experiments(fit.model.data):
        names = [name for name in untested if name in _seen(fit.model, fit.p, experiment, sigma_um, catalogue)]
        if len(names) <= len(best[1]):
            continue
        for i, cause in enumerate(fit.model.causes):
            if cause.name in names:
                where = fit.model.slice_of(i)
                p = np.concatenate([fit.p[: where.start], fit.p[where.stop :]])
                if cause.name in _seen(fit.model.without_cause(i), p, experiment, sigma_um, catalogue):
                    names.remove(cause.name)
        if len(names) > len(best[1]):
            best = (experiment.words, names)
    if not best[1]:
        return None
    return (
        f"{best[0]}: simulated, direct tests of the readings then see {', '.join(best[1])}, which in this record only "
        "the fit names"
    )


def _seen(model: StageModel, p: FloatArray, experiment: Experiment, sigma_um: float, catalogue: Catalogue) -> set[str]:
    """The causes that direct tests see in simulated readings with white noise."""
    home = model.data
    reading_um = _at(model, p, experiment) + sigma_um * np.random.default_rng(0).standard_normal(home.n)
    if not np.all(np.isfinite(reading_um)):
        return set()
    data = FitData(home.dt_s, experiment.u_V, reading_um, known_modes_hz=home.known_modes_hz, has_lag=home.has_lag)
    sights = witnesses(Readings(data, np.ones(data.n, dtype=np.bool_), sigma_um), catalogue)
    return {name for name, sight in sights.items() if sight.seen}
