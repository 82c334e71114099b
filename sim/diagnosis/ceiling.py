"""How much of a recording is explainable at all: a black box, tested on the same folds as the causes.

It predicts what the nominal stage leaves. Its columns are the motion with powers and plays, products of both with the
motion, slow lags, the other drives, and what the causes found explain, behind one lag that is chosen on a grid. Each
fold is predicted from the others. What it leaves bounds what a named cause can claim; it says nothing of a cause.
"""

from __future__ import annotations

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.causes.drive import lag_ends
from sim.diagnosis.causes.motion import slow_poles
from sim.diagnosis.model.calibration import ModelFit
from sim.diagnosis.model.fit_data import FitData
from sim.diagnosis.model.hysteresis_loops import play_of
from sim.diagnosis.parallel import side_by_side
from sim.diagnosis.search.held_out import Split

_RADII = np.array([0.01, 0.025, 0.045, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32, 0.4, 0.5, 0.62, 0.76, 0.9])
_TAUS_S = (0.1, 1.0, 10.0, 100.0)
_LAGS_S = (0.0, 1e-3, 2e-3, 3e-3, 5e-3, 8e-3, 15e-3)
#: Share of the mean squared column that keeps the solution small; the best of these by held-out error counts.
_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2)
#: Most samples of one fit: enough for sixty columns.
_MOST = 40_000


def black_box_error(nominal: ModelFit, extended: ModelFit, mask: BoolArray, parts: Split) -> float:
    """RMS error (µm) of the black box on folds that it was not fitted to.

    ``nominal`` and ``extended`` are two models on one recording; ``mask`` (n,) is False where a sample does not count;
    ``parts`` holds the folds.
    """
    data = nominal.model.data
    target = nominal.residual_um
    models = [target - extended.residual_um, nominal.signals.reading_um - data.middle_um]
    # Dead zones of the displacement, behind the mechanics and before them.
    still = nominal.signals.static_um[:: nominal.model.substeps]
    for moved in (nominal.signals.reading_um, still):
        knees = np.linspace(float(np.min(moved)), float(np.max(moved)), 8)[1:-1]
        models += [np.maximum(moved - knee, 0.0) for knee in knees]
    models += [np.gradient(nominal.signals.reading_um), np.gradient(np.gradient(nominal.signals.reading_um))]
    fold = np.repeat(parts.fold, np.diff(parts.edges))
    thin = max(1, int(mask.sum()) // _MOST)
    use = np.flatnonzero(mask)[::thin]
    fold, y = fold[use], target[use]

    def error(lag_s: float) -> float:
        columns = np.array([row[use] for row in (*_columns(data, lag_s), *models)])
        columns /= np.maximum(np.sqrt(np.mean(np.square(columns), axis=1)), 1e-300)[:, None]
        grams, slopes = [], []
        for k in range(parts.n_folds):
            part = columns[:, fold == k]
            grams.append(part @ part.T)
            slopes.append(part @ y[fold == k])
        gram, slope = np.sum(np.array(grams), axis=0), np.sum(np.array(slopes), axis=0)
        best = np.inf
        for ridge in _RIDGES:
            left = 0.0
            for k in range(parts.n_folds):
                inside = fold == k
                system = gram - grams[k] + ridge * use.size * np.eye(gram.shape[0])
                weights = np.linalg.solve(system, slope - slopes[k])
                left += float(np.sum(np.square(y[inside] - weights @ columns[:, inside])))
            best = min(best, left)
        return float(np.sqrt(best / use.size))

    return min(side_by_side(error, _LAGS_S))


def _columns(data: FitData, lag_s: float) -> list[FloatArray]:
    """Columns of the black box behind one lag, (n,) each."""
    u = data.u_V if lag_s == 0.0 else np.asarray(lag_ends(data.u_V, lag_s / data.dt_s, False))
    u = np.ascontiguousarray(u)
    x = (u - 0.5 * (data.u_low_V + data.u_high_V)) / max(0.5 * data.swing_V, 1e-12)
    plays = [play_of(u, float(r) * data.swing_V) / max(data.swing_V, 1e-12) for r in _RADII]
    rows = [np.ones(data.n), x, x**2, x**3, *plays, *(x * p for p in plays[::2])]
    # The readings of neighbouring samples: latency, and the rate.
    rows += [np.concatenate([np.full(k, x[0]), x[: data.n - k]]) for k in (1, 2, 4, 8)]
    rows += list(slow_poles(x, data.dt_s / np.array(_TAUS_S)))
    for other in (data.u2_V, data.u3_V):
        if other is not None:
            rows.append((other - other.mean()) / max(float(np.ptp(other)), 1e-12))
    t = np.linspace(-1.0, 1.0, data.n)
    return [*rows, t, t**2, t * x]
