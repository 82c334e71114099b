"""The inverse form of the window: products with P = R^-1, of which only the lower triangle is stored.

The rank-2 change of P that a step brings stays *pending*, as the vectors m (MINUS) and q (PLUS), until the next step
multiplies by P. One pass over the triangle then applies the change and multiplies, so that P is read and written once
a step. A step is refused by dropping its pending term. With a single triangle P cannot lose its symmetry, which is
what makes such recursions diverge.
"""

from __future__ import annotations

from dehyst.adaptive.compiled import compiled_reassociating, dot
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window.arrays import COUNT, MINUS, PENDING, PLUS, UNDO, UNDO_NOTHING, WindowArrays

#: From this size on four rows at a time are faster than two.
_FOUR_ROWS = 400

# --- The O(N²) passes over the triangle. Two or four rows go together, so that the vectors beside the matrix are read
# once for all of them. The order of the sums is fixed. Inner loops run from 0, some over slices: an index that could
# be negative would be checked for wrapping round, and the loop would not vectorise.


@compiled_reassociating
def advance(P: FloatArray, n: int, m: FloatArray, q: FloatArray, b: FloatArray, z: FloatArray) -> None:
    """P <- P - m m' + q q' and z <- P b with the new P, in one pass over its lower triangle, [:n, :n].

    Written out in one function: a call for each group of rows would cost a third of the time at N = 500.
    """
    for i in range(n):
        z[i] = 0.0
    i = 0
    if n >= _FOUR_ROWS:
        while i + 3 < n:
            m0, q0, b0, s0 = -m[i], q[i], b[i], 0.0
            m1, q1, b1, s1 = -m[i + 1], q[i + 1], b[i + 1], 0.0
            m2, q2, b2, s2 = -m[i + 2], q[i + 2], b[i + 2], 0.0
            m3, q3, b3, s3 = -m[i + 3], q[i + 3], b[i + 3], 0.0
            r0, r1, r2, r3 = P[i], P[i + 1], P[i + 2], P[i + 3]
            for j in range(i):
                mj, qj, bj = m[j], q[j], b[j]
                v0 = r0[j] + m0 * mj + q0 * qj
                v1 = r1[j] + m1 * mj + q1 * qj
                v2 = r2[j] + m2 * mj + q2 * qj
                v3 = r3[j] + m3 * mj + q3 * qj
                r0[j] = v0
                r1[j] = v1
                r2[j] = v2
                r3[j] = v3
                s0 += v0 * bj
                s1 += v1 * bj
                s2 += v2 * bj
                s3 += v3 * bj
                z[j] += v0 * b0 + v1 * b1 + v2 * b2 + v3 * b3
            z[i] += s0
            z[i + 1] += s1
            z[i + 2] += s2
            z[i + 3] += s3
            for k in range(i, i + 4):
                for j in range(i, k + 1):
                    v = P[k, j] - m[k] * m[j] + q[k] * q[j]
                    P[k, j] = v
                    z[k] += v * b[j]
                    if j < k:
                        z[j] += v * b[k]
            i += 4
    while i + 1 < n:
        m0, q0, b0, s0 = -m[i], q[i], b[i], 0.0
        m1, q1, b1, s1 = -m[i + 1], q[i + 1], b[i + 1], 0.0
        r0, r1 = P[i], P[i + 1]
        for j in range(i):
            mj, qj, bj = m[j], q[j], b[j]
            v0 = r0[j] + m0 * mj + q0 * qj
            v1 = r1[j] + m1 * mj + q1 * qj
            r0[j] = v0
            r1[j] = v1
            s0 += v0 * bj
            s1 += v1 * bj
            z[j] += v0 * b0 + v1 * b1
        v0 = r0[i] + m0 * m[i] + q0 * q[i]
        v1 = r1[i] + m1 * m[i] + q1 * q[i]
        v2 = r1[i + 1] + m1 * m[i + 1] + q1 * q[i + 1]
        r0[i] = v0
        r1[i] = v1
        r1[i + 1] = v2
        z[i] += s0 + v0 * b0 + v1 * b1
        z[i + 1] += s1 + v1 * b0 + v2 * b1
        i += 2
    if i < n:
        m0, q0, b0, s0 = -m[i], q[i], b[i], 0.0
        r0 = P[i]
        for j in range(i):
            v0 = r0[j] + m0 * m[j] + q0 * q[j]
            r0[j] = v0
            s0 += v0 * b[j]
            z[j] += v0 * b0
        v0 = r0[i] + m0 * m[i] + q0 * q[i]
        r0[i] = v0
        z[i] += s0 + v0 * b0


@compiled_reassociating
def product(P: FloatArray, n: int, b: FloatArray, z: FloatArray) -> None:
    """z <- P b from the lower triangle of P[:n, :n]; P is only read."""
    for i in range(n):
        z[i] = 0.0
    i = 0
    while i + 1 < n:
        b0, b1, s0, s1 = b[i], b[i + 1], 0.0, 0.0
        r0, r1 = P[i], P[i + 1]
        for j in range(i):
            s0 += r0[j] * b[j]
            s1 += r1[j] * b[j]
            z[j] += r0[j] * b0 + r1[j] * b1
        z[i] += s0 + r0[i] * b0 + r1[i] * b1
        z[i + 1] += s1 + r1[i] * b0 + r1[i + 1] * b1
        i += 2
    if i < n:
        b0, s0 = b[i], 0.0
        r0 = P[i]
        for j in range(i):
            s0 += r0[j] * b[j]
            z[j] += r0[j] * b0
        z[i] += s0 + r0[i] * b0


# --- P with its pending change.


@compiled_reassociating
def add_scaled(a: FloatArray, factor: float, b: FloatArray, n: int) -> None:
    """a <- a + factor b over the first n elements."""
    for j in range(n):
        a[j] += factor * b[j]


@compiled_reassociating
def multiply(A: WindowArrays, b: FloatArray, z: FloatArray) -> None:
    """Apply the pending change, and z <- P b over the slots in use. The last step can't be undone after this."""
    n = A.C[COUNT]
    minus, plus = A.V[MINUS], A.V[PLUS]
    if A.C[PENDING] != 0:
        advance(A.P, n, minus, plus, b, z)
        for j in range(n):
            minus[j] = 0.0
            plus[j] = 0.0
        A.C[PENDING] = 0
    else:
        product(A.P, n, b, z)
    A.C[UNDO] = UNDO_NOTHING


@compiled_reassociating
def solve(A: WindowArrays, b: FloatArray, z: FloatArray) -> None:
    """z <- R^-1 b. The pending change is taken into account, but stays pending."""
    n = A.C[COUNT]
    product(A.P, n, b, z)
    if A.C[PENDING] != 0:
        minus, plus = A.V[MINUS], A.V[PLUS]
        add_scaled(z, -dot(minus, b, n), minus, n)
        add_scaled(z, dot(plus, b, n), plus, n)


@compiled_reassociating
def lift_column(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """p <- P e_slot, and set that row and column to zero: the next pass then writes the new ones exactly."""
    n, row = A.C[COUNT], A.P[slot]
    for j in range(slot + 1):
        p[j] = row[j]
        row[j] = 0.0
    for i in range(slot + 1, n):
        p[i] = A.P[i, slot]
        A.P[i, slot] = 0.0


@compiled_reassociating
def lower_column(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """Write back a column that `lift_column` took out."""
    for j in range(slot + 1):
        A.P[slot, j] = p[j]
    for i in range(slot + 1, A.C[COUNT]):
        A.P[i, slot] = p[i]


@compiled_reassociating
def diagonal(A: WindowArrays, out: FloatArray) -> None:
    """out <- the diagonal of R^-1 by slot, the pending change included."""
    P, minus, plus, pending = A.P, A.V[MINUS], A.V[PLUS], A.C[PENDING] != 0
    for i in range(A.C[COUNT]):
        out[i] = P[i, i]
        if pending:
            out[i] += plus[i] ** 2 - minus[i] ** 2
