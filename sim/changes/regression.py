"""Two stretches as one regression: what the frozen model never held, and what has come since, fold by fold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import BoolArray, FloatArray, InverseModel
from sim.changes.columns import Candidate, Scales, Stretch, base_of, candidates, hum, slow

#: Blocks are this long, s; every fifth is held out in turn.
BLOCK_S, FOLDS = 0.25, 5


@dataclass(frozen=True)
class Problem:
    """Both stretches as one regression: targets, common columns, the causes' (zero before), blocks and folds."""

    r: FloatArray
    common: FloatArray
    causes: tuple[Candidate, ...]
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
        """Sums of squares over each block, of both stretches: what is common to them would take half of a change."""
        place = np.unique(self.block, return_inverse=True)[1]
        return np.asarray(np.bincount(place, weights=errors**2))

    def fit(self, chosen: tuple[int, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of all columns, their standard errors (by blocks, errors being correlated), and what is left."""
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
    """Least squares of columns of unit norm, a trace of ridge against those that this data cannot tell apart."""
    gram = x.T @ x
    return np.asarray(np.linalg.solve(gram + 1e-5 * np.eye(gram.shape[0]), x.T @ r))


class TooFewSamples(InputError):
    """A stretch holds too few usable samples; ``stretch`` is its name. More of it may be enough."""

    def __init__(self, stretch: str, message: str) -> None:
        super().__init__(message)
        self.stretch = stretch


def enough(name: str, n: int, dt_s: float) -> None:
    """TooFewSamples where ``n`` usable samples of the stretch ``name`` are not enough to judge by."""
    if n * dt_s < FOLDS * BLOCK_S or n < 200:
        raise TooFewSamples(
            name,
            f"{name}: got {n} usable samples ({n * dt_s:.3g} s) after what only settles the loop's memory, expected at "
            f"least {FOLDS * BLOCK_S:g} s and 200: wait for more, or move further",
        )


def problem_of(model: InverseModel, reference: Stretch, recent: Stretch, scales: Scales) -> tuple[Problem, FloatArray]:
    """The regression of both stretches, and its common columns (n, k). TooFewSamples where either is too short."""
    rows, targets, shared, marks, blocks = [], [], [], [], []
    found: list[Candidate] = []
    kept = np.empty(0, dtype=np.intp)
    first = 0
    for stretch, is_recent in ((reference, False), (recent, True)):
        base = base_of(model, stretch, scales)
        found = candidates(model, stretch, scales, base)
        own = [c.columns for c in found]
        keep = stretch.scored & base.sure
        name = "recent" if is_recent else "reference"
        enough(name, int(keep.sum()), stretch.dt_s)
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
        Candidate(c.name, c.alternatives, c.numbers, c.least, np.vstack([rows[0][i], rows[1][i]]))
        for i, c in enumerate(found)
    ]
    # A mains line is sought in what the rest leaves of the recent stretch.
    left = np.zeros(recent.u_V.size)
    left[kept] = (r - common @ solve_scaled(common, r))[now]
    line = hum(recent, left)
    if line is not None:
        columns = np.zeros((r.size, 2))
        columns[now] = line.columns[kept]
        causes.append(Candidate(line.name, (), line.numbers, 0.0, columns))
    return Problem(r, common, tuple(causes), np.concatenate(blocks), now), common


def solve_scaled(x: FloatArray, r: FloatArray) -> FloatArray:
    """Least squares of columns (n, k) of any size to ``r`` (n,): (k,)."""
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-30)
    return np.asarray(_solve(x / size, r) / size)
