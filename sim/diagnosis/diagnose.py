"""The diagnosis of one recording, from the calibrated nominal stage to the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adaptive.errors import InputError
from adaptive.types import BoolArray
from sim.diagnosis.experiments import Rival, next_experiment
from sim.diagnosis.model.converter import converter_causes, grid_of, repeats
from sim.diagnosis.model.fit import Fit, calibrate, refreshed
from sim.diagnosis.model.measured import Setting
from sim.diagnosis.model.nominal_fit import begins_at_rest, calibrated, nominal_setting, with_other_axis
from sim.diagnosis.prepare import Prepared
from sim.diagnosis.report.naming import named, not_excited, verdict_of
from sim.diagnosis.report.result import FOLDS, TEST, Diagnosis
from sim.diagnosis.search.evidence import split
from sim.diagnosis.search.noise_floor import Floor, noise_floor
from sim.diagnosis.search.search import Progress, Search, review
from sim.diagnosis.search.second_recording import second_error
from sim.diagnosis.search.thresholds import Rules
from sim.stage.config import StageConfig


def _silent(stage: str, share: float) -> None:
    return None


@dataclass(frozen=True)
class Options:
    """How to diagnose. ``nominal``: ``bouc_wen`` (the chapter's stage), ``linear``, or the stage of a stage file."""

    nominal: str | StageConfig = "bouc_wen"
    seed: int = 0
    rules: Rules = field(default_factory=Rules)


def usable(setting: Setting, mask: BoolArray, nominal: str | StageConfig = "bouc_wen") -> BoolArray:
    """The mask less the first moments, in which only the unknown past of the stage shows."""
    out = mask.copy()
    if not begins_at_rest(setting) and nominal == "bouc_wen":
        out[:1] = False  # its start is fitted, and tells the lags
        return out
    out[: max(4, min(round(0.02 / setting.dt_s), setting.n // 20))] = False
    if int(out.sum()) < 200:
        raise InputError(f"recording: got {int(out.sum())} usable samples, expected at least 200; record longer")
    return out


def settled(mask: BoolArray, fit: Fit, setting: Setting) -> BoolArray:
    """The mask of a recording of ``setting`` less the time in which a linear stage's mode rings down to a thousandth,
    at most a twentieth of it: what the stage did before is not known, where the recording does not begin at rest."""
    if fit.model.nominal.name != "linear" or begins_at_rest(setting):
        return mask
    slowest = min(
        (2.0 * np.pi * f * (z if z < 1.0 else 0.5 / z) for f, z in fit.model.dynamics(fit.p).modes_hz), default=np.inf
    )
    out = mask.copy()
    out[: min(int(np.log(1e3) / slowest / setting.dt_s), setting.n // 20)] = False
    return out


def diagnose_prepared(
    prepared: Prepared, *, seed: int = 0, rules: Rules | None = None, progress: Progress = _silent
) -> Diagnosis:
    """The whole diagnosis of what `prepare` gave, with its nominal stage and its test recording."""
    options = Options(prepared.nominal, seed, rules or Rules())
    return diagnose(prepared.setting, prepared.mask, options, progress, prepared.notes, prepared.dropped, prepared.test)


def diagnose(
    setting: Setting,
    mask: BoolArray | None = None,
    options: Options | None = None,
    progress: Progress = _silent,
    notes: tuple[str, ...] = (),
    dropped: int = 0,
    test: Prepared | None = None,
) -> Diagnosis:
    """Calibrate, search, remove once more, and say what is there, what is not, and what cannot be told.

    ``mask`` (n,) is False where a sample was filled in; ``dropped`` is how many were missing or doubled in the
    recorder's own time base, which is a finding about timing whatever else there is. ``test``: another recording, on
    which the held-out errors are taken in place of the folds of this one. Raises InputError where the record cannot
    be diagnosed at all.
    """
    options = options or Options()
    mask = usable(setting, np.ones(setting.n, dtype=np.bool_) if mask is None else mask, options.nominal)
    setting = nominal_setting(options.nominal, setting)
    grid = grid_of(setting.y_um[mask])
    floor = noise_floor(setting)
    coarse = grid.step_um > 2.0 * floor.sigma_um
    floor = Floor(max(floor.sigma_um, grid.step_um / np.sqrt(12.0)), floor.source)
    progress("calibrating the nominal stage", 0.02)
    nominal = calibrated(options.nominal, setting, mask)
    mask = settled(mask, nominal, setting)
    nominal = with_other_axis(nominal, mask)
    setting = nominal.model.setting
    doubles = repeats(setting.y_um, floor.sigma_um, grid.step_um)
    doubled = doubles.count >= 5 and doubles.probability > 2e-4
    if doubled:
        mask = mask.copy()
        mask[doubles.where.astype(np.int64)] = False
        nominal = calibrate(nominal.model, nominal.p, mask, 4, 1e-4)
    nominal = refreshed(nominal, mask)
    search = Search(mask, split(setting), floor.sigma_um, options.rules, options.seed, progress, coarse)
    held_nominal = search.held(nominal)
    extended, held, steps = search.run(nominal)
    progress("removing each cause once more", 0.85)
    extended, held, found = review(search, *search.redated(extended, held), {s.name: s for s in steps})
    extended, held = search.redated(extended, held)
    n = int(mask.sum())
    causes = named(search, nominal, extended, held, found)
    causes += converter_causes(setting, grid, doubles if doubled else None, floor, extended, n, dropped)
    causes = tuple(sorted(causes, key=lambda c: -c.heldout_gain))
    verdict = verdict_of(causes, held_nominal, held, floor, n)
    partial: tuple[str, ...] = ()
    if verdict == "unexplained" and causes:
        partial, causes = tuple(c.name for c in causes), ()
    missing = not_excited(search, nominal, extended, floor)
    progress("simulating the next experiment", 0.95)
    open_ = [Rival(f.name, r.form.name, extended, r.fit) for f in found for r in f.rivals if verdict == "effects"]
    held_um = (float(np.sqrt(held_nominal.sse_um2 / n)), float(np.sqrt(held.sse_um2 / n)))
    if test is not None:
        held_um = _on_test(test, options, (nominal, extended))
    return Diagnosis(
        verdict=verdict,
        nominal_rmse_um=float(np.sqrt(nominal.sse_um2 / n)),
        nominal_heldout_um=held_um[0],
        extended_rmse_um=float(np.sqrt(extended.sse_um2 / n)),
        extended_heldout_um=held_um[1],
        noise_floor_um=floor.sigma_um,
        floor_source=floor.source,
        causes=causes,
        not_excited=missing,
        next_experiment=next_experiment(open_, missing, extended, floor.sigma_um),
        nominal=nominal,
        extended=extended,
        notes=notes,
        partial=partial,
        heldout_source=FOLDS if test is None else TEST,
    )


def _on_test(test: Prepared, options: Options, fits: tuple[Fit, Fit]) -> tuple[float, float]:
    """Free-run errors (rms, µm) of the nominal and of the extended stage on the test recording."""
    mask = settled(usable(test.setting, test.mask, options.nominal), fits[0], test.setting)
    parts = split(test.setting)
    one, two = (second_error(fit, test.setting, mask, parts).sse_um2 / int(mask.sum()) for fit in fits)
    return float(np.sqrt(one)), float(np.sqrt(two))
