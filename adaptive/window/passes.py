"""The passes over one stored triangle that decide what a step of the window costs.

Everything that is O(N²) in an update is here. Two or four rows go together, so that the vectors beside the
matrix are read once for all of them; sums may be reordered, the same way each time. Loops run from 0 over
slices: an index that could be negative would have to be checked for wrapping round, and not vectorise.
"""

from __future__ import annotations

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray

#: From this size four rows at a time beat two.
_FOUR_ROWS = 400


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


@compiled_reassociating
def quadratic(P: FloatArray, n: int, k: FloatArray) -> float:
    """k' P k from the lower triangle of P[:n, :n]; half the arithmetic of a product, and P is only read.

    Nothing but the reading of P costs time: eight rows at a time are as many streams as the processor fetches ahead.
    """
    total, i = 0.0, 0
    while i + 7 < n:
        s0, s1, s2, s3, s4, s5, s6, s7 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        r0, r1, r2, r3 = P[i], P[i + 1], P[i + 2], P[i + 3]
        r4, r5, r6, r7 = P[i + 4], P[i + 5], P[i + 6], P[i + 7]
        for j in range(i):
            kj = k[j]
            s0 += r0[j] * kj
            s1 += r1[j] * kj
            s2 += r2[j] * kj
            s3 += r3[j] * kj
            s4 += r4[j] * kj
            s5 += r5[j] * kj
            s6 += r6[j] * kj
            s7 += r7[j] * kj
        total += 2.0 * (s0 * k[i] + s1 * k[i + 1] + s2 * k[i + 2] + s3 * k[i + 3])
        total += 2.0 * (s4 * k[i + 4] + s5 * k[i + 5] + s6 * k[i + 6] + s7 * k[i + 7])
        for r in range(i, i + 8):
            s0 = 0.0
            for j in range(i, r):
                s0 += P[r, j] * k[j]
            total += (2.0 * s0 + P[r, r] * k[r]) * k[r]
        i += 8
    while i < n:
        s0 = 0.0
        r0 = P[i]
        for j in range(i):
            s0 += r0[j] * k[j]
        total += k[i] * (2.0 * s0 + r0[i] * k[i])
        i += 1
    return total


@compiled_reassociating
def forward_columns(P: FloatArray, n: int, b: FloatArray) -> None:
    """b <- L^-1 b in place, L' in the upper triangle of P[:n, :n]; two columns at a time."""
    k = 0
    while k + 1 < n:
        r0, r1 = P[k], P[k + 1]
        t0 = b[k] / r0[k]
        t1 = (b[k + 1] - r0[k + 1] * t0) / r1[k + 1]
        b[k] = t0
        b[k + 1] = t1
        a0, a1, rest = r0[k + 2 : n], r1[k + 2 : n], b[k + 2 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a0[i] * t0 + a1[i] * t1
        k += 2
    if k < n:
        b[k] /= P[k, k]


@compiled_reassociating
def backward_columns(P: FloatArray, n: int, b: FloatArray) -> None:
    """b <- L'^-1 b in place, L' in the upper triangle of P[:n, :n]; two rows at a time."""
    k = n - 1
    while k >= 1:
        r0, r1 = P[k - 1], P[k]
        s0, s1 = 0.0, 0.0
        a0, a1, rest = r0[k + 1 : n], r1[k + 1 : n], b[k + 1 : n]
        for i in range(rest.shape[0]):
            s0 += a0[i] * rest[i]
            s1 += a1[i] * rest[i]
        b[k] = (b[k] - s1) / r1[k]
        b[k - 1] = (b[k - 1] - s0 - r0[k] * b[k]) / r0[k - 1]
        k -= 2
    if k == 0:
        r0, s0 = P[0], 0.0
        for i in range(1, n):
            s0 += r0[i] * b[i]
        b[0] = (b[0] - s0) / r0[0]


@compiled_reassociating
def shift_columns(P: FloatArray, n: int, position: int, b: FloatArray) -> None:
    """The columns of L before ``position`` lose that row, and take their part in b <- L^-1 b."""
    for k in range(position):
        row = P[k]
        t = b[k] / row[k]
        b[k] = t
        a, rest = row[k + 1 : position], b[k + 1 : position]
        for i in range(rest.shape[0]):
            rest[i] -= a[i] * t
        to, rest = row[position : n - 1], b[position : n - 1]
        for i in range(rest.shape[0]):
            to[i] = row[position + 1 + i]
        for i in range(rest.shape[0]):
            rest[i] -= to[i] * t


@compiled_reassociating
def rotate_column(
    old: FloatArray, new: FloatArray, x: FloatArray, b: FloatArray, cosine: float, sine: float, t: float
) -> None:
    """One rotation of the rank-1 update over the rest of a column, and that column's part in b <- L^-1 b."""
    for i in range(x.shape[0]):
        before, other = old[i], x[i]
        after = cosine * before + sine * other
        x[i] = cosine * other - sine * before
        new[i] = after
        b[i] -= after * t
