"""From accepted causes to what is said: their numbers with intervals, the verdict, and what the record cannot show."""

from __future__ import annotations

import numpy as np

from sim.diagnosis.causes.catalogue import NAMES
from sim.diagnosis.model.fit import Fit
from sim.diagnosis.report.result import Cause
from sim.diagnosis.search.evidence import HeldOut
from sim.diagnosis.search.noise_floor import Floor
from sim.diagnosis.search.search import Found, Search


def named(search: Search, nominal: Fit, extended: Fit, held: HeldOut, found: list[Found]) -> tuple[Cause, ...]:
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


def verdict_of(causes: tuple[Cause, ...], nominal: HeldOut, extended: HeldOut, floor: Floor, n: int) -> str:
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
    seen.setdefault("quantisation", True)
    return tuple(name for name in NAMES if not seen.get(name, False))
