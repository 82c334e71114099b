"""The search: add the cause that explains most held-out error, join, remove, substitute, stop at the noise floor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.causes.catalogue import FORMS, same_set
from sim.diagnosis.causes.modal import Modes
from sim.diagnosis.causes.narrow_lines import line_is_there
from sim.diagnosis.causes.refined_forms import finer
from sim.diagnosis.causes.restoring_force import RestoringLoop
from sim.diagnosis.causes.slip_dates import slips_of
from sim.diagnosis.causes.slips import Slips, redated
from sim.diagnosis.model.fit import Fit, calibrate, refreshed
from sim.diagnosis.model.forms import Form
from sim.diagnosis.search.evidence import HeldOut, Screen, Screened, Split, held_out, p_value, worse_by
from sim.diagnosis.search.first_fits import first_fits
from sim.diagnosis.search.monitor import monitor_misfit
from sim.diagnosis.search.parallel import side_by_side
from sim.diagnosis.search.thresholds import Rules

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Candidate:
    """A cause fitted jointly with everything else."""

    form: Form
    fit: Fit
    held: HeldOut
    cost: float


@dataclass(frozen=True)
class Step:
    """One accepted cause at the time of its acceptance."""

    name: str
    p_value: float
    #: Share of the held-out squared error, as it then was, that it removed.
    gain: float


@dataclass
class Search:
    """Everything that the greedy search works on; `run` gives the accepted model."""

    mask: BoolArray
    parts: Split
    sigma_um: float
    rules: Rules
    seed: int
    progress: Progress
    #: The readings' grid is coarser than their noise.
    coarse: bool = False
    forms: tuple[Form, ...] = FORMS
    first_looks: list[Screened] = field(default_factory=list)
    #: Numbers of the nominal stage calibrated alone.
    nominal_p: FloatArray | None = None

    def cost(self, fit: Fit, held: HeldOut, base: Fit) -> float:
        """Held-out error, with the price of the numbers that a model has more than ``base``."""
        extra = len(fit.free) - len(base.free)
        seen = monitor_misfit(fit, self.mask) * self.sigma_um**2 if fit.model.setting.monitor_V is not None else 0.0
        return seen + held.sse_um2 * (1.0 + self.rules.cost_per_number * max(extra, 0))

    def held(self, fit: Fit) -> HeldOut:
        return held_out(fit, self.mask, self.parts)

    def looks(self, fit: Fit, skip: set[str]) -> tuple[list[Screened], list[Form]]:
        """The best linearised guess of every form that could show, largest gain first."""
        screen = Screen(fit, self.mask, self.parts)
        self._refresh(fit)
        shown = [i for i, f in enumerate(self.forms) if f.name not in skip and not f.applies(fit.model.setting)]
        seen = side_by_side(lambda i: screen.look(i, fit.model.plus(self.forms[i])), shown)
        found = sorted((look for look in seen if look is not None), key=lambda s: -s.gain_um2)
        return found, [self.forms[s.index] for s in found]

    def _refresh(self, fit: Fit) -> None:
        """Slips have no place, and modes no frequency, until a model says what it leaves."""
        self.forms = tuple(f.sought(fit) if isinstance(f, Modes) else f for f in self.forms)
        if any(form.name == "timing" for form in fit.model.forms):
            return
        found = slips_of(fit.model.setting.y_um, fit.signals.reading_um, self.mask)
        self.forms = tuple(replace(f, found=found) if isinstance(f, Slips) else f for f in self.forms)

    def refit(self, base: Fit, looks: list[Screened], count: int, least_um2: float) -> list[Candidate]:
        """The most promising guesses fitted jointly, the cheapest in held-out error first."""
        if not looks:
            return []
        chosen = [s for s in looks[:count] if s.gain_um2 > max(least_um2, 0.05 * looks[0].gain_um2)]
        timing = bool(chosen) and self.forms[chosen[0].index].name == "timing"
        for look in looks:
            form = self.forms[look.index]
            # A line at the mains is small but has its own mark; a loop in the force shows once the mode gives way;
            # slips show to a model that knows of the others, and until then a clock stands for them.
            line = form.name == "mains_hum" and self.is_line(look, base)
            own = line or isinstance(form, RestoringLoop) or (timing and isinstance(form, Slips))
            if own and all(look is not c for c in chosen):
                chosen.append(look)

        def fitted(look: Screened) -> Candidate:
            form, fits = first_fits(self.forms[look.index], look.start, base, self.mask)
            quick = min(fits, key=lambda f: f.sse_um2)
            held = self.held(quick)
            return Candidate(form, quick.slim(), held, self.cost(quick, held, base))

        return sorted(side_by_side(fitted, chosen), key=lambda c: c.cost)

    def is_line(self, look: Screened, base: Fit) -> bool:
        return line_is_there(base.residual_um, base.model.setting, float(look.start[0]))

    def polish(self, candidate: Candidate, base: Fit) -> Candidate:
        """The same cause fitted to the end."""
        more = 40 if candidate.form.variant.startswith("restoring") else 12
        fit = calibrate(candidate.fit.model, candidate.fit.p, self.mask, more, 1e-5)
        fit = refreshed(fit, self.mask)
        held = self.held(fit)
        return replace(candidate, fit=fit, held=held, cost=self.cost(fit, held, base))

    def plausible(self, candidate: Candidate) -> bool:
        """Whether its numbers are of a size and sign that the cause has."""
        model = candidate.fit.model
        return candidate.form.plausible(model.part(candidate.fit.p, len(model.forms) - 1), model.setting)

    def acceptable(self, best: Candidate, held: HeldOut, left_um2: FloatArray, p: float, base: Fit) -> bool:
        """Whether the gain of a cause is more than chance, more than the form's own error, and physical."""
        rules = self.rules
        gain = held.sse_um2 - best.held.sse_um2
        if p > rules.level or gain <= 0.0:
            return False
        slots = best.form.slots(best.fit.model.setting)
        q = best.fit.model.part(best.fit.p, len(best.fit.model.forms) - 1)
        if best.form.name == "mains_hum":
            return gain > 30.0 * self.sigma_um**2 and line_is_there(base.residual_um, base.model.setting, float(q[0]))
        if len(slots) == 1 and (q[0] <= slots[0].low or q[0] >= slots[0].high):
            return False
        if not self.plausible(best):
            return False
        floor = self.parts.blocks(self.mask.astype(np.float64) * self.sigma_um**2)
        now, after = held.per_block_um2, best.held.per_block_um2
        first = not np.any(left_um2)
        # Blocks that hold hardly more than what the forms of earlier causes leave behind tell nothing of a further one.
        clean = now > 2.0 * left_um2
        whole = gain / max(float((now - floor).sum()), 1e-3 * float(floor.sum()))
        gain = float((now - after)[clean].sum())
        excess = max(float((now - floor)[clean].sum()), 1e-3 * float(floor.sum()))
        need = rules.least_excess_first if first else rules.least_excess_next
        # Rounding to a coarse grid errs alike wherever the stage stands still, so that it passes for a cause.
        least = max(
            rules.least_gain * float(now.sum()), (0.5 if self.coarse else rules.least_of_floor) * float(floor.sum())
        )
        # What a form leaves behind is no other cause to the last: what explains nearly all of it, and much, is there.
        if not first and whole > rules.nearly_all and float(now.sum()) > 2.0 * float(floor.sum()):
            return True
        return gain > least and gain > need * excess and whole > 0.5 * need

    def run(self, nominal: Fit) -> tuple[Fit, HeldOut, list[Step]]:
        """Greedy addition from a calibrated nominal model, with substitution after each step."""
        current, held = nominal, self.held(nominal)
        self.nominal_p = nominal.p
        left_um2 = np.zeros_like(held.per_block_um2)
        steps: list[Step] = []
        for round_ in range(self.rules.most_causes):
            self.progress(f"looking for cause {round_ + 1}", 0.1 + 0.8 * round_ / self.rules.most_causes)
            looks, _ = self.looks(current, same_set({f.name for f in current.model.forms}))
            if round_ == 0:
                self.first_looks = looks
            ranked = self.refit(current, looks, self.rules.refits, 0.3 * self.rules.least_gain * current.sse_um2)
            accepted: Candidate | None = None
            p = 1.0
            fitting = [c for c in ranked if self.plausible(c)]
            for candidate in fitting[:3]:
                best = self.polish(candidate, current)
                gain = held.sse_um2 - best.held.sse_um2
                # The linearised gain is what the null distribution knows; a full fit may only be judged by as much.
                p = p_value(looks, gain, self.seed + round_)
                if self.acceptable(best, held, left_um2, p, current):
                    accepted = best
                    break
            if accepted is None:
                break
            accepted = self._other_hold(self._finer(accepted, current), current)
            share = 1.0 - accepted.held.sse_um2 / held.sse_um2
            gone = np.maximum(held.per_block_um2 - accepted.held.per_block_um2, 0.0)
            left_um2 = left_um2 + accepted.form.form_error**2 * gone
            current, held = accepted.fit, accepted.held
            steps.append(Step(accepted.form.name, p, share))
        return current, held, steps

    def _other_hold(self, accepted: Candidate, base: Fit) -> Candidate:
        """The hold between two samples once more: a large cause may have hidden which one suits."""
        fit = accepted.fit
        model = replace(fit.model, nominal=fit.model.nominal.with_other_hold())
        dearer = model.nominal.substeps > fit.model.nominal.substeps
        other = calibrate(model, fit.p, self.mask, 4, 2e-3, known=fit.columns())
        if other.sse_um2 > fit.sse_um2 * (0.95 if dearer else 0.99):
            return accepted
        other = refreshed(calibrate(model, other.p, self.mask, 12, 1e-5), self.mask)
        held = self.held(other)
        return replace(accepted, fit=other, held=held, cost=self.cost(other, held, base))

    def _finer(self, accepted: Candidate, base: Fit) -> Candidate:
        """The same cause in a form with more numbers, where it has one and that does better."""
        left = np.sqrt(accepted.held.sse_um2 / max(1.0, float(self.mask.sum()))) / self.sigma_um
        own = accepted.fit.p[len(base.p) :]
        found = finer(accepted.form, own, float(left), base.model.setting)
        if found is None:
            return accepted
        form, starts = found
        model = base.model.plus(form)
        beside = accepted.fit.p[: len(base.p)]
        fits = [calibrate(model, np.concatenate([beside, start]), self.mask, 10, 1e-3) for start in starts]
        fit = refreshed(min(fits, key=lambda f: f.sse_um2), self.mask)
        held = self.held(fit)
        cost = self.cost(fit, held, base)
        return Candidate(form, fit, held, cost) if cost < accepted.cost else accepted

    def redated(self, fit: Fit, held: HeldOut) -> tuple[Fit, HeldOut]:
        """The fit with its slips, if it has any, dated beside everything that was found since."""
        better = redated(fit, self.mask)
        if better is fit:
            return fit, held
        better = refreshed(better, self.mask)
        return better, self.held(better)

    def without(self, fit: Fit, index: int) -> Fit:
        """The model less one cause, calibrated anew."""
        where = fit.model.where(index)
        start = np.concatenate([fit.p[: where.start], fit.p[where.stop :]])
        if isinstance(fit.model.forms[index], RestoringLoop) and self.nominal_p is not None:
            # The mode had given way to the loop: from there no calibration finds back to a linear stage.
            start[: fit.model.n_nominal] = self.nominal_p
            return calibrate(fit.model.less(index), start, self.mask, 12, 1e-4)
        return calibrate(fit.model.less(index), start, self.mask, 5, 3e-3, known=fit.columns(where))


# --- The review: each accepted cause is removed once more, and has to be worth its place last.


@dataclass(frozen=True)
class Found:
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


def review(search: Search, fit: Fit, held: HeldOut, steps: dict[str, Step]) -> tuple[Fit, HeldOut, list[Found]]:
    """Remove each cause once more: drop what has become idle, swap what another explains better, name rivals."""
    rules = search.rules
    found: list[Found] = []
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
        found.append(Found(steps[form.name], less.slim(), held_less, names))
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
