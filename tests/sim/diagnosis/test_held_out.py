"""The held-out error against refits without each fold, and what cannot be held out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.search.held_out import Split, held_out
from dehyst.sim.effects.hysteresis_shape import HysteresisShape
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import ModelFit, Signals, StageModel

N = 2000
PARTS = Split(np.arange(21) * 100, np.arange(20) % 4)
MASK = np.ones(N, dtype=np.bool_)
RNG = np.random.default_rng(5)
NOISE = 0.1 * RNG.standard_normal(N)
WIDE = RNG.standard_normal((2, N))


def fitted(columns: dict[str, FloatArray], y: FloatArray) -> ModelFit:
    """The linear model of ``y`` with these named columns, at its least-squares optimum."""
    rows = np.array(list(columns.values()))
    p = np.linalg.lstsq(rows.T, y, rcond=None)[0]
    model = cast(StageModel, SimpleNamespace(parameters=tuple(SimpleNamespace(name=name) for name in columns)))
    left = y - p @ rows
    which = tuple(range(p.size))
    return ModelFit(model, p, cast(Signals, None), left, float(left @ left), list(which), rows, which)


def refitted(columns: dict[str, FloatArray], y: FloatArray) -> float:
    """Squared error in each fold of a fit to the other folds."""
    rows, total = np.array(list(columns.values())), 0.0
    for fold in range(4):
        inside = PARTS.samples(fold)
        p = np.linalg.lstsq(rows[:, ~inside].T, y[~inside], rcond=None)[0]
        total += float(np.sum(np.square(y[inside] - p @ rows[:, inside])))
    return total


def in_fold(fold: int, share: float) -> FloatArray:
    """A column of which this fold holds ``share`` of the squares."""
    inside = PARTS.samples(fold)
    column = np.where(inside, np.sqrt(share / 0.25), np.sqrt((1.0 - share) / 0.75)) * RNG.standard_normal(N)
    return np.asarray(column)


def test_the_held_out_error_of_a_linear_model_is_that_of_refits_without_each_fold() -> None:
    columns = {"a": WIDE[0], "b": WIDE[1], "mostly_in_one_fold": in_fold(1, 0.9)}
    y = 0.3 * WIDE[0] + NOISE
    fit = fitted(columns, y)
    more = held_out(fit, MASK, PARTS).sse_um2 - fit.sse_um2
    assert more == pytest.approx(refitted(columns, y) - fit.sse_um2, rel=0.01)


def test_a_number_that_one_fold_alone_shows_is_not_refitted_without_it() -> None:
    """What the model leaves elsewhere acts on one part in two thousand of the column, and a refit on nothing else."""
    column = in_fold(1, 0.9995)
    y = 0.3 * WIDE[0] + NOISE + np.where(PARTS.samples(1), 0.0, 0.5 * column)
    columns = {"a": WIDE[0], "knot": column}
    known = float(np.linalg.lstsq(np.array([WIDE[0], column]).T, y, rcond=None)[0][1])
    wide = held_out(fitted({"a": WIDE[0]}, y - known * column), MASK, PARTS).sse_um2
    assert held_out(fitted(columns, y), MASK, PARTS).sse_um2 == pytest.approx(wide, rel=1e-3)
    assert refitted(columns, y) > 5.0 * wide


def test_where_a_local_memory_starts_is_not_held_out() -> None:
    """Only the first motion of the record shows it."""
    form = HysteresisShape(variant="local")
    data = FitData(1e-3, np.sin(np.arange(N) / 50.0), np.sin(np.arange(N) / 50.0))
    (start,) = (s.name for s in form.parameters(data) if "start" in s.name)
    y = 0.3 * WIDE[0] + NOISE
    column = in_fold(0, 0.8)
    known = float(np.linalg.lstsq(np.array([WIDE[0], column]).T, y, rcond=None)[0][1])
    wide = held_out(fitted({"a": WIDE[0]}, y - known * column), MASK, PARTS).sse_um2
    assert held_out(fitted({"a": WIDE[0], start: column}, y), MASK, PARTS).sse_um2 == pytest.approx(wide, rel=1e-6)
