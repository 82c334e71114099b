"""The explicit state of a sliding window: plain arrays that compiled code of any module can take and step.

A window of ``N`` slots with d features and p unpenalised coefficients is one `WindowArrays`, a tuple of
arrays. Nothing else is hidden anywhere: copying the arrays copies the window. Only the first
``C[COUNT]`` slots are in use. Rows of ``V``, and elements of ``F`` and ``C``, go by the names below.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray

IntArray = NDArray[np.int64]


class WindowArrays(NamedTuple):
    """State of a window; see `adaptive.window.window` for what it means and `allocate` for how it starts.

    P : (N, N) lower triangle of R^-1 *before* the pending rank-2 term P - m m' + q q' (rows MINUS and PLUS of
        V). In the Cholesky form the upper triangle holds L' with R = L L' in the order of ``order``; the strictly
        lower one keeps it as it was before the last replacement, its diagonal in row PK of V.
    R : (N, N) Omega + diag(1/(gamma w)), both triangles.
    X : (d, N) features.  scaled : (d, N) features divided by their widths.  inverse_widths : (d,).
    H : (p, N) design.  S : (p, N) P H; in the Cholesky form L^-1 H, by position.  G : (p, p) lower factor of H'PH.
    beta : (p,).  linear : (p - 1,) features in the linear part.
    V : (ROWS, N) vectors.  U : (p + 4, max(N, p + d)) what `undo` needs.  F : floats.  C : counters.
    order : (N,) slot at each position of the factor (Cholesky form).  small : (3, max(d, p)) scratch.
    """

    P: FloatArray
    R: FloatArray
    X: FloatArray
    scaled: FloatArray
    inverse_widths: FloatArray
    H: FloatArray
    S: FloatArray
    G: FloatArray
    beta: FloatArray
    linear: IntArray
    V: FloatArray
    U: FloatArray
    F: FloatArray
    C: IntArray
    order: IntArray
    small: FloatArray


# Rows of V. SY is P y (Cholesky form: L^-1 y, by position); MINUS and PLUS are the pending rank-2 term; PK is
# the column that the last replacement took out of P; DIAGONAL that of R^-1 by slot, where the Cholesky form carries it
# along (C[CARRIED]); the rest is scratch.
Y, W, ALPHA, SY, MINUS, PLUS, COLUMN, Z, PK, BITS, TRIAL, K, DIAGONAL = range(13)
ROWS = 13

# Elements of F.
GAMMA, RESIDUAL, ROUND_WORST, LAST_WORST, UNDO_Y, UNDO_W, TOLERANCE, PIVOT = range(8)
FLOATS = 8

# Elements of C. UNDO_PLACE: where in the factor the replaced sample stood. CARRIED: for how many more steps the
# Cholesky form carries DIAGONAL along; 0 where it does not know it.
(
    COUNT,
    FORM,
    PENDING,
    UNDO,
    UNDO_SLOT,
    CURSOR,
    STEPS,
    BAD_INPUTS,
    ILL_STEPS,
    RESIDUALS_EXCEEDED,
    REFINEMENTS,
    REFRESHES,
    UNDONE,
    ROUNDS,
    UNDO_PLACE,
    CARRIED,
) = range(16)
COUNTERS = 16

#: The counters that add up over a window's life.
EVENTS = slice(STEPS, UNDO_PLACE)

#: Largest size of a feature or a target that is taken: they are normalised, of order 1. Of a window that has held much
#: larger ones, all digits are theirs; with this one a step of refinement brings the others back.
MOST = 1e9
#: gamma w, one over the noise variance of a sample: outside of these double precision has no digit for noise or kernel.
LEAST_PRECISION, MOST_PRECISION = 1e-15, 1e15
#: Least and most that targets may be scaled by at once.
LEAST_FACTOR, MOST_FACTOR = 1e-9, 1e9

#: A refinement that leaves more than this share of the residual that asked for it shows an inverse gone wrong.
CONTRACTION = 0.5
#: ... unless it is this small beside target and weights: where hardly more samples than linear terms are held, alpha is
#: nearly nothing, and what is left is rounding.
NEGLIGIBLE = 1e-13
#: The Schur complement of a new sample is at least its noise variance 1/(gamma w); below this share of it, P is wrong.
SCHUR_SHARE = 0.5
#: An unpenalised column whose pivot falls below this share is not told apart by the samples: its coefficient is 0.
PIVOT_SHARE = 1e-11
#: A sample without which the unpenalised part is not determined leaves nothing of its diagonal but rounding.
UNDETERMINED = 1e-13
#: A few units in the last place of the terms of a row's residual.
ROUND_OFF = 1e-15

# Values of C[UNDO].
UNDO_NOTHING, UNDO_REPLACE, UNDO_APPEND = range(3)

# Values of C[FORM].
INVERSE_FORM, CHOLESKY_FORM = range(2)


class Status(IntEnum):
    """How a step of the window ended. All but ACCEPTED leave the window as it was."""

    ACCEPTED = 0
    #: A value that is not finite or larger than MOST, a weight that is not positive or whose noise is out of range.
    BAD_INPUT = 1
    #: The step would have left the finite numbers or lost positive definiteness.
    ILL_CONDITIONED = 2
    #: No such slot: out of range, a full window appended to, an empty one shrunk.
    NO_SLOT = 3
    #: `undo` has nothing to take back.
    NOTHING_TO_UNDO = 4


ACCEPTED, BAD_INPUT, ILL_CONDITIONED, NO_SLOT, NOTHING_TO_UNDO = range(5)


def allocate(
    capacity: int, widths: FloatArray, gamma: float, linear: tuple[int, ...], tolerance: float, form: int
) -> WindowArrays:
    """An empty window of ``capacity`` slots. All arrays are C-ordered; nothing is allocated after this.

    ``widths`` (d,), ``tolerance``: relative error of alpha from which a step is followed by a refinement.
    """
    dimension, p = widths.size, 1 + len(linear)
    F = np.zeros(FLOATS)
    F[GAMMA], F[TOLERANCE] = gamma, tolerance
    C = np.zeros(COUNTERS, dtype=np.int64)
    C[FORM] = form
    return WindowArrays(
        P=np.zeros((capacity, capacity)),
        R=np.zeros((capacity, capacity)),
        X=np.zeros((dimension, capacity)),
        scaled=np.zeros((dimension, capacity)),
        inverse_widths=1.0 / widths,
        H=np.zeros((p, capacity)),
        S=np.zeros((p, capacity)),
        G=np.zeros((p, p)),
        beta=np.zeros(p),
        linear=np.array(linear, dtype=np.int64),
        V=np.zeros((ROWS, capacity)),
        U=np.zeros((p + 4, max(capacity, p + dimension))),
        F=F,
        C=C,
        order=np.arange(capacity, dtype=np.int64),
        small=np.zeros((3, max(dimension, p))),
    )


def duplicate(arrays: WindowArrays) -> WindowArrays:
    """An independent copy of the whole state."""
    return WindowArrays(**{name: field.copy() for name, field in arrays._asdict().items()})


def take_over(arrays: WindowArrays, source: WindowArrays) -> None:
    """Write the state of ``source``, a window of the same sizes, into ``arrays`` in place."""
    for field, kept in zip(arrays, source, strict=True):
        field[...] = kept
