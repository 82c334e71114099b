"""The search for causes: add the one that reduces the held-out error most, then review each accepted cause.

Each round screens all cause models by a linearised fit, fits the most promising ones jointly with everything accepted
so far, and accepts the best if it passes the `Thresholds`. The review removes each accepted cause once more, drops or
replaces those that are not needed, and collects rivals that explain the recording as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.diagnosis.catalogue import CATALOGUE, Catalogue
from dehyst.sim.diagnosis.search.held_out import HeldOut, Split, held_out, monitor_misfit, worse_by
from dehyst.sim.diagnosis.search.intervals import across_zero, parameter_errors
from dehyst.sim.diagnosis.search.screening import ResidualScreen, ScreenedCause, p_value
from dehyst.sim.fitting.calibration import (
    calibrate,
    clipped_to_bounds,
    evaluate,
    own_dynamics,
    with_dynamics_anew,
    with_free_memory,
    with_new_columns,
)
from dehyst.sim.fitting.fit_data import ActsOn
from dehyst.sim.fitting.parallel import side_by_side
from dehyst.sim.fitting.stage_model import CauseModel, ModelFit, StageModel
from dehyst.sim.readings.noise import has_spectral_line
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.sight import Sight

#: Least squared error that a line must remove, in that of the noise: half the square of a twentieth of its deviation.
_LINE = 0.5 * 0.05**2


@dataclass(frozen=True)
class Thresholds:
    """What a cause must fulfil to be named. The scores in `docs/diagnosis.md` were measured with these values."""

    #: Largest p-value, corrected for the number of candidates.
    level: float = 0.01
    #: Least gain as a share of the squared noise floor.
    least_of_floor: float = 0.08
    #: Least share of the squared error above the noise floor that a cause must remove, and of the nominal's squared
    #: error where no direct test sees it: the loop of a real stage is right to some percent only, and what that leaves
    #: has no name.
    least_share: float = 0.1
    #: A cause that removes this share is accepted even if the model errors of earlier causes could explain it.
    nearly_all: float = 0.85
    #: Cost of one parameter, as a share of the squared error: of two equal causes the simpler one is preferred.
    cost_per_number: float = 0.002
    #: Where no cause is acceptable alone and this many noise floors are left, two are tried at once ...
    much_left: float = 2.0
    #: ... the first of which removes this share of what is above the noise.
    least_of_two: float = 0.3
    #: Number of linearised guesses that are fitted in full.
    refits: int = 6
    most_causes: int = 5
    #: The excess that a cause must remove is this many times smaller where its signature is seen.
    seen_eases: float = 4.0
    #: A rival within this share of the gain, or within this many standard errors, is reported as an alternative ...
    close_share: float = 0.02
    close_sigmas: float = 2.5
    #: Where no direct test sees a cause, one that it is easily mistaken for is an alternative if it lacks less than
    #: this share of the gain: no form is exact on a measured stage.
    close_unseen: float = 0.5
    #: Most names in a set of a cause and what it is mistaken for.
    widest: int = 3
    #: Least share of the error that a cause must remove whose numbers may all be zero: a loop's form has such numbers.
    least_about_zero: float = 0.25


def first_fits(
    cause: CauseModel, guess: FloatArray, base: ModelFit, mask: BoolArray
) -> tuple[CauseModel, list[ModelFit]]:
    """A few steps of the joint fit of ``base`` and ``cause``, with each suitable hold; and the cause as fitted.

    ``guess`` holds the parameters of the cause that screening found.
    """
    other = replace(base.model, nominal=base.model.nominal.with_other_hold())
    own = [f for model in (base.model, other) if (f := cause.own_fit(model, base, mask)) is not None]
    if own:
        # What is implausible (half a slip) is the hold's doing: plausible fits go first.
        whole = [f for f in own if f.model.causes[-1].plausible(f.p[base.p.size :], f.model.data)]
        best = min(whole or own, key=lambda f: f.sse_um2)
        return best.model.causes[-1], [best]
    if cause.takes_over:
        return cause, [_first_joint_fit(cause, base, guess, mask)]
    fits = [_first_fit(base.model.with_cause(cause), base, guess, mask)]
    used = cause.histories(base.model.data)
    if used:
        fits += [_first_fit(base.model.with_cause(c), base, guess, mask) for c in used]
        # A few steps do not tell one memory from another: beside the right one the nominal loop may move furthest.
        fits = [calibrate(f.model, f.p, mask, cause.iterations, 1e-5) for f in fits]
        best = min(fits, key=lambda f: f.sse_um2 * (1.0 if f is fits[0] else 1.03))
        return best.model.causes[-1], [best]
    if cause.fast:
        fits.append(_first_fit(other.with_cause(cause), base, guess, mask))
    for start in _joint_starts(cause, base, guess.size):
        fits += [calibrate(model.with_cause(cause), start, mask, 8, 2e-3) for model in (base.model, other)]
    return cause, fits


def _first_fit(model: StageModel, base: ModelFit, guess: FloatArray, mask: BoolArray) -> ModelFit:
    """From a linearised guess, or from beside neutral where that overshot."""
    parameters = model.causes[-1].parameters(model.data)
    neutral = np.array([s.neutral for s in parameters])

    def fitted(own: FloatArray) -> ModelFit:
        return calibrate(model, np.concatenate([base.p, own]), mask, 8, 2e-3, known=base.columns())

    if evaluate(model, clipped_to_bounds(model, np.concatenate([base.p, guess])), mask).sse_um2 <= base.sse_um2:
        fit = fitted(guess)
    else:
        fit = fitted(np.where([s.linear for s in parameters], neutral, guess))
        if fit.sse_um2 >= 0.98 * base.sse_um2:
            # A fit that starts at a bound (no creep) may stay there.
            fit = min(fit, fitted(guess), key=lambda f: f.sse_um2)
    if fit.sse_um2 <= base.sse_um2:
        return fit
    # It ended worse than without the cause: what the cause shares with the base (a lag) had to move with it.
    return min(fit, calibrate(model, np.concatenate([base.p, neutral]), mask, 8, 2e-3), key=lambda f: f.sse_um2)


def _first_joint_fit(cause: CauseModel, base: ModelFit, guess: FloatArray, mask: BoolArray) -> ModelFit:
    """From the best of a grid in which a part of the nominal stage gives way to the cause."""
    model = base.model.with_cause(cause)
    starts = [np.concatenate([base.p, guess]), *_joint_starts(cause, base, guess.size)]
    tried = [(evaluate(model, clipped_to_bounds(model, p), mask).sse_um2, i) for i, p in enumerate(starts)]
    order = [i for sse, i in sorted(tried) if np.isfinite(sse)][:2]
    return min((calibrate(model, starts[i], mask, 12, 2e-3) for i in order), key=lambda f: f.sse_um2)


def _joint_starts(cause: CauseModel, base: ModelFit, size: int) -> list[FloatArray]:
    """The joint starts of a cause with ``size`` parameters, with those of the causes of ``base`` in between."""
    own = base.model.n_nominal
    names = tuple(parameter.name for parameter in base.model.parameters[:own])
    starts = cause.joint_starts(base.p[:own], names, base.model.data)
    return [np.concatenate([p[:-size], base.p[own:], p[-size:]]) for p in starts]


def _exchanged(fit: ModelFit, index: int, cause: CauseModel, own: FloatArray) -> tuple[StageModel, FloatArray]:
    """The model with ``cause`` in place of ``causes[index]``, and its start with the parameters ``own`` of it."""
    causes, where = fit.model.causes, fit.model.slice_of(index)
    model = replace(fit.model, causes=(*causes[:index], cause, *causes[index + 1 :]))
    return model, np.concatenate([fit.p[: where.start], own, fit.p[where.stop :]])


Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class CauseCandidate:
    """A cause fitted jointly with everything accepted so far. ``cost`` is the held-out error with its penalties."""

    cause: CauseModel
    fit: ModelFit
    held: HeldOut
    cost: float


@dataclass(frozen=True)
class AcceptedCause:
    """One accepted cause at the time of its acceptance."""

    name: str
    p_value: float
    #: Share of the held-out squared error that it removed at that time.
    gain: float


@dataclass
class Search:
    """The greedy search. `run` returns the accepted model."""

    mask: BoolArray
    parts: Split
    sigma_um: float
    thresholds: Thresholds
    seed: int
    progress: Progress
    #: The converter grid of the readings is coarser than their noise.
    coarse: bool = False
    #: The readings, and what their direct tests say, by cause.
    readings: Readings | None = None
    sights: dict[str, Sight] = field(default_factory=dict)
    catalogue: Catalogue = CATALOGUE
    #: The forms of the catalogue, with what is found anew in each residual.
    causes: tuple[CauseModel, ...] = ()
    first_looks: list[ScreenedCause] = field(default_factory=list)
    #: The nominal stage calibrated without causes.
    nominal: ModelFit | None = None
    #: Held-out squared error of the nominal stage (µm²).
    nominal_um2: float = 0.0
    #: What the form of each accepted cause may leave over, per block (µm²).
    left_um2: dict[str, FloatArray] = field(default_factory=dict)
    #: Causes that the review dropped because their numbers may all be zero.
    uncertain: set[str] = field(default_factory=set)
    #: Accepted causes whose direct test answers to others as well, but gives a number that agrees with the fit.
    agreed: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.causes = self.causes or self.catalogue.forms
        if self.readings is not None:
            self.causes = tuple(cause.shown(self.readings) for cause in self.causes)

    def seen(self, cause: CauseModel) -> bool:
        """Whether a direct test sees this cause that answers to it alone, or gives the number that the fit has."""
        sight = self.sights.get(cause.name)
        alone = not cause.test_answers_to_others or cause.name in self.agreed
        return sight is not None and sight.seen is True and alone

    def vetoed(self, cause: CauseModel) -> bool:
        """Whether the readings excite the direct test of this cause, and it sees nothing."""
        sight = self.sights.get(cause.name)
        return sight is not None and sight.seen is False and cause.unseen_is_absent

    def cost(self, fit: ModelFit, held: HeldOut, base: ModelFit) -> float:
        """Held-out squared error with the cost of the parameters that ``base`` lacks, and the monitor's error (µm²)."""
        extra = len(fit.free) - len(base.free)
        seen = monitor_misfit(fit, self.mask) * self.sigma_um**2 if fit.model.data.monitor_V is not None else 0.0
        return seen + held.sse_um2 * (1.0 + self.thresholds.cost_per_number * max(extra, 0))

    def held(self, fit: ModelFit) -> HeldOut:
        return held_out(fit, self.mask, self.parts)

    def mistaken_for(self, cause: CauseModel) -> tuple[str, ...]:
        """What a cause is easily mistaken for, where no direct test says that it is this cause."""
        return () if self.seen(cause) else self.catalogue.kind(cause.name).mistaken_for

    def shown_as_well(self, name: str) -> tuple[str, ...]:
        """Other causes that show the same as this one in its direct test."""
        sight = self.sights.get(name)
        return () if sight is None else sight.also

    def looks(self, fit: ModelFit, skip: set[str]) -> tuple[list[ScreenedCause], list[CauseModel]]:
        """The best linearised guess of every applicable cause, largest gain first."""
        screen = ResidualScreen(fit, self.mask, self.parts)
        self._refresh(fit)
        shown = [i for i, f in enumerate(self.causes) if f.name not in skip and not f.missing(fit.model.data)]
        seen = side_by_side(lambda i: screen.best_guess(i, fit.model.with_cause(self.causes[i])), shown)
        found = sorted((look for look in seen if look is not None), key=lambda s: -s.gain_um2)
        return found, [self.causes[s.index] for s in found]

    def _refresh(self, fit: ModelFit) -> None:
        """Find what is to be found anew (places of slips, frequencies of modes) in the residual of ``fit``."""
        self.causes = tuple(cause.found_again(fit, self.mask) for cause in self.causes)

    def refit(
        self, base: ModelFit, looks: list[ScreenedCause], count: int, least_um2: float, also: tuple[str, ...] = ()
    ) -> list[CauseCandidate]:
        """The most promising guesses, and the best of each cause of ``also``, fitted jointly, the lowest cost first."""
        if not looks:
            return []
        chosen = [s for s in looks[:count] if s.gain_um2 > max(least_um2, 0.05 * looks[0].gain_um2)]
        # Of causes that show only their sum, each is fitted.
        beside = self.catalogue.same_set({self.causes[s.index].name for s in chosen})
        first = self.causes[chosen[0].index].name if chosen else ""
        for look in looks:
            cause = self.causes[look.index]
            # These are fitted even with a small linearised gain: a line in the spectrum, because it is specific; what
            # takes over a part of the nominal stage, because it shows only when that is fitted with it; a form that
            # looks like another form of its effect at first; and what a direct test sees.
            own = self.is_line(cause, look.start, base) or cause.takes_over
            own = own or (cause.beside_its_kind and cause.name == first)
            if self.seen(cause) or cause.name in beside or cause.name in also:
                own = own or all(self.causes[c.index].name != cause.name for c in chosen)
            if own and all(look is not c for c in chosen):
                chosen.append(look)

        def fitted(look: ScreenedCause) -> CauseCandidate:
            cause, fits = first_fits(self.causes[look.index], look.start, base, self.mask)
            quick = min(fits, key=lambda f: f.sse_um2)
            held = self.held(quick)
            return CauseCandidate(cause, quick.without_signals(), held, self.cost(quick, held, base))

        return sorted(side_by_side(fitted, chosen), key=lambda c: c.cost)

    def is_line(self, cause: CauseModel, p: FloatArray, base: ModelFit) -> bool:
        """Whether the cause is a line that the spectrum of the residual shows."""
        line_hz = cause.line_hz(p)
        return line_hz is not None and has_spectral_line(base.residual_um, base.model.data, line_hz)

    def polish(self, candidate: CauseCandidate, base: ModelFit) -> CauseCandidate:
        """The same cause fitted to convergence."""
        return self._converged(candidate, candidate.fit, base, candidate.cause.iterations)

    def _converged(
        self, candidate: CauseCandidate, fit: ModelFit, base: ModelFit, iterations: int = 12
    ) -> CauseCandidate:
        """The candidate with ``fit``, after a calibration to convergence."""
        fit = with_new_columns(calibrate(fit.model, fit.p, self.mask, iterations, 1e-5), self.mask)
        held = self.held(fit)
        return replace(candidate, fit=fit, held=held, cost=self.cost(fit, held, base))

    def plausible(self, candidate: CauseCandidate) -> bool:
        """Whether the fitted parameters have a plausible size and sign, and the readings do not speak against it."""
        cause = candidate.cause
        if self.vetoed(cause):
            return False
        sight = self.sights.get(cause.name)
        unseen = sight is not None and sight.seen is not True
        if cause.must_be_seen and unseen and not self.agreement(candidate):
            return False
        if self.readings is not None and not cause.borne_out(self.readings):
            return False
        model = candidate.fit.model
        return cause.plausible(model.parameters_of(candidate.fit.p, len(model.causes) - 1), model.data)

    def agreement(self, candidate: CauseCandidate) -> str:
        """How a number of the direct test, that is too faint or answers to others as well, agrees with the fit."""
        if self.readings is None:
            return ""
        model = candidate.fit.model
        own = model.parameters_of(candidate.fit.p, len(model.causes) - 1)
        return candidate.cause.agreement(own, self.readings)

    def _with_agreement(self, candidate: CauseCandidate) -> None:
        """A number of the direct test that agrees with the accepted fit is seen."""
        name = candidate.cause.name
        sight, agreement = self.sights.get(name), self.agreement(candidate)
        if sight is None or sight.seen is False or not agreement:
            return
        if sight.seen is None or (candidate.cause.test_answers_to_others and name not in self.agreed):
            self.sights[name] = replace(sight, seen=True, words=f"{sight.words}; {agreement}")
        if candidate.cause.test_answers_to_others:
            self.agreed.add(name)

    def acceptable(
        self,
        best: CauseCandidate,
        held: HeldOut,
        left_um2: FloatArray,
        p: float,
        base: ModelFit,
    ) -> bool:
        """Whether the gain exceeds chance and the model errors of earlier causes, and the parameters are plausible."""
        thresholds = self.thresholds
        gain = held.sse_um2 - best.held.sse_um2
        sight = self.sights.get(best.cause.name)
        # A direct test that is too faint, or answers to others as well, counts where its number agrees with the fit.
        seen = self.seen(best.cause) or (sight is not None and sight.seen is not False and bool(self.agreement(best)))
        if gain <= 0.0 or (p > thresholds.level and not seen):
            return False
        parameters = best.cause.parameters(best.fit.model.data)
        q = best.fit.model.parameters_of(best.fit.p, len(best.fit.model.causes) - 1)
        if self.is_line(best.cause, q, base):
            # A line of less than a twentieth of the noise is none that matters.
            return gain > _LINE * self.noise_um2
        numbers = best.cause.reported(q, best.fit.model.data).values()
        told = np.any([gradient != 0.0 for _, gradient in numbers], axis=0)
        ends = [v != s.neutral and not s.low < v < s.high and not s.linear for s, v in zip(parameters, q, strict=True)]
        # A reported number at its bound is none that was found. Of the many of a free form a few may be.
        if 2 * np.sum(told & ends) >= max(1, np.sum(told)) or not self.plausible(best):
            return False
        now, after = held.per_block_um2, best.held.per_block_um2
        share = self.share(gain, held)
        # A model error of earlier causes is never explained almost completely by another cause.
        if share > thresholds.nearly_all:
            return self.worth(gain, held, seen)
        if not seen and sight is not None and sight.seen is None and best.cause.imitates_others:
            return False
        # Blocks whose error is mostly the model error of earlier causes are not evidence for a further one.
        clean = now > 2.0 * left_um2
        floor_um2 = self.parts.blocks(self.mask.astype(np.float64) * self.sigma_um**2)
        excess_um2 = max(float((now - floor_um2)[clean].sum()), 1e-3 * self.noise_um2)
        need = thresholds.least_share / (thresholds.seen_eases if seen else 1.0)
        return self.worth(gain, held, seen) and float((now - after)[clean].sum()) > need * excess_um2

    @property
    def noise_um2(self) -> float:
        """Squared error of the noise alone."""
        return float(self.mask.sum()) * self.sigma_um**2

    def share(self, gain_um2: float, held: HeldOut) -> float:
        """Share of the squared error above the noise of ``held``."""
        return gain_um2 / max(held.sse_um2 - self.noise_um2, 1e-3 * self.noise_um2)

    def worth(self, gain_um2: float, held: HeldOut, seen: bool) -> bool:
        """Whether what a cause removes of ``held``, the error without it, is enough to be named."""
        thresholds, share = self.thresholds, self.share(gain_um2, held)
        ease = thresholds.seen_eases if seen else 1.0
        # With a coarse grid, rounding errors repeat wherever the stage rests and could look like a cause.
        if gain_um2 < (0.5 if self.coarse and not seen else thresholds.least_of_floor / ease) * self.noise_um2:
            return False
        large = seen or share > thresholds.nearly_all or gain_um2 > thresholds.least_share * self.nominal_um2
        return large and share > thresholds.least_share / ease

    def run(self, nominal: ModelFit) -> tuple[ModelFit, HeldOut, list[AcceptedCause]]:
        """Add causes to the calibrated nominal stage, one per round, until none is acceptable."""
        held = self.held(nominal)
        self.nominal, self.nominal_um2 = nominal, held.sse_um2
        self.first_looks, _ = self._looks_beside(nominal)
        steps: list[AcceptedCause] = []
        current = nominal
        for wider in [c for c in self.causes if c.widens and not c.missing(nominal.model.data)]:
            found = self._widened(wider, nominal)
            if self.vetoed(wider) or not self.agreement(found):
                continue
            # As long as causes are missing, held-out stretches say little of it: the review decides.
            gain = held.sse_um2 - found.held.sse_um2
            self._with_agreement(found)
            steps.append(AcceptedCause(wider.name, p_value(self.first_looks, gain, self.seed), gain / held.sse_um2))
            current, held = found.fit, found.held
        current, held, more = self.extended(current, held)
        return current, held, [*steps, *more]

    def _widened(self, cause: CauseModel, nominal: ModelFit) -> CauseCandidate:
        """The nominal stage with a bound widened at which its calibration stands."""
        model = nominal.model.with_cause(cause)
        own = [s.neutral for s in cause.parameters(model.data)]
        fit = with_new_columns(calibrate(model, np.append(nominal.p, own), self.mask, 20, 1e-5), self.mask)
        held = self.held(fit)
        return CauseCandidate(cause, fit, held, self.cost(fit, held, nominal))

    def extended(self, current: ModelFit, held: HeldOut) -> tuple[ModelFit, HeldOut, list[AcceptedCause]]:
        """Add causes to a fit, but none that the review dropped."""
        steps: list[AcceptedCause] = []
        for round_ in range(len(current.model.causes), self.thresholds.most_causes):
            self.progress(f"looking for cause {round_ + 1}", 0.1 + 0.8 * round_ / self.thresholds.most_causes)
            names = {f.name for f in current.model.causes}
            left_um2 = np.zeros_like(held.per_block_um2)
            for name in names & self.left_um2.keys():
                left_um2 += self.left_um2[name]
            looks, _ = self._looks_beside(current)
            ranked = self.refit(current, looks, self.thresholds.refits, 0.0)
            accepted: CauseCandidate | None = None
            p = 1.0
            fitting = sorted((c for c in ranked if self.plausible(c)), key=self._with_witness)
            for best in self._to_convergence(self._apart(fitting), current):
                gain = held.sse_um2 - best.held.sse_um2
                p = p_value(looks, gain, self.seed + round_)
                if self.acceptable(best, held, left_um2, p, current):
                    accepted = best
                    break
            if accepted is None:
                two = self._two_at_once(ranked, current, held, left_um2, self.seed + round_)
                if two is None or len(two[0].model.causes) > self.thresholds.most_causes:
                    break
                current, held, more = two
                steps += more
                continue
            self._with_agreement(accepted)
            # A freer form imitates what it stands beside: it does not take over a signature that the readings show.
            sight = self.sights.get(accepted.cause.name)
            if sight is None or sight.seen is not True:
                freer = self._with_freer_form(current)
                if freer is not None and freer.cost < accepted.cost:
                    # What is there already explains it better: no further cause.
                    current, held = freer.fit, freer.held
                    continue
            accepted = self._other_hold(self.finer(accepted, current), current)
            accepted = self._with_free_memory(self._off_bounds(accepted, current), current)
            share = 1.0 - accepted.held.sse_um2 / held.sse_um2
            gone = np.maximum(held.per_block_um2 - accepted.held.per_block_um2, 0.0)
            self.left_um2[accepted.cause.name] = accepted.cause.model_error**2 * gone
            if self.seen(accepted.cause):
                # The error that the loop's form is compared with is that of a stage that has what the readings show.
                self.nominal_um2 -= held.sse_um2 - accepted.held.sse_um2
            current, held = accepted.fit, accepted.held
            steps.append(AcceptedCause(accepted.cause.name, p, share))
        return current, held, steps

    def _to_convergence(self, candidates: list[CauseCandidate], base: ModelFit) -> Iterator[CauseCandidate]:
        """The first three candidates fitted to convergence; then, if none is taken, three causes in finer models.

        A coarse sum of plays may do worse in held-out stretches than no plays at all.
        """
        fitted = []
        for candidate in candidates[:3]:
            fitted.append(self._beside_finer(self.polish(candidate, base), base))
            yield fitted[-1]
        first_of: dict[str, CauseCandidate] = {}
        for candidate in [*fitted, *candidates[3:]]:
            first_of.setdefault(candidate.cause.name, candidate)
        coarse = list(first_of.values())[:3]
        finer = [self.finer(candidate, base) for candidate in coarse]
        yield from sorted((f for f, c in zip(finer, coarse, strict=True) if f is not c), key=self._with_witness)

    def _two_at_once(
        self, refused: list[CauseCandidate], base: ModelFit, held: HeldOut, left_um2: FloatArray, seed: int
    ) -> tuple[ModelFit, HeldOut, list[AcceptedCause]] | None:
        """Two causes, each acceptable beside the other where neither is alone; None if there are none.

        As long as one is missing, the other may explain too little, or have no plausible size.
        """
        floor_um2 = float(self.mask.sum()) * self.sigma_um**2
        enough = self.thresholds.least_of_two * (held.sse_um2 - floor_um2)
        if held.sse_um2 < self.thresholds.much_left**2 * floor_um2:
            return None
        for first in [c for c in refused if held.sse_um2 - c.held.sse_um2 > enough and not self.vetoed(c.cause)][:2]:
            one = self.polish(first, base)
            looks, _ = self._looks_beside(one.fit)
            beside = self.refit(one.fit, looks, 4, 0.0)
            for other in sorted((c for c in beside if self.plausible(c)), key=self._with_witness)[:2]:
                second = self.finer(self.polish(other, one.fit), one.fit)
                p_second = p_value(looks, one.held.sse_um2 - second.held.sse_um2, seed)
                if not self.acceptable(second, one.held, left_um2, p_second, one.fit):
                    continue
                gone = np.maximum(one.held.per_block_um2 - second.held.per_block_um2, 0.0)
                left = second.cause.model_error**2 * gone
                # The first one must be acceptable beside the second, too.
                both, less = self._last(second, len(base.model.causes))
                alone = self.held(less)
                p_first = p_value(self._looks_beside(less)[0], alone.sse_um2 - both.held.sse_um2, seed)
                if self.acceptable(both, alone, left_um2 + left, p_first, less):
                    gone = np.maximum(alone.per_block_um2 - both.held.per_block_um2, 0.0)
                    self.left_um2[second.cause.name] = left
                    self.left_um2[both.cause.name] = both.cause.model_error**2 * gone
                    shares = [1.0 - both.held.sse_um2 / without.sse_um2 for without in (alone, one.held)]
                    steps = [
                        AcceptedCause(both.cause.name, p_first, shares[0]),
                        AcceptedCause(second.cause.name, p_second, shares[1]),
                    ]
                    return both.fit, both.held, steps
        return None

    def _looks_beside(self, fit: ModelFit) -> tuple[list[ScreenedCause], list[CauseModel]]:
        """The guesses beside the causes of ``fit``, without those that the review dropped."""
        names = {cause.name for cause in fit.model.causes}
        # What a direct test cannot tell from a cause that is there, and is seen by the same, is that cause once more.
        either = {other for name in names for other in self.shown_as_well(name) if name in self.shown_as_well(other)}
        return self.looks(fit, self.catalogue.same_set(names) | self.uncertain | either)

    def _last(self, candidate: CauseCandidate, index: int) -> tuple[CauseCandidate, ModelFit]:
        """An earlier cause of a candidate's model as the candidate, and the model without it."""
        fit, where = candidate.fit, candidate.fit.model.slice_of(index)
        less = self.without(fit, index)
        cause = fit.model.causes[index]
        p = np.concatenate([fit.p[: where.start], fit.p[where.stop :], fit.p[where]])
        moved = calibrate(less.model.with_cause(cause), p, self.mask, cause.iterations, 1e-5)
        return self._converged(replace(candidate, cause=cause), moved, less), less

    def _with_freer_form(self, fit: ModelFit) -> CauseCandidate | None:
        """The model with the first of its causes that has a freer form in that form; None if none has."""
        for i, cause in enumerate(fit.model.causes):
            freer = cause.freer()
            if freer is None:
                continue
            own = np.array([s.neutral for s in freer.parameters(fit.model.data)])
            model, start = _exchanged(fit, i, freer, own)
            better = with_new_columns(calibrate(model, start, self.mask, 10, 1e-4), self.mask)
            held = self.held(better)
            return CauseCandidate(freer, better, held, self.cost(better, held, fit))
        return None

    def _apart(self, candidates: list[CauseCandidate]) -> list[CauseCandidate]:
        """Without those that the recording cannot tell from an earlier one, such as the second of two lags."""
        out: list[CauseCandidate] = []
        for one in candidates:
            beside = self.catalogue.same_set({one.cause.name})
            if all(other.cause.name == one.cause.name or other.cause.name not in beside for other in out):
                out.append(one)
        return out

    def _with_witness(self, candidate: CauseCandidate) -> tuple[bool, float]:
        """The cost, behind that of causes whose signature is seen: flexible forms imitate many causes."""
        return not self.seen(candidate.cause), candidate.cost

    def _other_hold(self, accepted: CauseCandidate, base: ModelFit) -> CauseCandidate:
        """The candidate with the other hold between samples, if that fits better: a large cause can hide it."""
        fit = accepted.fit
        model = replace(fit.model, nominal=fit.model.nominal.with_other_hold())
        dearer = model.nominal.substeps > fit.model.nominal.substeps
        other = calibrate(model, fit.p, self.mask, 4, 2e-3, known=fit.columns())
        if other.sse_um2 > fit.sse_um2 * (0.95 if dearer else 0.99):
            return accepted
        return self._unless_it_holds_out_worse(accepted, other, base)

    def _off_bounds(self, accepted: CauseCandidate, base: ModelFit) -> CauseCandidate:
        """The candidate with the nominal mechanics started anew where one of their numbers stands at its bound, if that
        fits better: a large cause drove it there (a lag of nothing and a reading a sample late, for a lag)."""
        fit = accepted.fit
        # A step of a fit ends close to a bound, not on it.
        if all(s.low + 0.02 * s.step < fit.p[i] < s.high - 0.02 * s.step for i, s in own_dynamics(fit)):
            return accepted
        other = with_dynamics_anew(fit, self.mask)
        if other.sse_um2 > fit.sse_um2 * 0.99:
            return accepted
        return self._unless_it_holds_out_worse(accepted, other, base)

    def _unless_it_holds_out_worse(self, accepted: CauseCandidate, fit: ModelFit, base: ModelFit) -> CauseCandidate:
        """The candidate with ``fit``, which explains more, unless it does clearly worse in held-out stretches."""
        other = self._converged(accepted, fit, base)
        return other if other.cost < 1.2 * accepted.cost else accepted

    def _with_free_memory(self, accepted: CauseCandidate, base: ModelFit) -> CauseCandidate:
        """The candidate with a free memory at the start, if that explains more: a large cause can hide it."""
        fit = with_free_memory(accepted.fit, self.mask)
        if fit is accepted.fit:
            return accepted
        other = self._unless_it_holds_out_worse(accepted, fit, base)
        if other is not accepted and self.nominal is not None:
            more = fit.model.parameters[self.nominal.p.size : fit.model.n_nominal]
            self.nominal = replace(self.nominal, p=np.append(self.nominal.p, [s.neutral for s in more]))
        return other

    def finer(self, accepted: CauseCandidate, base: ModelFit) -> CauseCandidate:
        """The candidate with the finer model of the same cause that costs least, if one costs less."""
        best, finer = accepted, self._refined(accepted, base)
        while finer is not None:
            best = min(best, finer, key=lambda c: c.cost)
            finer = self._refined(finer, base)
        return best

    def _left_floors(self, candidate: CauseCandidate) -> float:
        """Held-out error of the candidate in noise floors."""
        return float(np.sqrt(candidate.held.sse_um2 / max(1.0, float(self.mask.sum())))) / self.sigma_um

    def _refined(self, candidate: CauseCandidate, base: ModelFit) -> CauseCandidate | None:
        """The candidate with the next finer model of the same cause; None if there is none or none is needed."""
        # The last cause is the candidate's. Earlier ones may be finer than those of ``base``.
        last = len(candidate.fit.model.causes) - 1
        own = candidate.fit.p[candidate.fit.model.slice_of(last)]
        found = candidate.cause.refined(own, self._left_floors(candidate), base.model.data)
        if found is None:
            return None
        cause, starts = found
        finer = [_exchanged(candidate.fit, last, cause, start) for start in starts]
        fits = [calibrate(model, p, self.mask, 10, 1e-3) for model, p in finer]
        fit = with_new_columns(min(fits, key=lambda f: f.sse_um2), self.mask)
        held = self.held(fit)
        return CauseCandidate(cause, fit, held, self.cost(fit, held, base))

    def _beside_finer(self, candidate: CauseCandidate, base: ModelFit) -> CauseCandidate:
        """The candidate with the next finer model of an earlier cause, if that costs less.

        As long as this cause was missing, the finer model may have done worse in held-out stretches.
        """
        best, left = candidate, self._left_floors(candidate)
        for i, cause in enumerate(base.model.causes):
            found = cause.refined(candidate.fit.p[base.model.slice_of(i)], left, base.model.data)
            if found is None:
                continue
            finer, starts = found
            for own in starts:
                model, start = _exchanged(candidate.fit, i, finer, own)
                fit = calibrate(model, start, self.mask, candidate.cause.iterations, 1e-4)
                best = min(best, self._converged(candidate, fit, base), key=lambda c: c.cost)
        return best

    def fitted_again(self, fit: ModelFit, held: HeldOut) -> tuple[ModelFit, HeldOut]:
        """The fit with what its causes find anew beside all causes found since."""
        for i, cause in enumerate(fit.model.causes):
            better = cause.fitted_again(fit, i, self.mask)
            if better is not fit:
                # Its causes may stand in another order now.
                better = with_new_columns(better, self.mask)
                return better, self.held(better)
        return fit, held

    def may_be_zero(self, fit: ModelFit, index: int, small: bool) -> bool:
        """Whether the intervals of all its numbers hold zero, of a cause that removes little or that is never zero.

        Of several numbers of one form each may stand for the others; a single one that may be zero says nothing.
        """
        cause = fit.model.causes[index]
        reported = cause.reported(fit.model.parameters_of(fit.p, index), fit.model.data).values()
        several = np.linalg.matrix_rank(np.array([gradient for _, gradient in reported])) > 1
        if not small and several and not cause.never_zero:
            return False
        return across_zero(parameter_errors(fit, self.mask, self.parts, self.readings), index)

    def beyond_bound(self, fit: ModelFit, index: int, gain_um2: float, held: HeldOut) -> bool:
        """Whether ``causes[index]``, which widens a bound, lies beyond it and is worth it beside all others."""
        assert self.readings is not None
        words = fit.model.causes[index].agreement(fit.model.parameters_of(fit.p, index), self.readings)
        return bool(words) and self.share(gain_um2, held) > self.thresholds.least_share

    def filled(self, fit: ModelFit) -> tuple[ModelFit, HeldOut]:
        """The fit to convergence, with a freer form of one of its causes where that explains more."""
        fit = with_new_columns(calibrate(fit.model, fit.p, self.mask, 12, 1e-5), self.mask)
        held = self.held(fit)
        freer = self._with_freer_form(fit)
        return (freer.fit, freer.held) if freer is not None and freer.cost < held.sse_um2 else (fit, held)

    def without(self, fit: ModelFit, index: int) -> ModelFit:
        """The model without one cause, calibrated again."""
        where = fit.model.slice_of(index)
        start = np.concatenate([fit.p[: where.start], fit.p[where.stop :]])
        less = calibrate(fit.model.without_cause(index), start, self.mask, 5, 3e-3, known=fit.columns(where))
        if self.nominal is not None:
            # The nominal stage, and what acts on its loop, may stand where they do only beside it.
            alone = np.array(
                [
                    s.neutral if s.acts_on == ActsOn.STATIC else v
                    for s, v in zip(less.model.parameters, start, strict=True)
                ]
            )
            alone[: fit.model.n_nominal] = self.nominal.p
            less = min(less, calibrate(less.model, alone, self.mask, 12, 1e-4), key=lambda f: f.sse_um2)
        if fit.model.causes[index].fast:
            # It may have stood for the stage's own lag, or for half a sample of the hold.
            less = min(less, with_dynamics_anew(less, self.mask), key=lambda f: f.sse_um2)
        return less


# The review: each accepted cause is removed once more and must be worth its place.


@dataclass(frozen=True)
class ReviewedCause:
    """An accepted cause after its review: the model without it, and its rivals."""

    step: AcceptedCause
    without: ModelFit
    held_without: HeldOut
    rivals: tuple[CauseCandidate, ...] = ()

    @property
    def name(self) -> str:
        return self.step.name

    @property
    def alternatives(self) -> tuple[str, ...]:
        return tuple(r.cause.name for r in self.rivals)


def review(
    search: Search, fit: ModelFit, held: HeldOut, steps: dict[str, AcceptedCause]
) -> tuple[ModelFit, HeldOut, list[ReviewedCause]]:
    """Remove each cause once more: drop it if idle, or if it removes little and its numbers may be zero; replace it if
    another explains more; collect its rivals."""
    thresholds = search.thresholds
    found: list[ReviewedCause] = []
    index = swaps = 0
    while index < len(fit.model.causes):
        cause = fit.model.causes[index]
        less = search.without(fit, index)
        held_less = search.held(less)
        gain = held_less.sse_um2 - held.sse_um2
        if cause.widens and search.beyond_bound(fit, index, gain, held_less):
            # A bound was widened for it, and nothing competes with it: its own number decides.
            found.append(ReviewedCause(steps[cause.name], less.without_signals(), held_less))
            index += 1
            continue
        is_line = cause.line_hz(fit.model.parameters_of(fit.p, index)) is not None
        small = not is_line and gain <= thresholds.least_about_zero * held_less.sse_um2
        if not cause.widens and (gain <= 0.0 or not (is_line or search.worth(gain, held_less, search.seen(cause)))):
            fit, held = less, held_less
            found, index = [], 0
            continue
        if cause.widens or search.may_be_zero(fit, index, small):
            search.uncertain.add(cause.name)
            # It may have stood in the place of another cause.
            fit, held, more = search.extended(*search.filled(less))
            steps |= {step.name: step for step in more}
            found, index = [], 0
            continue
        # Beside one of a set that shows only its sum, the other one is no rival of a third cause.
        beside = search.catalogue.same_set({f.name for f in less.model.causes})
        looks, _ = search.looks(less, beside | {cause.name})
        rivals = search.refit(less, looks, 4, 0.5 * gain, search.mistaken_for(cause))
        cost = search.cost(fit, held, less)
        swap = None
        # Another cause may explain more in the place of one that is seen, but does not account for its signature.
        if not search.seen(cause):
            polished = (search.polish(c, less) for c in rivals[:2])
            swap = next((c for c in polished if c.cost < 0.9 * cost), None)
        if swap is not None and swaps < 2 and swap.cause.name not in steps and search.plausible(swap):
            swaps += 1
            before = steps[cause.name]
            steps[swap.cause.name] = AcceptedCause(swap.cause.name, before.p_value, before.gain)
            fit, held = swap.fit, swap.held
            found, index = [], 0
            continue
        # With a voltage monitor, a rival must agree with the monitor as well.
        rivals = [r for r in rivals if r.cost - r.held.sse_um2 <= 1.2 * (cost - held.sse_um2) + 0.05 * gain]
        names = _rivals(search, cause, rivals, held, gain, less)
        found.append(ReviewedCause(steps[cause.name], less.without_signals(), held_less, names))
        index += 1
    return fit, held, found


def _rivals(
    search: Search, cause: CauseModel, rivals: list[CauseCandidate], held: HeldOut, gain: float, less: ModelFit
) -> tuple[CauseCandidate, ...]:
    """The rivals that the recording cannot tell from the accepted cause, one of each name.

    ``gain``: what the cause removes of the held-out squared error of ``less``.
    """
    out: list[CauseCandidate] = []
    thresholds = search.thresholds
    mates = search.mistaken_for(cause)
    there = search.catalogue.same_set({cause.name, *search.shown_as_well(cause.name)})
    for rival in rivals:
        own = rival.fit.model.parameters_of(rival.fit.p, len(rival.fit.model.causes) - 1)
        # A permanent narrow line cannot be confused with another cause.
        if rival.cause.line_hz(own) is not None or any(rival.cause.name == other.cause.name for other in out):
            continue
        lost, sigmas = worse_by(rival.held, held)
        close = lost < thresholds.close_share * gain or (sigmas < thresholds.close_sigmas and lost < 0.25 * gain)
        more = {other.cause.name for other in out} | {rival.cause.name}
        if not close and rival.cause.name in mates and len(there | more) <= thresholds.widest:
            # What falls a little short may do so because its form is coarse.
            if thresholds.close_unseen * gain <= lost < thresholds.nearly_all * gain:
                rival = search.finer(rival, less)
            close = rival.held.sse_um2 - held.sse_um2 < thresholds.close_unseen * gain
        if close and search.plausible(rival):
            out.append(rival)
    return tuple(out)
