"""The diagnosis of one recording, from the calibrated nominal stage to the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from adaptive.errors import InputError
from adaptive.types import BoolArray
from sim.diagnosis.catalogue import NAMES
from sim.diagnosis.converter import Grid, Repeats, grid_of, repeats
from sim.diagnosis.evidence import HeldOut, split, worse_by
from sim.diagnosis.experiments import Rival, next_experiment
from sim.diagnosis.fit import Fit, calibrate
from sim.diagnosis.noise import Floor, noise_floor
from sim.diagnosis.nominal_fit import begins_at_rest, calibrated, with_other_axis
from sim.diagnosis.result import Cause, Diagnosis
from sim.diagnosis.search import Candidate, Progress, Rules, Search, Step
from sim.diagnosis.setting import Setting


def _silent(stage: str, share: float) -> None:
    return None


@dataclass(frozen=True)
class Options:
    """How to diagnose. ``nominal``: ``bouc_wen`` (the chapter's stage) or ``linear``."""

    nominal: str = "bouc_wen"
    seed: int = 0
    rules: Rules = field(default_factory=Rules)


@dataclass(frozen=True)
class _Found:
    """An accepted cause while alternatives are still sought."""

    step: Step
    without: Fit
    held_without: HeldOut
    rivals: tuple[Candidate, ...] = ()

    @property
    def name(self) -> str:
        return self.step.name

    @property
    def alternatives(self) -> tuple[str, ...]:
        return tuple(r.form.name for r in self.rivals)


def usable(setting: Setting, mask: BoolArray, nominal: str = "bouc_wen") -> BoolArray:
    """The mask less the first moments, in which only the unknown past of the stage shows."""
    out = mask.copy()
    if not begins_at_rest(setting) and nominal == "bouc_wen":
        out[:1] = False  # its start is fitted, and tells the lags
        return out
    out[: max(4, min(round(0.02 / setting.dt_s), setting.n // 20))] = False
    if int(out.sum()) < 200:
        raise InputError(f"recording: got {int(out.sum())} usable samples, expected at least 200; record longer")
    return out


def diagnose(
    setting: Setting,
    mask: BoolArray | None = None,
    options: Options | None = None,
    progress: Progress = _silent,
    notes: tuple[str, ...] = (),
    dropped: int = 0,
) -> Diagnosis:
    """Calibrate, search, remove once more, and say what is there, what is not, and what cannot be told.

    ``mask`` (n,) is False where a sample was filled in; ``dropped`` is how many were missing or doubled in the
    recorder's own time base, which is a finding about timing whatever else there is. Raises InputError where the
    record cannot be diagnosed at all.
    """
    options = options or Options()
    mask = usable(setting, np.ones(setting.n, dtype=np.bool_) if mask is None else mask, options.nominal)
    setting = replace(setting, input_is_linear=options.nominal == "linear")
    grid = grid_of(setting.y_um[mask])
    floor = noise_floor(setting)
    coarse = grid.step_um > 2.0 * floor.sigma_um
    floor = Floor(max(floor.sigma_um, grid.step_um / np.sqrt(12.0)), floor.source)
    progress("calibrating the nominal stage", 0.02)
    nominal = with_other_axis(calibrated(options.nominal, setting, mask), mask)
    setting = nominal.model.setting
    parts = split(setting)
    doubles = repeats(setting.y_um, floor.sigma_um, grid.step_um)
    doubled = doubles.count >= 5 and doubles.probability > 2e-4
    if doubled:
        mask = mask.copy()
        mask[doubles.where.astype(np.int64)] = False
        nominal = calibrate(nominal.model, nominal.p, mask, 4, 1e-4)
    search = Search(mask, parts, floor.sigma_um, options.rules, options.seed, progress, coarse)
    held_nominal = search.held(nominal)
    extended, held, steps = search.run(nominal)
    by_name = {s.name: s for s in steps}
    progress("removing each cause once more", 0.85)
    extended, held, found = _review(search, extended, held, by_name)
    n = int(mask.sum())
    causes = _named(search, nominal, extended, held, found)
    causes += _converter_causes(setting, grid, doubles if doubled else None, floor, extended, n, dropped)
    causes = tuple(sorted(causes, key=lambda c: -c.heldout_gain))
    verdict = _verdict(causes, held_nominal, held, floor, n)
    partial: tuple[str, ...] = ()
    if verdict == "unexplained" and causes:
        partial, causes = tuple(c.name for c in causes), ()
    missing = not_excited(search, nominal, extended, floor)
    progress("simulating the next experiment", 0.95)
    open_ = [Rival(f.name, r.form.name, extended, r.fit) for f in found for r in f.rivals if verdict == "effects"]
    return Diagnosis(
        verdict=verdict,
        nominal_rmse_um=float(np.sqrt(nominal.sse_um2 / n)),
        nominal_heldout_um=float(np.sqrt(held_nominal.sse_um2 / n)),
        extended_rmse_um=float(np.sqrt(extended.sse_um2 / n)),
        extended_heldout_um=float(np.sqrt(held.sse_um2 / n)),
        noise_floor_um=floor.sigma_um,
        floor_source=floor.source,
        causes=causes,
        not_excited=missing,
        next_experiment=next_experiment(open_, missing, extended, floor.sigma_um),
        nominal=nominal,
        extended=extended,
        notes=notes,
        partial=partial,
    )


def _review(search: Search, fit: Fit, held: HeldOut, steps: dict[str, Step]) -> tuple[Fit, HeldOut, list[_Found]]:
    """Remove each cause once more: drop what has become idle, swap what another explains better, name rivals."""
    rules = search.rules
    found: list[_Found] = []
    index = swaps = 0
    while index < len(fit.model.forms):
        form = fit.model.forms[index]
        less = search.without(fit, index)
        held_less = search.held(less)
        gain = held_less.sse_um2 - held.sse_um2
        keep = rules.least_gain if form.name != "mains_hum" else 0.0
        if gain <= keep * held_less.sse_um2:
            fit, held = less, held_less
            found, index = [], 0
            continue
        looks, _ = search.looks(less, {f.name for f in less.model.forms} | {form.name})
        rivals = search.refit(less, looks, 4, 0.5 * gain)
        cost = search.cost(fit, held, less)
        polished = (search.polish(c, less) for c in rivals[:2])
        swap = next((c for c in polished if c.cost < 0.9 * cost), None)
        if swap is not None and swaps < 2 and swap.form.name not in steps and search.plausible(swap):
            swaps += 1
            before = steps[form.name]
            steps[swap.form.name] = Step(swap.form.name, before.p_value, before.gain)
            fit, held = swap.fit, swap.held
            found, index = [], 0
            continue
        # Where the voltage was monitored, a rival must agree with that as well.
        rivals = [r for r in rivals if r.cost - r.held.sse_um2 <= 1.2 * (cost - held.sse_um2) + 0.05 * gain]
        names = _rivals(search, rivals, held, gain, held_less)
        found.append(_Found(steps[form.name], less, held_less, names))
        index += 1
    return fit, held, found


def _rivals(
    search: Search, rivals: list[Candidate], held: HeldOut, gain: float, held_less: HeldOut
) -> tuple[Candidate, ...]:
    """Those that do as well within what the record can tell, one of each name."""
    out: list[Candidate] = []
    rules = search.rules
    for rival in rivals:
        lost, sigmas = worse_by(rival.held, held)
        close = lost < rules.close_share * gain or (sigmas < rules.close_sigmas and lost < 0.25 * gain)
        # A narrow line that never stops is like nothing else.
        if rival.form.name == "mains_hum":
            continue
        if close and search.plausible(rival) and all(rival.form.name != other.form.name for other in out):
            out.append(rival)
    return tuple(out)


def _named(search: Search, nominal: Fit, extended: Fit, held: HeldOut, found: list[_Found]) -> tuple[Cause, ...]:
    """The accepted causes with their numbers, and the share that each removed on top of those before it."""
    causes = []
    for i, one in enumerate(found):
        values, spans = numbers(extended, i, search)
        also = one.alternatives
        if one.name == "resonance" and nominal.model.nominal.name != "linear":
            # A mode that the nominal stage does not know may always have been there, or a payload moved it here.
            also = (*also, "payload_change")
        own = 1.0 - held.sse_um2 / one.held_without.sse_um2
        # The last one's share is known best from removing it once more.
        share = own if len(found) == 1 else one.step.gain
        p = one.step.p_value
        causes.append(
            Cause(one.name, also, values, spans, float(share), p, one.without.residual_um, extended.residual_um, i)
        )
    return tuple(causes)


def numbers(fit: Fit, index: int, search: Search) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Reported numbers of one cause with 95 % intervals that allow for correlated errors (sums over blocks)."""
    slots = fit.model.slots
    free = [i for i in fit.free if slots[i].low < fit.p[i] < slots[i].high]
    scale = np.array([slots[i].step for i in free])
    rows = fit.model.jacobian(fit.p, fit.signals, free) * scale[:, None] * search.mask
    bread = np.linalg.pinv(rows @ rows.T, rcond=1e-12)
    scores = search.parts.blocks(rows * fit.residual_um)
    cover = bread @ (scores @ scores.T) @ bread * scale[:, None] * scale[None, :]
    where = fit.model.where(index)
    at = {j: row for row, j in enumerate(free)}
    values: dict[str, float] = {}
    spans: dict[str, tuple[float, float]] = {}
    for name, (value, gradient) in (
        fit.model.forms[index].physical(fit.model.part(fit.p, index), fit.model.setting).items()
    ):
        g = np.zeros(len(free))
        for k, slope in enumerate(gradient):
            if where.start + k in at:
                g[at[where.start + k]] = slope
        half = 1.96 * float(np.sqrt(max(float(g @ cover @ g), 0.0)))
        values[name] = value
        spans[name] = (value - half, value + half)
    return values, spans


def _converter_causes(
    setting: Setting, grid: Grid, doubles: Repeats | None, floor: Floor, extended: Fit, n: int, dropped: int
) -> tuple[Cause, ...]:
    """Quantisation and timing, which are seen in the readings themselves rather than fitted."""
    out: list[Cause] = []
    flat = extended.residual_um
    if grid.step_um > 0.0:
        own = grid.step_um**2 / 12.0
        share = own / max(extended.sse_um2 / n, own)
        if grid.step_um > 1.2 * floor.sigma_um and share > 0.2:
            step = grid.step_um
            rounding = 1e-3 * step
            out.append(
                Cause(
                    "quantisation",
                    (),
                    {"step_um": step},
                    {"step_um": (step - rounding, step + rounding)},
                    share,
                    0.001,
                    flat,
                    flat,
                )
            )
    if doubles is not None:
        p = doubles.probability
        half = 1.96 * float(np.sqrt(p * (1.0 - p) / max(1, doubles.of)))
        out.append(
            Cause(
                "timing",
                (),
                {"repeat_probability": p},
                {"repeat_probability": (max(0.0, p - half), p + half)},
                0.0,
                0.001,
                flat,
                flat,
            )
        )
    elif dropped > 0:
        share = dropped / setting.n
        out.append(
            Cause(
                "timing",
                (),
                {"lost_samples": float(dropped)},
                {"lost_samples": (float(dropped), float(dropped))},
                share,
                0.001,
                flat,
                flat,
            )
        )
    names = {f.name for f in extended.model.forms}
    return tuple(c for c in out if c.name not in names)


def _verdict(causes: tuple[Cause, ...], nominal: HeldOut, extended: HeldOut, floor: Floor, n: int) -> str:
    """adequate, effects or unexplained."""
    base = n * floor.sigma_um**2
    left, first = extended.sse_um2 - base, nominal.sse_um2 - base
    structured = left > 0.5 * base
    if causes and (not structured or left < 0.6 * first or any(c.form < 0 for c in causes)):
        return "effects"
    return "unexplained" if structured else "adequate"


def not_excited(search: Search, nominal: Fit, extended: Fit, floor: Floor) -> tuple[str, ...]:
    """Causes whose usual size would leave less than five standard errors in this record."""
    seen = {
        search.forms[look.index].name: True
        for look in search.first_looks
        if look.size_um2 > (5.0 * floor.sigma_um) ** 2
    }
    has_mode = any(f.name == "resonance" for f in extended.model.forms) or nominal.model.nominal.name == "linear"
    seen["payload_change"] = has_mode
    seen.setdefault("quantisation", True)
    return tuple(name for name in NAMES if not seen.get(name, False))
