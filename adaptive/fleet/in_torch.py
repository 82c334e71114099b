"""The matrices of all axes as operations of torch, on a graphics processor or any other device.

The windows have the inverse form (`adaptive.window.steps`): one symmetric rank-2 update of all inverses a step, applied
only after the residual check, so that an axis whose step is refused keeps its state. P is stored whole, because batched
products do not use a triangle; a batched update is symmetric to the last bit, and a round of checks makes it so again.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from adaptive.fleet.state import AxisConstants, BatchState
from adaptive.online.drift import DEAD_S
from adaptive.online.kernel_window import NOWHERE, SAME
from adaptive.window import arrays as ws
from adaptive.window.arrays import ACCEPTED, BAD_INPUT, ILL_CONDITIONED, WindowArrays


def column_of(scaled: Tensor, point: Tensor) -> Tensor:
    """(k, N) kernel values of scaled samples (k, d, N) with scaled points (k, d), feature by feature."""
    squared = (scaled[:, 0] - point[:, 0, None]) ** 2
    for i in range(1, scaled.shape[1]):
        squared += (scaled[:, i] - point[:, i, None]) ** 2
    return torch.exp(-squared)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.bmm(matrix, vector[:, :, None])[:, :, 0]


class TorchMatrices:
    """Windows and drift filters of B axes. See `adaptive.fleet.fleet.Matrices`."""

    shares = False

    def __init__(self, constants: AxisConstants, state: BatchState, example: WindowArrays) -> None:
        self._c, self._s = constants, state
        device = constants.span_V.device
        self._all = {
            name: torch.as_tensor(np.zeros_like(field)).to(device).expand(constants.axes, *field.shape).clone()
            for name, field in example._asdict().items()
        }
        self._slots = torch.arange(example.S.size, device=device)
        self._tolerance = float(example.F[ws.TOLERANCE])

    def arrays(self, axis: int) -> WindowArrays:
        """A copy of the solver's state of an axis."""
        return WindowArrays(**{name: field[axis].cpu().numpy().copy() for name, field in self._all.items()})

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver, its pending change applied."""
        for name, field in self._all.items():
            field[axis] = torch.as_tensor(getattr(arrays, name)).to(field.device)
        P, V = self._all["P"][axis], self._all["V"][axis]
        lower = torch.tril(P)
        lower += torch.outer(V[ws.PLUS], V[ws.PLUS]).tril() - torch.outer(V[ws.MINUS], V[ws.MINUS]).tril()
        P.copy_(lower + lower.tril(-1).T)
        V[ws.PLUS], V[ws.MINUS] = 0.0, 0.0
        self._all["C"][axis, ws.PENDING] = 0
        self._all["C"][axis, ws.UNDO] = ws.UNDO_NOTHING

    def samples(self) -> tuple[Tensor, ...]:
        """See `adaptive.fleet.snapshot.Samples`; views."""
        V, F, C = self._all["V"], self._all["F"], self._all["C"]
        parts = (self._all["scaled"], V[:, ws.ALPHA], F[:, ws.BETA], C[:, ws.COUNT], self._all["inverse_widths"])
        return (*parts, F[:, ws.GAMMA])

    def _column(self, axes: Tensor, points: Tensor) -> Tensor:
        column = column_of(self._all["scaled"][axes], points * self._all["inverse_widths"][axes])
        return column * (self._slots < self._all["C"][axes, ws.COUNT, None])

    def predict(self, axes: Tensor, points: Tensor) -> Tensor:
        """(k,) kernel parts, V, at ``points`` (k, d) of ``axes`` (k,)."""
        column = self._column(axes, points)
        return (column * self._all["V"][axes, ws.ALPHA]).sum(1) + self._all["F"][axes, ws.BETA]

    def frozen(self, axes: Tensor, basis: Tensor, kernel: Tensor) -> Tensor:
        """(k,) voltages of the identified models, V, at inputs (k, p) and (k, d)."""
        c, m = self._c, self._c.model_of[axes]
        column = column_of(c.model_scaled[m], kernel * c.model_inverse_widths[m])
        return (c.model_beta[m] * basis).sum(1) + (c.model_alpha[m] * column).sum(1)

    def learn(self, axes: Tensor, points: Tensor, targets: Tensor, weights: Tensor, fade_steps: float) -> Tensor:
        """(k,) status of one step of each window; see `ResidualWindow.learn` and ``fade``."""
        s, count = self._s, self._all["C"][axes, ws.COUNT]
        born, own, clock = (s[f"window.{name}"] for name in ("born", "own_weights", "clock"))
        column = self._column(axes, points)
        value, slot = torch.where(self._slots < count[:, None], column, -1.0).max(1)
        clock[axes] += 1
        room = (count < self._slots.numel()) & (value < SAME)
        if self._c.config.learner.eviction == "fifo":
            oldest = torch.where(self._slots < count[:, None], born[axes], torch.iinfo(torch.int64).max)
            slot = oldest.argmin(1)
        slot = torch.where(room, count, slot)
        status = self._exchange(axes, slot, points, targets, weights, column, True)
        done = status == ACCEPTED
        born[axes[done], slot[done]] = clock[axes[done]]
        own[axes[done], slot[done]] = weights[done]
        if fade_steps > 0.0:
            slot = clock[axes] % self._all["C"][axes, ws.COUNT].clamp(min=1)
            share = (0.5 ** ((clock[axes] - born[axes, slot]) / fade_steps)).clamp(min=1e-3)
            self._reweight(axes, slot, own[axes, slot] * share)
        return torch.where((status == ILL_CONDITIONED) & (count == 0), BAD_INPUT, status)

    def let_go(self, axes: Tensor, most: float) -> None:
        """`ResidualWindow.let_go` of each axis."""
        s, count = self._s, self._all["C"][axes, ws.COUNT]
        born, own, changed, following = (s[f"window.{n}"] for n in ("born", "own_weights", "changed", "next"))
        old = (born[axes] <= changed[axes, None]) & (own[axes] > most) & (self._slots >= following[axes, None])
        old &= self._slots < count[:, None]
        found, slot = old.any(1), old.to(torch.int8).argmax(1)
        following[axes] = torch.where(found, slot + 1, NOWHERE)
        at, slot = axes[found], slot[found]
        done = self._reweight(at, slot, torch.full_like(own[at, slot], most)) == ACCEPTED
        own[at[done], slot[done]] = most

    def _reweight(self, axes: Tensor, slot: Tensor, weights: Tensor) -> Tensor:
        A = self._all
        x, y = A["X"][axes, :, slot], A["V"][axes, ws.Y, slot]
        return self._exchange(axes, slot, x, y, weights, A["R"][axes, slot], False)

    def _exchange(
        self, axes: Tensor, slot: Tensor, x: Tensor, y: Tensor, w: Tensor, column: Tensor, counted: bool
    ) -> Tensor:
        """A sample into ``slot`` of each axis, for the one there or as one more: `steps.replace` and ``append``."""
        A, k = self._all, torch.arange(axes.numel(), device=axes.device)
        if not axes.numel():
            return axes
        # All axes are stepped in place; of some, copies are.
        whole = axes.numel() == self._c.axes
        P = A["P"] if whole else A["P"][axes]
        C, F, gamma = A["C"][axes], A["F"][axes], A["F"][axes, ws.GAMMA]
        grown = torch.maximum(C[:, ws.COUNT], slot + 1)
        precision = gamma * w
        bad = ~((x.abs() <= ws.MOST).all(1) & (y.abs() <= ws.MOST))
        bad |= ~((precision >= ws.LEAST_PRECISION) & (precision <= ws.MOST_PRECISION))
        noise = 1.0 / precision
        b = column.clone()
        b[k, slot] = 0.0
        fresh, p = slot >= C[:, ws.COUNT], P[k, slot].clone()
        pkk = torch.where(fresh, 1.0, p[k, slot])
        p = torch.where(fresh[:, None], 0.0, p)
        q = _times(P, b) - p * ((p * b).sum(1) / pkk)[:, None]
        q[k, slot] = 0.0
        s = 1.0 + noise - (b * q).sum(1)
        good = ~bad & (pkk > 0.0) & (s > ws.SCHUR_SHARE * noise)
        good &= torch.isfinite((p * p).sum(1) / pkk + (q * q).sum(1) / s)
        q[k, slot] = -1.0
        V = A["V"][axes]
        Y = V[:, ws.Y].clone()
        Y[k, slot] = y
        S = self._summed(A["S"][axes], torch.ones_like(Y), p, q, pkk, s, k, slot)
        SY = self._summed(V[:, ws.SY], Y, p, q, pkk, s, k, slot)
        row = b.clone()
        row[k, slot] = 1.0 + noise
        beta, alpha, gram = _solution(S, SY)
        # The next row of the round of checks, of the kernel matrix as it will be.
        cursor = torch.where(C[:, ws.CURSOR] >= grown, 0, C[:, ws.CURSOR])
        checked = A["R"][axes, cursor].clone()
        checked[k, slot] = row[k, cursor]
        checked = torch.where((cursor == slot)[:, None], row, checked)
        target = Y[k, cursor]

        def residual(alpha: Tensor, beta: Tensor) -> Tensor:
            return (target - (checked * alpha).sum(1) - beta).abs()

        error, length = residual(alpha, beta), (alpha * alpha).sum(1).sqrt()
        allowed = self._tolerance * length / (grown.to(length.dtype).sqrt() * gamma)
        exceeded = ~(error <= allowed + ws.ROUND_OFF * (target.abs() + beta.abs() + length)) & good
        if bool(exceeded.any()):
            e = exceeded.nonzero()[:, 0]
            S[e], SY[e] = self._refined(axes[e], P[e], p[e], q[e], pkk[e], s[e], slot[e], row[e], Y[e], S[e], SY[e])
            beta, alpha, gram = _solution(S, SY)
            size = target.abs() + beta.abs() + (alpha * alpha).sum(1).sqrt()
            limit = torch.maximum(ws.CONTRACTION * error, ws.NEGLIGIBLE * size)
            good &= ~exceeded | (residual(alpha, beta) <= limit)
        good &= torch.isfinite(beta) & torch.isfinite(alpha).all(1) & torch.isfinite(gram)
        steps = good & counted
        rotated = self._note(axes, C, F, grown, cursor, error, beta, gram, (good, bad, exceeded, steps))
        # A refused axis has no update: zeros instead of a branch.
        minus = torch.where(good[:, None], p / pkk.sqrt()[:, None], 0.0)
        plus = torch.where(good[:, None], q / s.sqrt()[:, None], 0.0)
        P.baddbmm_(torch.stack((-minus, plus), 2), torch.stack((minus, plus), 1))
        done = good.nonzero()[:, 0]
        line = -(q / s[:, None])[done]
        P[done, slot[done]] = line
        P[done, :, slot[done]] = line
        again = (good & rotated).nonzero()[:, 0]
        if again.numel():
            P[again] = 0.5 * (P[again] + P[again].transpose(1, 2))
        if not whole:
            A["P"][axes] = P
        at, slot = axes[done], slot[done]
        A["V"][at, ws.W, slot], A["S"][at] = w[done], S[done]
        for index, values in ((ws.Y, Y), (ws.SY, SY), (ws.ALPHA, alpha)):
            A["V"][at, index] = values[done]
        self._write(at, slot, row[done], x[done])
        return torch.where(bad, BAD_INPUT, torch.where(good, ACCEPTED, ILL_CONDITIONED))

    def _write(self, axes: Tensor, slot: Tensor, row: Tensor, x: Tensor) -> None:
        """Write samples and their rows of the kernel matrices."""
        A = self._all
        A["R"][axes, slot], A["R"][axes, :, slot] = row, row
        A["X"][axes, :, slot] = x
        A["scaled"][axes, :, slot] = x * A["inverse_widths"][axes]

    def _note(
        self, axes: Tensor, C: Tensor, F: Tensor, grown: Tensor, cursor: Tensor, error: Tensor, beta: Tensor,
        gram: Tensor, results: tuple[Tensor, Tensor, Tensor, Tensor],
    ) -> Tensor:  # fmt: skip
        """Write counters and numbers of a step; returns (k,) whether a round of checks has ended."""
        A, (good, bad, exceeded, steps) = self._all, results
        rotated = cursor + 1 >= grown
        worst = torch.maximum(F[:, ws.ROUND_WORST], error)
        C[:, ws.REFINEMENTS] += exceeded
        C[:, ws.RESIDUALS_EXCEEDED] += exceeded
        C[:, ws.ILL_STEPS] += ~good & ~bad
        C[:, ws.BAD_INPUTS] += bad
        C[:, ws.STEPS] += steps
        C[:, ws.ROUNDS] += good & rotated
        C[:, ws.CURSOR] = torch.where(good, torch.where(rotated, 0, cursor + 1), C[:, ws.CURSOR])
        C[:, ws.COUNT] = torch.where(good, grown, C[:, ws.COUNT])
        for index, value in (
            (ws.RESIDUAL, error), (ws.LAST_WORST, torch.where(rotated, worst, F[:, ws.LAST_WORST])),
            (ws.ROUND_WORST, torch.where(rotated, 0.0, worst)), (ws.BETA, beta), (ws.GRAM, gram.clamp(min=0.0).sqrt()),
        ):  # fmt: skip
            F[:, index] = torch.where(good, value, F[:, index])
        A["C"][axes], A["F"][axes] = C, F
        return rotated

    @staticmethod
    def _summed(
        sums: Tensor, values: Tensor, p: Tensor, q: Tensor, pkk: Tensor, s: Tensor, k: Tensor, slot: Tensor
    ) -> Tensor:
        """P times ``values`` after the exchange, from ``sums`` = P times them before; O(N)."""
        new = sums - p * (sums[k, slot] / pkk)[:, None]
        new[k, slot] = 0.0
        used = q != 0.0
        return new + q * ((q * torch.where(used, values, 0.0)).sum(1) / s)[:, None]

    def _refined(
        self, axes: Tensor, P: Tensor, p: Tensor, q: Tensor, pkk: Tensor, s: Tensor, slot: Tensor, row: Tensor,
        Y: Tensor, S: Tensor, SY: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """One step of iterative refinement of S and Sy with the kernel matrix and the inverse after the exchange."""
        k = torch.arange(axes.numel(), device=axes.device)
        R = self._all["R"][axes].clone()
        R[k, slot], R[k, :, slot] = row, row
        inverse = P - p[:, :, None] * (p / pkk[:, None])[:, None] + q[:, :, None] * (q / s[:, None])[:, None]
        line = -q / s[:, None]
        inverse[k, slot], inverse[k, :, slot] = line, line
        ones = (torch.diagonal(R, dim1=1, dim2=2) > 0.0).to(S.dtype)
        S = S + _times(inverse, ones - _times(R, S))
        return S, SY + _times(inverse, Y * ones - _times(R, SY))

    def drift(self, axes: Tensor, basis: Tensor, targets: Tensor, moving: Tensor, weights: Tensor) -> Tensor:
        """(k,) results of an update of each filter: 0 updated, 1 outlier, 2 burst; see `DriftFilter.update`."""
        c, s = self._c, self._s
        walk2, burst2, noise, floor, ratio, gate2, rejects, fast, slow, step_s = c.drift_limits.tolist()
        x, P, span = s["filter.beta"][axes], s["filter.covariance"][axes], c.span_V[axes]
        squares, counts = s["filter.squares"][axes], s["filter.counts"][axes]
        _walk(x, P, torch.where(moving[:, None], c.walk_V2[axes], 0.0), torch.where(moving, walk2, 0.0))
        P[:, 0, 0] += torch.where(moving, 0.0, c.walk_V2[axes, 0])
        row = _times(P, basis)
        innovation, variance = targets - (basis * x).sum(1), (basis * row).sum(1)
        noise2, squared = (noise * span) ** 2 / weights, innovation * innovation
        outlier = (squared > gate2 * (variance + noise2)) & (counts[:, 0] < rejects)
        taken = ~outlier
        counts[:, 0] = torch.where(outlier, counts[:, 0] + 1, 0)
        squares[:, 0] += torch.where(taken, (squared - squares[:, 0]) * fast, 0.0)
        counts[:, 1] += taken
        threshold = torch.maximum(ratio * squares[:, 1], (floor * span) ** 2)
        burst = taken & (squares[:, 0] > threshold) & (counts[:, 1] * step_s > DEAD_S) & moving
        counts[:, 1] = torch.where(burst, 0, counts[:, 1])
        counts[:, 2] += burst
        _walk(x, P, torch.where(burst[:, None], c.burst_V2[axes], 0.0), torch.where(burst, burst2, 0.0))
        row = _times(P, basis)
        variance = (basis * row).sum(1) + noise2
        squares[:, 1] += torch.where(taken, (torch.minimum(squared, threshold) - squares[:, 1]) * slow, 0.0)
        counts[:, 3] += taken
        gain = torch.where(taken[:, None], row / variance[:, None], 0.0)
        # At rest the gain of all but the constant is zero (Schmidt-Kalman).
        gain[:, 1:] = torch.where(moving[:, None], gain[:, 1:], 0.0)
        x += gain * innovation[:, None]
        cross = gain[:, :, None] * row[:, None]
        P += (gain * variance[:, None])[:, :, None] * gain[:, None] - cross - cross.transpose(1, 2)
        s["filter.beta"][axes], s["filter.covariance"][axes] = x, 0.5 * (P + P.transpose(1, 2))
        s["filter.squares"][axes], s["filter.counts"][axes] = squares, counts
        return torch.where(outlier, 1, torch.where(burst, 2, 0))


def _walk(x: Tensor, P: Tensor, walks: Tensor, gain_variance: Tensor) -> None:
    """`adaptive.online.drift.walk` in place."""
    torch.diagonal(P, dim1=1, dim2=2).add_(walks)
    P += (gain_variance[:, None] * x)[:, :, None] * x[:, None]


def _solution(S: Tensor, SY: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bias (k,), dual weights (k, N) and 1'P 1 (k,), (2.29)."""
    gram = S.sum(1)
    beta = torch.where(gram > 0.0, SY.sum(1) / gram, 0.0)
    return beta, SY - beta[:, None] * S, gram
