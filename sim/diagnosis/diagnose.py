"""The diagnosis of one recording, from the calibrated nominal stage to the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adaptive.errors import InputError
from adaptive.types import BoolArray
from sim.diagnosis.causes.catalogue import NAMES
from sim.diagnosis.model.calibration import (
    ModelFit,
    begins_at_rest,
    calibrate,
    calibrate_nominal,
    with_new_columns,
    with_nominal_kind,
    with_other_axis,
)
from sim.diagnosis.model.fit_data import FitData
from sim.diagnosis.model.readings import (
    ConverterGrid,
    NoiseFloor,
    RepeatedReadings,
    converter_grid,
    noise_floor,
    repeated_readings,
)
from sim.diagnosis.next_experiment import Rival, next_experiment
from sim.diagnosis.prepare import Prepared
from sim.diagnosis.result import FOLDS, TEST, Diagnosis, NamedCause
from sim.diagnosis.search.held_out import HeldOut, error_on_other_recording, split
from sim.diagnosis.search.search import Progress, ReviewedCause, Search, Thresholds, review
from sim.stage.config import StageConfig


def _silent(stage: str, share: float) -> None:
    return None


@dataclass(frozen=True)
class Options:
    """How to diagnose. ``nominal``: "bouc_wen" (the chapter's stage), "linear", or the stage of a stage file."""

    nominal: str | StageConfig = "bouc_wen"
    seed: int = 0
    thresholds: Thresholds = field(default_factory=Thresholds)


def usable(data: FitData, mask: BoolArray, nominal: str | StageConfig = "bouc_wen") -> BoolArray:
    """The mask without the first samples, which depend on what the stage did before the recording.

    Raises InputError if fewer than 200 samples remain.
    """
    out = mask.copy()
    if not begins_at_rest(data) and nominal == "bouc_wen":
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
    if fit.model.nominal.name != "linear" or begins_at_rest(data):
        return mask
    slowest = min(
        (2.0 * np.pi * f * (z if z < 1.0 else 0.5 / z) for f, z in fit.model.dynamics(fit.p).modes_hz), default=np.inf
    )
    out = mask.copy()
    out[: min(int(np.log(1e3) / slowest / data.dt_s), data.n // 20)] = False
    return out


def diagnose_prepared(
    prepared: Prepared, *, seed: int = 0, thresholds: Thresholds | None = None, progress: Progress = _silent
) -> Diagnosis:
    """Diagnose what `prepare` returned, with its nominal stage and its test recording."""
    options = Options(prepared.nominal, seed, thresholds or Thresholds())
    return diagnose(prepared.data, prepared.mask, options, progress, prepared.notes, prepared.dropped, prepared.test)


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
    doubled in the recorder's own time base; any is reported as a cause "timing". ``test``: another recording of the
    stage; held-out errors are then measured on it and not by folds. Raises InputError if the recording cannot be
    diagnosed.
    """
    options = options or Options()
    mask = usable(data, np.ones(data.n, dtype=np.bool_) if mask is None else mask, options.nominal)
    data = with_nominal_kind(options.nominal, data)
    grid = converter_grid(data.y_um[mask])
    floor = noise_floor(data)
    coarse = grid.step_um > 2.0 * floor.sigma_um
    floor = NoiseFloor(max(floor.sigma_um, grid.step_um / np.sqrt(12.0)), floor.source)
    progress("calibrating the nominal stage", 0.02)
    nominal = calibrate_nominal(options.nominal, data, mask)
    mask = settled(mask, nominal, data)
    nominal = with_other_axis(nominal, mask)
    data = nominal.model.data
    doubles = repeated_readings(data.y_um, floor.sigma_um, grid.step_um)
    doubled = doubles.count >= 5 and doubles.probability > 2e-4
    if doubled:
        mask = mask.copy()
        mask[doubles.where.astype(np.int64)] = False
        nominal = calibrate(nominal.model, nominal.p, mask, 4, 1e-4)
    nominal = with_new_columns(nominal, mask)
    search = Search(mask, split(data), floor.sigma_um, options.thresholds, options.seed, progress, coarse)
    held_nominal = search.held(nominal)
    extended, held, steps = search.run(nominal)
    progress("removing each cause once more", 0.85)
    extended, held, found = review(search, *search.with_refitted_slips(extended, held), {s.name: s for s in steps})
    extended, held = search.with_refitted_slips(extended, held)
    n = int(mask.sum())
    causes = named(search, nominal, extended, held, found)
    causes += converter_causes(data, grid, doubles if doubled else None, floor, extended, n, dropped)
    causes = tuple(sorted(causes, key=lambda c: -c.heldout_gain))
    verdict = verdict_of(causes, held_nominal, held, floor, n)
    partial: tuple[str, ...] = ()
    if verdict == "unexplained" and causes:
        partial, causes = tuple(c.name for c in causes), ()
    missing = not_excited(search, nominal, extended, floor)
    progress("simulating the next experiment", 0.95)
    open_ = [Rival(f.name, r.cause.name, extended, r.fit) for f in found for r in f.rivals if verdict == "effects"]
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


def _on_test(test: Prepared, options: Options, fits: tuple[ModelFit, ModelFit]) -> tuple[float, float]:
    """Free-run errors (RMS, µm) of the nominal and of the extended stage on the test recording."""
    mask = settled(usable(test.data, test.mask, options.nominal), fits[0], test.data)
    parts = split(test.data)
    one, two = (error_on_other_recording(fit, test.data, mask, parts).sse_um2 / int(mask.sum()) for fit in fits)
    return float(np.sqrt(one)), float(np.sqrt(two))


def named(
    search: Search, nominal: ModelFit, extended: ModelFit, held: HeldOut, found: list[ReviewedCause]
) -> tuple[NamedCause, ...]:
    """The accepted causes with their numbers, and the share of the error that each removed when it was added."""
    causes = []
    for i, one in enumerate(found):
        values, spans = numbers(extended, i, search)
        also = one.alternatives
        if one.name == "resonance" and nominal.model.nominal.name != "linear":
            # The nominal stage has no such mode: it may be the stage's own, or a known one moved by a payload.
            also = (*also, "payload_change")
        own = 1.0 - held.sse_um2 / one.held_without.sse_um2
        # A single cause's share is measured best by removing it from the final model.
        share = own if len(found) == 1 else one.step.gain
        p = one.step.p_value
        causes.append(
            NamedCause(one.name, also, values, spans, float(share), p, one.without.residual_um, extended.residual_um, i)
        )
    return tuple(causes)


def numbers(fit: ModelFit, index: int, search: Search) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """The reported numbers of one cause with 95 % intervals.

    The covariance is estimated from sums over blocks, so correlated errors are allowed for.
    """
    parameters = fit.model.parameters
    free = [i for i in fit.free if parameters[i].low < fit.p[i] < parameters[i].high]
    scale = np.array([parameters[i].step for i in free])
    rows = fit.model.jacobian(fit.p, fit.signals, free) * scale[:, None] * search.mask
    bread = np.linalg.pinv(rows @ rows.T, rcond=1e-12)
    scores = search.parts.blocks(rows * fit.residual_um)
    cover = bread @ (scores @ scores.T) @ bread * scale[:, None] * scale[None, :]
    where = fit.model.slice_of(index)
    at = {j: row for row, j in enumerate(free)}
    values: dict[str, float] = {}
    spans: dict[str, tuple[float, float]] = {}
    for name, (value, gradient) in (
        fit.model.causes[index].reported(fit.model.parameters_of(fit.p, index), fit.model.data).items()
    ):
        g = np.zeros(len(free))
        for k, slope in enumerate(gradient):
            if where.start + k in at:
                g[at[where.start + k]] = slope
        half = 1.96 * float(np.sqrt(max(float(g @ cover @ g), 0.0)))
        values[name] = value
        spans[name] = (value - half, value + half)
    return values, spans


def verdict_of(causes: tuple[NamedCause, ...], nominal: HeldOut, extended: HeldOut, floor: NoiseFloor, n: int) -> str:
    """The verdict: "adequate", "effects" or "unexplained"."""
    base = n * floor.sigma_um**2
    left, first = extended.sse_um2 - base, nominal.sse_um2 - base
    structured = left > 0.5 * base
    if causes and (not structured or left < 0.6 * first or any(c.index < 0 for c in causes)):
        return "effects"
    return "unexplained" if structured else "adequate"


def not_excited(search: Search, nominal: ModelFit, extended: ModelFit, floor: NoiseFloor) -> tuple[str, ...]:
    """Names of the causes that, at their usual size, would change this recording by less than five standard errors."""
    seen = {
        search.causes[look.index].name: True
        for look in search.first_looks
        if look.size_um2 > (5.0 * floor.sigma_um) ** 2
    }
    seen.setdefault("quantisation", True)
    return tuple(name for name in NAMES if not seen.get(name, False))


def converter_causes(
    data: FitData,
    grid: ConverterGrid,
    doubles: RepeatedReadings | None,
    floor: NoiseFloor,
    extended: ModelFit,
    n: int,
    dropped: int,
) -> tuple[NamedCause, ...]:
    """Quantisation and timing, as far as they are seen in the readings themselves and not fitted."""
    out: list[NamedCause] = []
    flat = extended.residual_um
    if grid.step_um > 0.0:
        own = grid.step_um**2 / 12.0
        share = own / max(extended.sse_um2 / n, own)
        if grid.step_um > 1.2 * floor.sigma_um and share > 0.2:
            step = grid.step_um
            rounding = 1e-3 * step
            values, spans = {"step_um": step}, {"step_um": (step - rounding, step + rounding)}
            out.append(NamedCause("quantisation", (), values, spans, share, 0.001, flat, flat))
    if doubles is not None:
        p = doubles.probability
        half = 1.96 * float(np.sqrt(p * (1.0 - p) / max(1, doubles.of)))
        values, spans = {"repeat_probability": p}, {"repeat_probability": (max(0.0, p - half), p + half)}
        out.append(NamedCause("timing", (), values, spans, 0.0, 0.001, flat, flat))
    elif dropped > 0:
        share = dropped / data.n
        values, spans = {"lost_samples": float(dropped)}, {"lost_samples": (float(dropped), float(dropped))}
        out.append(NamedCause("timing", (), values, spans, share, 0.001, flat, flat))
    names = {f.name for f in extended.model.causes}
    return tuple(c for c in out if c.name not in names)
