"""Two stretches as one regression, cross-validated by blocks: what the frozen model always lacked, and what is new."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import BoolArray, FloatArray, InverseModel
from sim.changes.signatures import ChangeCause, Scales, Stretch, causes_of, frozen_answer, hum, slow

#: Length of a block, s, and number of folds: every fifth block is held out in turn.
BLOCK_S, FOLDS = 0.25, 5


@dataclass(frozen=True)
class ChangeRegression:
    """Both stretches as one regression.

    Attributes
    ----------
    r : (n,) applied voltage minus that of the frozen model, V.
    common : (n, k) columns that act in both stretches.
    causes : causes whose columns are zero in the reference.
    block : (n,) index of the block of each sample. recent : (n,) whether it belongs to the recent stretch.
    """

    r: FloatArray
    common: FloatArray
    causes: tuple[ChangeCause, ...]
    block: FloatArray
    recent: BoolArray

    def errors(self, chosen: tuple[int, ...]) -> FloatArray:
        """Held-out errors (n,) with the causes ``chosen``, each block predicted from the other folds."""
        x = np.column_stack([self.common, *(self.causes[i].columns for i in chosen)])
        x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-30)
        out = np.empty_like(self.r)
        for fold in range(FOLDS):
            test = self.block % FOLDS == fold
            beta = _solve(x[~test], self.r[~test])
            out[test] = self.r[test] - x[test] @ beta
        return out

    def by_block(self, errors: FloatArray) -> FloatArray:
        """Sum of squared ``errors`` (n,) in each block."""
        place = np.unique(self.block, return_inverse=True)[1]
        return np.asarray(np.bincount(place, weights=errors**2))

    def fit(self, chosen: tuple[int, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of all columns, their standard errors (by blocks: errors are correlated), the residual."""
        x = np.column_stack([self.common, *(self.causes[i].columns for i in chosen)])
        size = np.maximum(np.linalg.norm(x, axis=0), 1e-30)
        beta = _solve(x / size, self.r)
        left = self.r - (x / size) @ beta
        rows = (x / size) * left[:, None]
        place = np.unique(self.block, return_inverse=True)[1]
        scores = np.zeros((int(place.max()) + 1, x.shape[1]))
        np.add.at(scores, place, rows)
        bread = np.linalg.pinv((x / size).T @ (x / size), rcond=1e-10, hermitian=True)
        cover = bread @ (scores.T @ scores) @ bread
        return beta / size, np.sqrt(np.maximum(np.diag(cover), 0.0)) / size, left


def _solve(x: FloatArray, r: FloatArray) -> FloatArray:
    """Least squares of columns of unit norm, with a slight ridge for columns that the data cannot tell apart."""
    gram = x.T @ x
    return np.asarray(np.linalg.solve(gram + 1e-5 * np.eye(gram.shape[0]), x.T @ r))


class TooFewSamples(InputError):
    """A stretch, named ``stretch``, has too few usable samples."""

    def __init__(self, stretch: str, message: str) -> None:
        super().__init__(message)
        self.stretch = stretch


def require_enough(name: str, n: int, dt_s: float) -> None:
    """Raise TooFewSamples where ``n`` usable samples of the stretch ``name``, ``dt_s`` s apart, are not enough."""
    if n * dt_s < FOLDS * BLOCK_S or n < 200:
        raise TooFewSamples(
            name,
            f"{name}: got {n} usable samples ({n * dt_s:.3g} s) after those that settle the memory, expected "
            f"at least {FOLDS * BLOCK_S:g} s and 200: wait for more, or move further",
        )


def regression_of(
    model: InverseModel, reference: Stretch, recent: Stretch, scales: Scales
) -> tuple[ChangeRegression, FloatArray]:
    """The regression of both stretches, and its common columns (n, k). Raises TooFewSamples."""
    rows, targets, shared, marks, blocks = [], [], [], [], []
    found: list[ChangeCause] = []
    kept = np.empty(0, dtype=np.intp)
    first = 0
    for stretch, is_recent in ((reference, False), (recent, True)):
        base = frozen_answer(model, stretch, scales)
        found = causes_of(model, stretch, scales, base)
        own = [c.columns for c in found]
        keep = stretch.scored & base.certain
        name = "recent" if is_recent else "reference"
        require_enough(name, int(keep.sum()), stretch.dt_s)
        shared.append(np.column_stack([slow(stretch.motion[:, 0], stretch.dt_s, scales), *own])[keep])
        rows.append([c[keep] if is_recent else np.zeros_like(c[keep]) for c in own])
        targets.append((stretch.u_V - base.u_V)[keep])
        marks.append(np.full(int(keep.sum()), is_recent))
        index = first + np.arange(stretch.u_V.size) // max(1, round(BLOCK_S / stretch.dt_s))
        first = int(index[-1]) + 1
        blocks.append(index[keep])
        kept = np.flatnonzero(keep)
    common, r = np.vstack(shared), np.concatenate(targets)
    now = np.concatenate(marks)
    causes = [
        ChangeCause(c.name, c.alternatives, c.numbers, c.least, np.vstack([rows[0][i], rows[1][i]]))
        for i, c in enumerate(found)
    ]
    # A mains line is searched for in the residual of the recent stretch.
    left = np.zeros(recent.u_V.size)
    left[kept] = (r - common @ solve_scaled(common, r))[now]
    line = hum(recent, left)
    if line is not None:
        columns = np.zeros((r.size, 2))
        columns[now] = line.columns[kept]
        causes.append(ChangeCause(line.name, (), line.numbers, 0.0, columns))
    return ChangeRegression(r, common, tuple(causes), np.concatenate(blocks), now), common


def solve_scaled(x: FloatArray, r: FloatArray) -> FloatArray:
    """Coefficients (k,) of the least squares of columns (n, k) of any norm on ``r`` (n,)."""
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-30)
    return np.asarray(_solve(x / size, r) / size)
