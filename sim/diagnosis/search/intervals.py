"""The numbers of the named causes with their 95 % intervals.

Three errors are allowed for: noise that is correlated within a block, an error of the model that differs from motion to
motion, and an error of the loop's form, which moves the numbers of the causes beside it alike in every motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.baselines.prandtl_ishlinskii.operators import play_run
from dehyst.sim.diagnosis.search.held_out import Split
from dehyst.sim.fitting.calibration import clipped_to_bounds
from dehyst.sim.fitting.stage_model import ModelFit
from dehyst.sim.readings.readings import Readings

#: Thresholds of the plays of a freer loop, in swings of the voltage.
_RADII = np.geomspace(0.004, 0.7, 14)
#: Factor on all intervals: 53 of 65 numbers on foreign stages lie within them without it, 59 with it
#: (docs/measurements/diagnosis.md).
WIDER = 1.5


@dataclass(frozen=True)
class ParameterErrors:
    """What is known of the errors of the m free parameters ``free`` of a fit.

    ``cover`` (m, m): covariance, from sums over blocks. ``moves`` (folds, m): how they move when a fold is left out.
    ``freer`` (m,): how they move beside a loop of free form.
    """

    fit: ModelFit
    free: NDArray[np.int64]
    cover: FloatArray
    moves: FloatArray
    freer: FloatArray


def parameter_errors(fit: ModelFit, mask: BoolArray, parts: Split, readings: Readings | None) -> ParameterErrors:
    """The errors of a fit, each from one linear step at its optimum."""
    parameters = fit.model.parameters
    free = np.array([i for i in fit.free if parameters[i].low < fit.p[i] < parameters[i].high], dtype=np.int64)
    scale = np.array([parameters[i].step for i in free])
    rows = fit.model.jacobian(fit.p, fit.signals, [int(i) for i in free]) * scale[:, None] * mask
    bread = np.linalg.pinv(rows @ rows.T, rcond=1e-12)
    scores = parts.blocks(rows * fit.residual_um)
    cover = bread @ (scores @ scores.T) @ bread * scale[:, None] * scale[None, :]
    # Directions that one fold alone determines keep the value from the whole record, as in `held_out`.
    size = np.sqrt(np.maximum(np.diag(rows @ rows.T), 1e-300))
    unit = rows / size[:, None]
    moves = []
    for k in range(parts.n_folds):
        inside = parts.samples(k)
        kept = unit[:, ~inside] @ unit[:, ~inside].T + 1e-4 * np.eye(free.size)
        moves.append(np.linalg.solve(kept, unit[:, ~inside] @ fit.residual_um[~inside]) / size * scale)
    freer = np.zeros(free.size)
    if readings is not None:
        columns = np.concatenate([unit, _freer_loop(readings) * mask])
        columns /= np.maximum(np.linalg.norm(columns, axis=1), 1e-300)[:, None]
        gram = columns @ columns.T + 1e-9 * np.eye(columns.shape[0])
        solved = np.linalg.solve(gram, columns @ (fit.residual_um * mask))
        # A linear step ends at the bounds of a number.
        moved = fit.p.copy()
        moved[free] += solved[: free.size] / size * scale
        freer = clipped_to_bounds(fit.model, moved)[free] - fit.p[free]
    return ParameterErrors(fit, free, cover, np.array(moves), freer)


def _freer_loop(readings: Readings) -> FloatArray:
    """(k, n) what a loop of free form can add: plays of many thresholds."""
    u, swing = readings.felt_V, readings.data.swing_V
    return play_run(u, _RADII * swing, np.full(_RADII.size, u[0])).T


def numbers(
    errors: ParameterErrors, index: int, wider: float = WIDER
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """The reported numbers of ``causes[index]`` with 95 % intervals.

    ``wider`` times the wider of the interval by the covariance over blocks and that by the fits that leave one fold out
    in turn (an error of the model that differs from motion to motion); about the number, and about that beside a loop
    of free form.
    """
    fit, folds = errors.fit, errors.moves.shape[0]
    spread = errors.moves - np.mean(errors.moves, axis=0)
    where = fit.model.slice_of(index)
    at = {int(j): row for row, j in enumerate(errors.free)}
    values: dict[str, float] = {}
    spans: dict[str, tuple[float, float]] = {}
    for name, (value, gradient) in (
        fit.model.causes[index].reported(fit.model.parameters_of(fit.p, index), fit.model.data).items()
    ):
        g = np.zeros(errors.free.size)
        for k, slope in enumerate(gradient):
            if where.start + k in at:
                g[at[where.start + k]] = slope
        half = 1.96 * float(np.sqrt(max(float(g @ errors.cover @ g), 0.0)))
        jackknife = float(np.sqrt((folds - 1) / folds * np.sum(np.square(spread @ g))))
        half = max(half, float(stats.t.ppf(0.975, folds - 1)) * jackknife)
        half = wider * half + fit.model.causes[index].unresolved(fit.model.data).get(name, 0.0)
        # A loop shape is itself what the free form would take over.
        other = value if fit.model.causes[index].approximates else value + float(g @ errors.freer)
        values[name] = value
        spans[name] = (min(value, other) - half, max(value, other) + half)
    return values, spans


def over_ties(
    values: dict[str, float], spans: dict[str, tuple[float, float]], name: str, ties: Iterable[ModelFit]
) -> dict[str, tuple[float, float]]:
    """The intervals of a cause ``name``, wide enough for fits that explain the recording as well (``ties``).

    About the number that the cause has beside another name of a second one, or that its own other name has.
    """
    out = dict(spans)
    for fit in ties:
        for i, cause in enumerate(fit.model.causes):
            # The last cause stands in the place of another; where ``name`` is missing, in the place of this one.
            stands_in = i + 1 == len(fit.model.causes) and all(c.name != name for c in fit.model.causes)
            if cause.name != name and not stands_in:
                continue
            for number, (value, _) in cause.reported(fit.model.parameters_of(fit.p, i), fit.model.data).items():
                if number in out:
                    low, high = spans[number]
                    off = value - values[number]
                    out[number] = (min(out[number][0], low + off), max(out[number][1], high + off))
    return out


def across_zero(errors: ParameterErrors, index: int) -> bool:
    """Whether the intervals of the reported numbers of ``causes[index]``, not widened, hold zero.

    Numbers that the nominal stage may give to it or take from it do not count.
    """
    _, spans = numbers(errors, index, 1.0)
    own = [span for name, span in spans.items() if name not in errors.fit.model.causes[index].shared]
    return bool(own) and all(low <= 0.0 <= high for low, high in own)
