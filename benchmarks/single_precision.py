"""Would an inverse in single precision, with refinement, serve the windows of a fleet?

``python -m benchmarks.single_precision [--window 60] [--steps 1000000] [--gamma 1000] [--precision float64]``

One window of the inverse form, whose P is float32 (or float64, to check the comparison), and all else float64: R,
targets, S = P 1 and P y. Each step replaces the oldest sample by the next of a slow random motion (5 inputs, targets of
size 1 with noise). Two ways are compared over all steps: ``checked`` refines S and P y with R, by one step, where the
residual of the next row exceeds the learner's tolerance; ``always`` refines them at each step. Every hundredth of the
run the prediction at new points is compared with that of an exact solution. Printed are the largest difference, and
the share of the steps that refined. A run ends where the difference exceeds the size of the targets.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from adaptive import kernels
from adaptive.compiled import compiled
from adaptive.types import FloatArray
from adaptive.window.inverse_form import advance, product
from adaptive.window.window import WindowConfig

_INPUTS = 5


@compiled
def _refine(P: FloatArray, R: FloatArray, target: FloatArray, x: FloatArray) -> None:
    """x <- x + P (target - R x), P in single precision."""
    n = x.size
    correction = np.empty(n, dtype=P.dtype)
    product(P, n, (target - R @ x).astype(P.dtype), correction)
    x += correction


@compiled
def run(
    P: FloatArray, R: FloatArray, X: FloatArray, y: FloatArray, S: FloatArray, Sy: FloatArray, new: FloatArray,
    targets: FloatArray, noise: float, share: float, always: bool, first: int,
) -> int:  # fmt: skip
    """Steps over the samples ``new`` (k, d), scaled, with ``targets`` (k,); returns how many of them refined."""
    n, refined, ones = y.size, 0, np.ones(y.size)
    m, pending, column, z = np.zeros(n, P.dtype), np.zeros(n, P.dtype), np.zeros(n, P.dtype), np.zeros(n, P.dtype)
    for k in range(new.shape[0]):
        slot = (first + k) % n
        b = np.exp(-((X - new[k]) ** 2).sum(1))
        b[slot] = 0.0
        column[:] = b
        advance(P, n, m, pending, column, z)
        p = np.concatenate((P[slot, :slot], P[slot:, slot])).astype(np.float64)
        q = z.astype(np.float64) - p * (p @ b / p[slot])
        q[slot] = 0.0
        s = 1.0 + noise - b @ q
        q[slot] = -1.0
        P[slot, :slot] = 0.0
        P[slot:, slot] = 0.0
        S -= p * (S[slot] / p[slot])
        Sy -= p * (Sy[slot] / p[slot])
        S[slot], Sy[slot] = 0.0, 0.0
        X[slot], y[slot] = new[k], targets[k]
        R[slot], R[:, slot] = b, b
        R[slot, slot] = 1.0 + noise
        S += q * (q.sum() / s)
        Sy += q * (q @ y / s)
        m[:] = p / np.sqrt(p[slot])
        m[slot] = 0.0
        pending[:] = q / np.sqrt(s)
        bias = Sy.sum() / S.sum()
        alpha = Sy - bias * S
        row = k % n
        residual = abs(y[row] - bias - R[row] @ alpha)
        if always or not residual <= share * np.sqrt(alpha @ alpha / n) * noise:
            # The change that is pending is applied first.
            column[:] = 0.0
            advance(P, n, m, pending, column, z)
            m[:], pending[:] = 0.0, 0.0
            _refine(P, R, ones, S)
            _refine(P, R, y, Sy)
            refined += 1
    column[:] = 0.0
    advance(P, n, m, pending, column, z)
    return refined


class Motion:
    """The samples of a slow random motion."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)
        self._place = self._rng.normal(size=_INPUTS)

    def take(self, count: int) -> tuple[FloatArray, FloatArray]:
        """(count, d) scaled inputs, and (count,) targets, of the next samples."""
        moves, out = self._rng.normal(size=(count, _INPUTS)), np.empty((count, _INPUTS))
        for i in range(count):
            self._place = 0.95 * self._place + 0.3 * moves[i]
            out[i] = self._place / 4.0
        noise = 1e-3 * self._rng.normal(size=count)
        return out, np.sin(3.0 * out[:, 0]) + out[:, 1] * out[:, 2] + noise


def main() -> None:
    """Run both ways and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--window", type=int, default=60, help="samples in the window")
    parser.add_argument("--steps", type=int, default=1_000_000, help="steps of the window")
    parser.add_argument("--gamma", type=float, default=1e3, help="regularisation")
    parser.add_argument("--precision", default="float32", choices=["float32", "float64"], help="of the inverse")
    args = parser.parse_args()
    n, noise, share = args.window, 1.0 / args.gamma, 0.25 * WindowConfig(10, (1.0,), args.gamma).accuracy
    for always in (False, True):
        draw, rng = Motion(), np.random.default_rng(1)
        X, y = draw.take(n)
        R = kernels.gram(X, None, np.ones(_INPUTS)) + noise * np.eye(n)
        P, inverse = np.zeros((n, n), dtype=args.precision), np.linalg.inv(R)
        P[np.tril_indices(n)] = inverse[np.tril_indices(n)]
        S, Sy = inverse.sum(1), inverse @ y
        begin, worst, refined, each = time.perf_counter(), 0.0, 0, args.steps // 100
        for part in range(100):
            refined += run(P, R, X, y, S, Sy, *draw.take(each), noise, share, always, part * each)
            exact = np.linalg.solve(R, np.column_stack((np.ones(n), y)))
            at = kernels.gram(X + 0.05 * rng.normal(size=X.shape), X, np.ones(_INPUTS))
            got, want = (
                at @ (b - b.sum() / a.sum() * a) + b.sum() / a.sum() for a, b in ((S, Sy), (exact[:, 0], exact[:, 1]))
            )
            error = float(np.abs(got - want).max())
            worst = error if not error <= worst else worst
            if not worst < 1.0:
                break
        steps = (part + 1) * each
        way, took_us = "always" if always else "checked", 1e6 * (time.perf_counter() - begin) / steps
        print(f"N = {n}, {args.precision}, gamma {args.gamma:g}, {way}: largest difference {worst:.1e} over {steps} "
              f"steps, {100 * refined / steps:.1f} % refined, {took_us:.0f} µs a step", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
