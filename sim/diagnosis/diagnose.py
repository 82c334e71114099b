"""The diagnosis of one recording, from the calibrated nominal stage to the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.lssvm import one_thread
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.diagnosis.catalogue import CATALOGUE, Catalogue
from dehyst.sim.diagnosis.next_experiment import Rival, next_experiment
from dehyst.sim.diagnosis.nominal import (
    calibrate_nominal,
    fit_on_other_recording,
    with_nominal_kind,
    with_other_axis,
)
from dehyst.sim.diagnosis.prepare import Prepared
from dehyst.sim.diagnosis.result import FOLDS, TEST, Diagnosis, NamedCause
from dehyst.sim.diagnosis.search.held_out import HeldOut, split
from dehyst.sim.diagnosis.search.intervals import numbers, over_ties, parameter_errors
from dehyst.sim.diagnosis.search.search import Progress, ReviewedCause, Search, Thresholds, review
from dehyst.sim.diagnosis.unexplained import black_box_error, black_box_on_other, follows_drive, where_left
from dehyst.sim.diagnosis.witnesses import witnesses
from dehyst.sim.fitting.calibration import calibrate, with_new_columns
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import ModelFit
from dehyst.sim.readings.noise import (
    ConverterGrid,
    NoiseFloor,
    converter_grid,
    is_noise,
    noise_floor,
    reading_limits,
    recording_defects,
    repeated_readings,
)
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.sight import Sight
from dehyst.sim.stage.config import StageConfig


def _silent(stage: str, share: float) -> None:
    return None


def _forwards(progress: Progress) -> Progress:
    """The same progress, which stands still while the search starts again."""
    most = 0.0

    def told(stage: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        progress(stage, most)

    return told


@dataclass(frozen=True)
class Options:
    """How to diagnose. ``nominal``: "bouc_wen" (the chapter's stage), "linear", or the stage of a stage file;
    ``catalogue``: the effects that may be named."""

    nominal: str | StageConfig = "bouc_wen"
    seed: int = 0
    thresholds: Thresholds = field(default_factory=Thresholds)
    catalogue: Catalogue = CATALOGUE


def usable(data: FitData, mask: BoolArray, nominal: str | StageConfig = "bouc_wen") -> BoolArray:
    """The mask without readings at a limit of the sensor, beyond which nothing is known, and without the first samples,
    which depend on what the stage did before the recording.

    Raises InputError if fewer than 200 samples remain.
    """
    low_um, high_um = reading_limits(data)
    out = mask & (data.y_um > low_um) & (data.y_um < high_um)
    if not data.begins_at_rest and nominal == "bouc_wen":
        out[:1] = False  # The start is fitted here, and it determines the lags.
        return out
    out[: max(4, min(round(0.02 / data.dt_s), data.n // 20))] = False
    if int(out.sum()) < 200:
        raise InputError(f"recording: got {int(out.sum())} usable samples, expected at least 200; record longer")
    return out


def settled(mask: BoolArray, fit: ModelFit, data: FitData) -> BoolArray:
    """The mask without the time in which a linear stage's mode rings down to 0.1 %, at most 5 % of the recording.

    It only applies where the recording does not begin at rest: then the initial state of the mode is unknown.
    """
    if fit.model.nominal.name != "linear" or data.begins_at_rest:
        return mask
    slowest = min(
        (2.0 * np.pi * f * (z if z < 1.0 else 0.5 / z) for f, z in fit.model.dynamics(fit.p).modes_hz), default=np.inf
    )
    out = mask.copy()
    out[: min(int(np.log(1e3) / slowest / data.dt_s), data.n // 20)] = False
    return out


def without_start(mask: BoolArray, residual_um: FloatArray, dt_s: float) -> BoolArray:
    """The mask without the blocks of 10 ms at the start whose error exceeds any behind the first tenth of the record.

    What moved before the record (a mode that rings down, a lag that settles) ends, and no cause may be named for it.
    """
    block, tenth = max(4, round(0.01 / dt_s)), residual_um.size // 10
    error = np.where(mask, residual_um, 0.0)[: residual_um.size // block * block].reshape(-1, block)
    rms = np.sqrt(np.mean(np.square(error), axis=1))
    usual = _BEYOND * float(np.max(rms[tenth // block :], initial=0.0))
    large = np.flatnonzero(rms[: tenth // block] > usual)
    out = mask.copy()
    out[: (int(large[-1]) + 1) * block if large.size else 0] = False
    return out


def _behind_start(options: Options, fit: ModelFit, mask: BoolArray) -> tuple[ModelFit, BoolArray, tuple[str, ...]]:
    """The nominal stage, calibrated without a start that still settles; the mask without it, and what is said of it."""
    data = fit.model.data
    behind = without_start(mask, fit.residual_um, data.dt_s)
    if np.array_equal(behind, mask):
        return fit, mask, ()
    begin_s = float(np.flatnonzero(behind)[0]) * data.dt_s
    note = f"the first {begin_s:.3g} s are left out: the stage still settles from what was before the record"
    return calibrate_nominal(options.nominal, data, behind), behind, (note,)


def diagnose_prepared(
    prepared: Prepared,
    *,
    seed: int = 0,
    thresholds: Thresholds | None = None,
    progress: Progress = _silent,
    catalogue: Catalogue = CATALOGUE,
) -> Diagnosis:
    """Diagnose what `prepare` returned, with its nominal stage and its test recording."""
    options = Options(prepared.nominal, seed, thresholds or Thresholds(), catalogue)
    return diagnose(prepared.data, prepared.mask, options, progress, prepared.notes, prepared.dropped, prepared.test)


@one_thread
def diagnose(
    data: FitData,
    mask: BoolArray | None = None,
    options: Options | None = None,
    progress: Progress = _silent,
    notes: tuple[str, ...] = (),
    dropped: int = 0,
    test: Prepared | None = None,
) -> Diagnosis:
    """Calibrate the nominal stage, search for causes, review them, and derive the verdict.

    ``mask`` (n,) is False where a sample was filled in. ``dropped`` is the number of samples that are missing or
    doubled in the recorder's own time base; they are listed as a defect of the recording. ``test``: another recording
    of the stage; held-out errors and the verdict are then its own. Raises InputError if the recording cannot be
    diagnosed.
    """
    options, progress = options or Options(), _forwards(progress)
    mask = usable(data, np.ones(data.n, dtype=np.bool_) if mask is None else mask, options.nominal)
    data = with_nominal_kind(options.nominal, data)
    progress("calibrating the nominal stage", 0.02)
    nominal = calibrate_nominal(options.nominal, data, mask)
    nominal, mask, started = _behind_start(options, nominal, settled(mask, nominal, data))
    grid = converter_grid(data.y_um[mask])
    # A mode that the nominal stage has still rings in the rests of the readings, and less in what it leaves of them.
    floor = floor_beside(grid, noise_floor(data), noise_floor(data, nominal.residual_um))
    coarse = grid.step_um > 2.0 * floor.sigma_um
    nominal = with_other_axis(nominal, mask)
    data = nominal.model.data
    doubles = repeated_readings(data.y_um, floor.sigma_um, grid.step_um)
    if doubles.count >= 5 and doubles.probability > 2e-4:
        mask = mask.copy()
        mask[doubles.where.astype(np.int64)] = False
        nominal = calibrate(nominal.model, nominal.p, mask, 4, 1e-4)
    nominal = with_new_columns(nominal, mask)
    progress("testing the readings for signatures", 0.08)

    def search_above(floor: NoiseFloor) -> Search:
        readings = Readings(data, mask, floor.sigma_um)
        sights = witnesses(readings, options.catalogue)
        parts = split(data)
        known = (options.thresholds, options.seed, progress, coarse, readings, sights, options.catalogue)
        return Search(mask, parts, floor.sigma_um, *known)

    search = search_above(floor)
    held_nominal = search.held(nominal)
    extended, held, steps = search.run(nominal)
    quieter = floor_beside(grid, floor, noise_floor(data, extended.residual_um))
    if quieter.sigma_um < 0.5 * floor.sigma_um:
        # What was found (a mode that a payload has moved) rang in the rests, and small causes were lost in that.
        floor = quieter
        search = search_above(floor)
        extended, held, steps = search.run(nominal)
    progress("removing each cause once more", 0.85)
    extended, held, found = review(search, *search.fitted_again(extended, held), {s.name: s for s in steps})
    extended, held = search.fitted_again(extended, held)
    n = int(mask.sum())
    causes = named(search, extended, held, found)
    causes += in_readings(options.catalogue, extended, mask, floor)
    causes = tuple(sorted(causes, key=lambda c: -c.heldout_gain))
    progress("fitting a black box", 0.92)
    on_test: tuple[ModelFit, ModelFit] | None = None
    shown_mask, shown_floor_um, taught_um = mask, floor.sigma_um, None
    if test is None:
        held_um = (float(np.sqrt(held_nominal.sse_um2 / n)), float(np.sqrt(held.sse_um2 / n)))
        ceiling_um = black_box_error(nominal, extended, mask, search.parts)
    else:
        shown_mask = settled(usable(test.data, test.mask, options.nominal), nominal, test.data)
        there = fit_on_other_recording(nominal, test.data, shown_mask)
        shown_mask = without_start(shown_mask, there.residual_um, test.data.dt_s)
        on_test = (
            fit_on_other_recording(nominal, test.data, shown_mask),
            fit_on_other_recording(extended, test.data, shown_mask),
        )
        held_um = (rms_um(on_test[0], shown_mask), rms_um(on_test[1], shown_mask))
        ceiling_um = black_box_error(*on_test, shown_mask, split(test.data))
        # Where named physics does better than the black box, it is what the recording teaches.
        taught_um = min(black_box_on_other(nominal, on_test[0], mask, shown_mask, search.parts), *held_um)
        shown_floor_um = min(noise_floor(test.data).sigma_um, floor.sigma_um)
    explained = explained_share(*held_um, ceiling_um, shown_floor_um)
    shown = (on_test or (nominal, extended))[0]
    noise = leaves_noise(shown, shown_mask, floor.sigma_um)
    verdict = verdict_of(causes, *held_um, noise, floor.sigma_um, explained)
    partial: tuple[str, ...] = ()
    if verdict == "unexplained" and causes:
        partial, causes = tuple(c.name for c in causes if c.index >= 0), tuple(c for c in causes if c.index < 0)
        # What the readings themselves show (a coarse grid) stands, whatever else there is.
        verdict = "partly" if causes else verdict
    missing = not_excited(search, floor)
    progress("simulating the next experiment", 0.95)
    next_ = _next(search, extended, causes, found, verdict, missing)
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
        next_experiment=next_,
        nominal=nominal,
        extended=extended,
        notes=(*notes, *started),
        partial=partial,
        heldout_source=FOLDS if test is None else TEST,
        ceiling_um=ceiling_um,
        taught_um=taught_um,
        explained=explained,
        defects=recording_defects(doubles, floor.sigma_um, grid.step_um, dropped, data.n),
        left=where_left((on_test or (nominal, extended))[1], shown_mask, floor.sigma_um),
        uncertain=tuple(sorted(search.uncertain)),
        on_test=on_test,
        catalogue=options.catalogue,
    )


def _next(
    search: Search,
    extended: ModelFit,
    causes: tuple[NamedCause, ...],
    found: list[ReviewedCause],
    verdict: str,
    missing: tuple[str, ...],
) -> str | None:
    """The next experiment, for what this recording leaves open."""
    named = verdict in ("effects", "partly")
    rivals = [Rival(f.name, r.cause.name, extended, r.fit) for f in found for r in f.rivals if named]
    sets = [(c.name, *c.alternatives) for c in causes if c.alternatives]
    untested = tuple(c.name for c in causes if named and c.witness is not None and c.witness.seen is None)
    unexplained = verdict in ("partly", "unexplained")
    return next_experiment(rivals, sets, missing, untested, unexplained, extended, search.sigma_um, search.catalogue)


def floor_beside(grid: ConverterGrid, *floors: NoiseFloor) -> NoiseFloor:
    """The lowest of the noise floors, at least the rounding error of the converter grid."""
    lowest = min(floors, key=lambda floor: floor.sigma_um)
    return replace(lowest, sigma_um=max(lowest.sigma_um, grid.step_um / np.sqrt(12.0)))


def leaves_noise(fit: ModelFit, mask: BoolArray, floor_um: float) -> bool:
    """Whether the residual of ``fit`` has the spectrum of noise, and no response to the drive that stands above the
    floor: the spectrum of an error under a drive that is noise itself says nothing."""
    follows = follows_drive(fit, mask)
    return is_noise(fit.residual_um, mask) and (follows < IN_PART or follows * rms_um(fit, mask) ** 2 < floor_um**2)


def rms_um(fit: ModelFit, mask: BoolArray) -> float:
    """RMS residual (µm) over the samples that count."""
    return float(np.sqrt(np.mean(np.square(fit.residual_um[mask]))))


def named(search: Search, extended: ModelFit, held: HeldOut, found: list[ReviewedCause]) -> tuple[NamedCause, ...]:
    """The accepted causes with their numbers, and the share of the error that each removed when it was added."""
    causes = []
    errors = parameter_errors(extended, search.mask, search.parts, search.readings)
    ties = [rival.fit for one in found for rival in one.rivals]
    for i, one in enumerate(found):
        values, spans = numbers(errors, i)
        spans = over_ties(values, spans, one.name, ties)
        also = (*one.alternatives, *extended.model.causes[i].also(extended.model.data), *search.shown_as_well(one.name))
        # One voltage and one sensor show the sum of these: the other one of a set is always possible.
        also = tuple(dict.fromkeys((*also, *sorted(search.catalogue.same_set({one.name}) - {one.name}))))
        removed_um2 = one.held_without.sse_um2 - held.sse_um2
        instead = {r.cause.name: (one.held_without.sse_um2 - r.held.sse_um2) / removed_um2 for r in one.rivals}
        own = 1.0 - held.sse_um2 / one.held_without.sse_um2
        # A single cause's share is measured best by removing it from the final model.
        share = own if len(found) == 1 else one.step.gain
        p = one.step.p_value
        causes.append(
            NamedCause(
                one.name,
                also,
                values,
                spans,
                float(share),
                p,
                one.without.residual_um,
                extended.residual_um,
                i,
                search.sights.get(one.name),
                instead,
            )
        )
    return tuple(causes)


#: The error of a start is this many times that of any later block.
_BEYOND = 1.5
#: Share of the explainable squared error from which named causes explain a recording, or a part of it.
EXPLAINED, IN_PART = 0.8, 0.1
#: Largest error, in noise floors, that may be noise: slow noise is smaller within a rest than over the record.
MOST_NOISE = 10.0
#: Share of the held-out squared error that must go on a test recording for the causes to carry over.
CARRIES_OVER = 0.04


def explained_share(nominal_um: float, extended_um: float, ceiling_um: float, floor_um: float) -> float:
    """Share of the explainable squared error (nominal less the larger of noise floor and black box) that is explained.

    All are RMS errors in µm on data that were not fitted. 1 where the causes do as well as the black box.
    """
    reachable_um = max(floor_um, min(ceiling_um, extended_um))
    explainable_um2 = nominal_um**2 - reachable_um**2
    gained_um2 = nominal_um**2 - extended_um**2
    if explainable_um2 <= 0.0:
        return 0.0 if gained_um2 <= 0.0 else 1.0
    return float(min(gained_um2 / explainable_um2, 1.0))


def verdict_of(
    causes: tuple[NamedCause, ...],
    nominal_um: float,
    extended_um: float,
    noise: bool,
    floor_um: float,
    explained: float,
) -> str:
    """The verdict: "adequate", "effects", "partly" or "unexplained". Lengths are held-out RMS errors; ``noise``: the
    spectrum of what the nominal stage leaves is that of noise (`is_noise`), and it does not follow the drive."""
    structured = extended_um**2 > 1.5 * floor_um**2
    if causes:
        if any(c.index < 0 for c in causes) and not structured:
            return "effects"
        if extended_um**2 <= (1.0 - CARRIES_OVER) * nominal_um**2 or not structured:
            if explained >= EXPLAINED:
                return "effects"
            if explained >= IN_PART:
                return "partly"
        return "unexplained"
    # Noise of some colour may be above the noise within a rest, but not far.
    return "adequate" if not structured or (noise and nominal_um <= MOST_NOISE * floor_um) else "unexplained"


def not_excited(search: Search, floor: NoiseFloor) -> tuple[str, ...]:
    """Names of the causes that, at their usual size, would change this recording by less than five standard errors."""
    seen = {
        search.causes[look.index].name for look in search.first_looks if look.size_um2 > (5.0 * floor.sigma_um) ** 2
    }
    return tuple(name for name, cause in search.catalogue.causes.items() if cause.forms and name not in seen)


def in_readings(catalogue: Catalogue, extended: ModelFit, mask: BoolArray, floor: NoiseFloor) -> tuple[NamedCause, ...]:
    """The causes that the readings show without a fit, such as a coarse grid, and that no fit has found."""
    flat, out = extended.residual_um, list[NamedCause]()
    for name, cause in catalogue.causes.items():
        if cause.in_readings is None or any(name == fitted.name for fitted in extended.model.causes):
            continue
        found = cause.in_readings.find(extended.model.data, flat, mask, floor.sigma_um)
        if found is not None:
            sight = Sight(True, found.words)
            out.append(
                NamedCause(name, (), found.parameters, found.intervals, found.share, 0.001, flat, flat, -1, sight)
            )
    return tuple(out)
