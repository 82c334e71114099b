"""The windows of all axes as operations of torch, on a graphics processor or any other device.

The windows have the inverse form (`adaptive.window.steps`): one symmetric rank-2 update of all inverses a step, applied
only where the step is sound and the next row's residual within its tolerance. Any other step is made by the compiled
code of the processor, on a copy of that axis: refusals and refinements are the single learner's. P is stored whole,
because batched products do not use a triangle; the update is symmetric to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from adaptive.fleet import windows
from adaptive.fleet.state import Fixed, Rows
from adaptive.fleet.windows import Step
from adaptive.online.kernel_window import LEAST_FADED, NOWHERE, SAME
from adaptive.types import FloatArray, IntArray
from adaptive.window import arrays as ws
from adaptive.window.arrays import ACCEPTED, WindowArrays


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.bmm(matrix, vector[:, :, None])[:, :, 0]


class TorchWindows:
    """Windows of B axes. See `adaptive.fleet.windows.CompiledWindows`."""

    shares = False

    def __init__(self, rows: Rows, fixed: Fixed, starts: Sequence[WindowArrays], device: str) -> None:
        self._rows, self._fixed, self._device = rows, fixed, torch.device(device)
        B, example = len(starts), starts[0]
        self._all = {
            name: torch.zeros((B, *field.shape), dtype=torch.as_tensor(field).dtype, device=self._device)
            for name, field in example._asdict().items()
            if name != "kept"  # which the inverse form does not have
        }
        self._slots = torch.arange(example.S.size, device=self._device)
        self._handles = np.zeros((B, ws.handle_of(example).size), dtype=np.int64)
        first: dict[int, int] = {}
        for axis, start in enumerate(starts):
            like = first.setdefault(id(start), axis)
            if like == axis:
                self.put(axis, start)
            else:
                for field in self._all.values():
                    field[axis] = field[like]

    def own(self, axes: Sequence[int]) -> None:
        """Nothing: the matrices have memory of their own."""

    def _to(self, array: Any) -> Tensor:
        return torch.as_tensor(array).to(self._device)

    def arrays(self, axis: int) -> WindowArrays:
        """A copy of the solver's state of an axis."""
        fields = {name: field[axis].cpu().numpy().copy() for name, field in self._all.items()}
        return WindowArrays(**fields, kept=np.zeros(ws.kept_size(fields["S"].size)))

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver, its pending change applied."""
        for name, field in self._all.items():
            field[axis] = self._to(getattr(arrays, name))
        P, V, C = self._all["P"][axis], self._all["V"][axis], self._all["C"][axis]
        lower = torch.tril(P)
        lower += torch.outer(V[ws.PLUS], V[ws.PLUS]).tril() - torch.outer(V[ws.MINUS], V[ws.MINUS]).tril()
        P.copy_(lower + lower.tril(-1).T)
        V[ws.PLUS], V[ws.MINUS], C[ws.PENDING], C[ws.UNDO] = 0.0, 0.0, 0, ws.UNDO_NOTHING

    def samples(self) -> dict[str, FloatArray]:
        """The windows' arrays that models are made of, by name; copies."""
        return {name: self._all[name].cpu().numpy() for name in ("V", "F", "C", "scaled", "inverse_widths")}

    def _column(self, axes: Tensor, points: Tensor) -> Tensor:
        """(k, N) kernel values of the samples of ``axes`` with points (k, d), feature by feature; 0 beyond the last."""
        scaled, x = self._all["scaled"][axes], points * self._all["inverse_widths"][axes]
        squared = (scaled[:, 0] - x[:, 0, None]) ** 2
        for i in range(1, x.shape[1]):
            squared += (scaled[:, i] - x[:, i, None]) ** 2
        return torch.exp(-squared) * (self._slots < self._all["C"][axes, ws.COUNT, None])

    def predict(self, axes: IntArray) -> FloatArray:
        """(k,) kernel parts, V, at the present points of ``axes``."""
        at = self._to(axes)
        column = self._column(at, self._to(self._rows.point[axes]))
        return np.asarray(((column * self._all["V"][at, ws.ALPHA]).sum(1) + self._all["F"][at, ws.BETA]).cpu())

    def learn(self, axes: IntArray, step: Step) -> IntArray:
        """(k,) status of one step of each window; see `ResidualWindow.learn` and ``fade``."""
        s, at, points = self._rows, self._to(axes), self._to(step.points)
        column, count = self._column(at, points), self._all["C"][at, ws.COUNT]
        value, nearest = torch.where(self._slots < count[:, None], column, -1.0).max(1)
        room = (count < self._slots.numel()) & (value < SAME)
        if step.fifo:
            held = np.arange(s.born.shape[1]) < count.cpu().numpy()[:, None]
            nearest = self._to(np.where(held, s.born[axes], np.iinfo(np.int64).max).argmin(1))
        slots = torch.where(room, count, nearest)
        targets, weights = self._to(step.targets), self._to(step.weights)
        good = self._exchange(at, slots, points, targets, weights, column, True)
        status = np.full(axes.size, ACCEPTED)
        done, slot = axes[good], slots.cpu().numpy()[good]
        s.numbers["clock"][done] += 1
        s.born[done, slot], s.own[done, slot] = s.numbers["clock"][done], step.weights[good]
        half_life_s = float(self._fixed.config["weights"]["half_life_s"][0])
        if half_life_s > 0.0 and done.size:
            slot = s.numbers["clock"][done] % self._all["C"][self._to(done), ws.COUNT].cpu().numpy()
            share = 0.5 ** ((s.numbers["clock"][done] - s.born[done, slot]) * step.step_s / half_life_s)
            faded = self._reweight(done, slot, s.own[done, slot] * np.maximum(share, LEAST_FADED))
            self._alone(done[~faded], windows.fade, s, self._fixed, step.step_s)
        rest = ~good
        said = np.empty(int(rest.sum()), dtype=np.int64)
        alone = step._replace(points=step.points[rest], targets=step.targets[rest], weights=step.weights[rest])
        self._alone(axes[rest], windows.learn, s, self._fixed, alone, said)
        status[rest] = said
        return status

    def let_go(self, axes: IntArray, most: float) -> None:
        """`ResidualWindow.let_go` of each axis."""
        s, r, slots = self._rows, self._rows.numbers, np.arange(self._rows.born.shape[1])
        old = (s.born[axes] <= r["changed"][axes, None]) & (s.own[axes] > most) & (slots >= r["next"][axes, None])
        old &= slots < self._all["C"][self._to(axes), ws.COUNT].cpu().numpy()[:, None]
        found, slot = old.any(1), old.argmax(1)
        r["next"][axes[~found]] = NOWHERE
        at, slot = axes[found], slot[found]
        good = self._reweight(at, slot, np.full(at.size, most))
        r["next"][at[good]], s.own[at[good], slot[good]] = slot[good] + 1, most
        self._alone(at[~good], windows.let_go, s, most)

    def _alone(self, axes: IntArray, work: Callable[..., None], *arguments: object) -> None:
        """Steps of some axes by the processor's compiled code, on copies that are taken over."""
        copies = {axis: self.arrays(axis) for axis in axes.tolist()}
        for axis, arrays in copies.items():
            self._handles[axis] = ws.handle_of(arrays)
        work(0, axes.size, self._handles, axes, *arguments)
        for axis, arrays in copies.items():
            self.put(axis, arrays)

    def _reweight(self, axes: IntArray, slots: IntArray, weights: FloatArray) -> Any:
        """(k,) which of the samples in ``slots`` have got their weights."""
        A, at, slot = self._all, self._to(axes), self._to(slots)
        x, y = A["X"][at, :, slot], A["V"][at, ws.Y, slot]
        return self._exchange(at, slot, x, y, self._to(weights), A["R"][at, slot], False)

    def _exchange(
        self, axes: Tensor, slot: Tensor, x: Tensor, y: Tensor, w: Tensor, column: Tensor, counted: bool
    ) -> Any:
        """A sample into ``slot`` of each axis, for the one there or as one more: `steps.replace` and ``append``.

        (k,) which of the steps are made; of the others nothing is.
        """
        if not axes.numel():
            return np.zeros(0, dtype=np.bool_)
        A, k = self._all, torch.arange(axes.numel(), device=axes.device)
        # All axes are stepped in place; of some, copies are.
        whole = axes.numel() == self._rows.x.shape[0]
        P = A["P"] if whole else A["P"][axes]
        C, F, V = A["C"][axes], A["F"][axes], A["V"][axes]
        gamma, count = F[:, ws.GAMMA], C[:, ws.COUNT]
        grown = torch.maximum(count, slot + 1)
        precision = gamma * w
        noise = 1.0 / precision
        b = column.clone()
        b[k, slot] = 0.0
        p = P[k, slot].clone()
        fresh = slot >= count
        pkk = torch.where(fresh, 1.0, p[k, slot])
        p = torch.where(fresh[:, None], 0.0, p)
        q = _times(P, b) - p * ((p * b).sum(1) / pkk)[:, None]
        q[k, slot] = 0.0
        s = 1.0 + noise - (b * q).sum(1)
        good = (x.abs() <= ws.MOST).all(1) & (y.abs() <= ws.MOST) & (pkk > 0.0) & (s > ws.SCHUR_SHARE * noise)
        good &= (precision >= ws.LEAST_PRECISION) & (precision <= ws.MOST_PRECISION)
        good &= torch.isfinite((p * p).sum(1) / pkk + (q * q).sum(1) / s)
        q[k, slot] = -1.0
        Y, S, SY = V[:, ws.Y].clone(), A["S"][axes], V[:, ws.SY]
        Y[k, slot] = y
        # P times 1 and P times y after the exchange, in O(N).
        ones = (self._slots < grown[:, None]).to(Y.dtype)
        S = _moved(S, ones, p, q, pkk, s, k, slot)
        SY = _moved(SY, Y, p, q, pkk, s, k, slot)
        gram = S.sum(1)
        beta = torch.where(gram > 0.0, SY.sum(1) / gram, 0.0)
        alpha = SY - beta[:, None] * S
        row = b.clone()
        row[k, slot] = 1.0 + noise
        # The next row of the round of checks, of the kernel matrix as it will be.
        cursor = torch.where(C[:, ws.CURSOR] >= grown, 0, C[:, ws.CURSOR])
        checked = A["R"][axes, cursor].clone()
        checked[k, slot] = row[k, cursor]
        checked = torch.where((cursor == slot)[:, None], row, checked)
        target, length = Y[k, cursor], (alpha * alpha).sum(1).sqrt()
        error = (target - (checked * alpha).sum(1) - beta).abs()
        allowed = F[:, ws.TOLERANCE] * length / (grown.to(length.dtype).sqrt() * gamma)
        good &= error <= allowed + ws.ROUND_OFF * (target.abs() + beta.abs() + length)
        good &= torch.isfinite(gram) & torch.isfinite(beta) & torch.isfinite(alpha).all(1)
        # An axis whose step is not made has no update: zeros instead of a branch.
        minus = torch.where(good[:, None], p / pkk.sqrt()[:, None], 0.0)
        plus = torch.where(good[:, None], q / s.sqrt()[:, None], 0.0)
        P.baddbmm_(torch.stack((-minus, plus), 2), torch.stack((minus, plus), 1))
        done = good.nonzero()[:, 0]
        at, slot, cursor, grown = axes[done], slot[done], cursor[done] + 1, grown[done]
        line = -(q / s[:, None])[done]
        P[done, slot], P[done, :, slot] = line, line
        if not whole:
            A["P"][at] = P[done]
        rotated = cursor >= grown
        worst = torch.maximum(F[done, ws.ROUND_WORST], error[done])
        for index, value in (
            (ws.RESIDUAL, error[done]), (ws.LAST_WORST, torch.where(rotated, worst, F[done, ws.LAST_WORST])),
            (ws.ROUND_WORST, torch.where(rotated, 0.0, worst)), (ws.BETA, beta[done]), (ws.GRAM, gram[done].sqrt()),
        ):  # fmt: skip
            A["F"][at, index] = value
        A["C"][at, ws.COUNT], A["C"][at, ws.CURSOR] = grown, torch.where(rotated, 0, cursor)
        A["C"][at, ws.STEPS] += int(counted)
        A["C"][at, ws.ROUNDS] += rotated
        A["V"][at, ws.Y], A["V"][at, ws.SY], A["V"][at, ws.ALPHA], A["S"][at] = Y[done], SY[done], alpha[done], S[done]
        A["V"][at, ws.W, slot], A["X"][at, :, slot] = w[done], x[done]
        A["scaled"][at, :, slot] = x[done] * A["inverse_widths"][at]
        A["R"][at, slot], A["R"][at, :, slot] = row[done], row[done]
        return good.cpu().numpy()


def _moved(
    sums: Tensor, values: Tensor, p: Tensor, q: Tensor, pkk: Tensor, s: Tensor, k: Tensor, slot: Tensor
) -> Tensor:
    """P times ``values`` after the exchange, from ``sums`` = P times them before."""
    new = sums - p * (sums[k, slot] / pkk)[:, None]
    new[k, slot] = 0.0
    return new + q * ((q * values).sum(1) / s)[:, None]
