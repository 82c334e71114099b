"""The diagonal of R^-1 in the Cholesky form, which a factor does not know: what leave-one-out needs of it.

From the factor alone it takes O(N³). Once known it follows a step in O(N²): with the column c = R^-1 e_k of a sample,

    it leaves:  d_i <- d_i - c_i²/c_k  (c of the factor before),
    it comes:   d_i <- d_i + c_i²/c_k, d_k = c_k  (c of the factor after).

Each step that carries it along also takes one element anew from the factor, in turn, so that none is older than a
round of the window and errors don't add up. Where nobody asks for a round it is let go, and steps are as fast as ever.
"""

from __future__ import annotations

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_pass import backward_columns
from adaptive.window_state import BITS, CARRIED, COUNT, CURSOR, DIAGONAL, MINUS, K, WindowArrays


@compiled_reassociating
def _half_column(A: WindowArrays, place: int, t: FloatArray) -> float:
    """t <- L^-1 e_place, by position: zero above ``place``. Returns its square, the diagonal element of R^-1."""
    n, total = A.C[COUNT], 0.0
    for i in range(n):
        t[i] = 0.0
    t[place] = 1.0
    for k in range(place, n):
        row = A.P[k]
        half = t[k] / row[k]
        t[k] = half
        total += half * half
        a, rest = row[k + 1 : n], t[k + 1 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a[i] * half
    return total


@compiled_reassociating
def _column(A: WindowArrays, place: int, out: FloatArray) -> None:
    """out <- R^-1 e, by slot, of the sample at ``place``."""
    t = A.V[MINUS]
    _half_column(A, place, t)
    backward_columns(A.P, A.C[COUNT], t)
    for i in range(A.C[COUNT]):
        out[A.order[i]] = t[i]


@compiled_reassociating
def prepare(A: WindowArrays, place: int) -> None:
    """Before the sample at ``place`` leaves the factor: its column, which `leave` needs, into BITS."""
    if A.C[CARRIED] > 0:
        _column(A, place, A.V[BITS])


@compiled_reassociating
def leave(A: WindowArrays, slot: int, n: int) -> None:
    """The sample of ``slot``, one of n, has left."""
    if A.C[CARRIED] > 0:
        c, d = A.V[BITS], A.V[DIAGONAL]
        own = c[slot]
        for j in range(n):
            d[j] -= c[j] * c[j] / own


@compiled_reassociating
def come(A: WindowArrays, slot: int) -> None:
    """A sample has come, into ``slot``, at the end of the factor. One element in turn is taken anew."""
    n = A.C[COUNT]
    if A.C[CARRIED] > 0:
        A.C[CARRIED] -= 1
        c, d = A.V[K], A.V[DIAGONAL]
        _column(A, n - 1, c)
        own = c[slot]
        for j in range(n):
            d[j] += c[j] * c[j] / own
        d[slot] = own
        turn = A.C[CURSOR] if A.C[CURSOR] < n else 0
        for place in range(n):
            if A.order[place] == turn:
                d[turn] = _half_column(A, place, A.V[MINUS])


@compiled_reassociating
def ask(A: WindowArrays) -> FloatArray:
    """The diagonal by slot; carried along from now on for as many steps as there are samples. O(N³) if not yet."""
    n = A.C[COUNT]
    d: FloatArray = A.V[DIAGONAL]
    if A.C[CARRIED] == 0:
        for place in range(n):
            d[A.order[place]] = _half_column(A, place, A.V[MINUS])
    A.C[CARRIED] = n
    return d
