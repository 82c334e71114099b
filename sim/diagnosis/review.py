"""The review: each accepted cause is removed once more, and has to be worth its place last."""

from __future__ import annotations

from dataclasses import dataclass

from sim.diagnosis.evidence import HeldOut, worse_by
from sim.diagnosis.fit import Fit
from sim.diagnosis.search import Candidate, Search, Step


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
