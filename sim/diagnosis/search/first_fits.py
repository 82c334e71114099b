"""From a linearised guess of a cause to its first joint fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.causes.restoring_force import RestoringLoop
from sim.diagnosis.causes.slips import Slips, placed
from sim.diagnosis.model.chain import Model
from sim.diagnosis.model.fit import Fit, calibrate, evaluate, within
from sim.diagnosis.model.forms import Form


def first_fits(form: Form, guess: FloatArray, base: Fit, mask: BoolArray) -> tuple[Form, list[Fit]]:
    """A few steps of the joint fit of ``base`` and ``form``, with each hold that suits; the form as it was fitted.

    ``guess`` holds the form's numbers as the linearised look at the residual found them.
    """
    other = replace(base.model, nominal=base.model.nominal.with_other_hold())
    if isinstance(form, Slips):
        fits = [placed(form, model, base, mask) for model in (base.model, other)]
        # Half a slip is the hold's doing: whole ones go first.
        whole = [f for f in fits if f.model.forms[-1].plausible(f.p[base.p.size :], f.model.setting)]
        best = min(whole or fits, key=lambda f: f.sse_um2)
        return best.model.forms[-1], [best]
    if isinstance(form, RestoringLoop):
        return form, [_giving_way(form, base, guess, mask)]
    fits = [_quick(base.model.plus(form), base, guess, mask)]
    if form.fast:
        fits.append(_quick(other.plus(form), base, guess, mask))
    return form, fits


def _quick(model: Model, base: Fit, guess: FloatArray, mask: BoolArray) -> Fit:
    """From a linearised guess, or from beside neutral where that overshot."""
    start = np.concatenate([base.p, guess])
    if evaluate(model, within(model, start), mask).sse_um2 > base.sse_um2:
        slots = model.forms[-1].slots(model.setting)
        linear = np.array([s.steady for s in slots])
        neutral = np.array([s.neutral for s in slots])
        start[base.p.size :] = np.where(linear, neutral, guess)
    return calibrate(model, start, mask, 8, 2e-3, known=base.columns())


def _giving_way(form: RestoringLoop, base: Fit, guess: FloatArray, mask: BoolArray) -> Fit:
    """From the best of a grid in which the nominal stage's mode gives way to the loop."""
    model = base.model.plus(form)
    names = tuple(slot.name for slot in model.slots[: model.n_nominal])
    between = base.p[model.n_nominal :]
    starts = [np.concatenate([base.p, guess])]
    for p in form.together(base.p[: model.n_nominal], names, model.setting):
        own = p.size - guess.size
        starts.append(np.concatenate([p[:own], between, p[own:]]))
    tried = [(evaluate(model, within(model, p), mask).sse_um2, i) for i, p in enumerate(starts)]
    order = [i for sse, i in sorted(tried) if np.isfinite(sse)][:2]
    return min((calibrate(model, starts[i], mask, 12, 2e-3) for i in order), key=lambda f: f.sse_um2)
