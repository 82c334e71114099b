"""The windows of all axes as operations of torch, on a graphics processor or any other device.

The windows have the inverse form (`adaptive.window.steps`): one symmetric rank-2 update of all inverses a step, applied
only where the step is sound and the next row's residual within its tolerance. Any other step is made by the compiled
code of the processor, on a copy of that axis: refusals and refinements are the single learner's. P is stored whole,
because batched products do not use a triangle; the update is symmetric to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dehyst.adaptive.online.kernel_window import SAME
from dehyst.adaptive.online.step import learn_all
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window.arrays import ACCEPTED, WindowArrays


class TorchWindows:
    """Windows of B axes. See `adaptive.fleet.fleet.CompiledWindows`."""

    shares = False

    def __init__(
        self, starts: Sequence[WindowArrays], rows: Mapping[str, Any], numbers: Any, fifo: bool, device: str
    ) -> None:
        """``starts`` : what each window begins as. ``rows``, ``numbers`` : arrays and numbers of all axes."""
        self._rows, self._numbers, self._fifo, self._device = rows, numbers, fifo, torch.device(device)
        B, example = len(starts), starts[0]
        self._all = {
            name: torch.zeros((B, *field.shape), dtype=torch.as_tensor(field).dtype, device=self._device)
            for name, field in example._asdict().items()
            if name != "kept"  # which the inverse form does not have
        }
        self._slots = torch.arange(example.S.size, device=self._device)
        self.handles = np.zeros((B, ws.handle_of(example).size), dtype=np.int64)
        for start in {id(start): start for start in starts}.values():
            self.put([axis for axis, other in enumerate(starts) if other is start], start)

    def _to(self, array: Any) -> Tensor:
        return torch.as_tensor(array).to(self._device)

    def arrays(self, axis: int) -> WindowArrays:
        """A copy of the solver's state of an axis."""
        fields = {name: field[axis].cpu().numpy().copy() for name, field in self._all.items()}
        return WindowArrays(**fields, kept=np.zeros(ws.kept_size(fields["S"].size)))

    def put(self, axes: int | list[int], arrays: WindowArrays) -> None:
        """Take over the state of a solver for one axis or several, its pending change applied."""
        for name, field in self._all.items():
            field[axes] = self._to(getattr(arrays, name))
        plus, minus = (self._to(arrays.V[row]) for row in (ws.PLUS, ws.MINUS))
        lower = (self._to(arrays.P) + (torch.outer(plus, plus) - torch.outer(minus, minus))).tril()
        self._all["P"][axes] = lower + lower.tril(-1).T
        self._all["V"][axes, ws.PLUS] = self._all["V"][axes, ws.MINUS] = 0.0
        self._all["C"][axes, ws.PENDING], self._all["C"][axes, ws.UNDO] = 0, ws.UNDO_NOTHING

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
        column = self._column(at, self._to(self._rows["point"][axes]))
        return np.asarray(((column * self._all["V"][at, ws.ALPHA]).sum(1) + self._all["F"][at, ws.BETA]).cpu())

    def learn(self, axes: IntArray, rows: IntArray, config: Any) -> IntArray:
        """(k,) status of one step of each window; ``rows`` : handles. See `ResidualWindow.learn`."""
        at, turns, born = self._to(axes), self._numbers["share"], self._rows["born"]
        points = self._to(self._rows["point"][axes])
        column, count = self._column(at, points), self._all["C"][at, ws.COUNT]
        value, nearest = torch.where(self._slots < count[:, None], column, -1.0).max(1)
        room = (count < self._slots.numel()) & (value < SAME)
        if self._fifo:
            held = np.arange(born.shape[1]) < count.cpu().numpy()[:, None]
            nearest = self._to(np.where(held, born[axes], np.iinfo(np.int64).max).argmin(1))
        slots = torch.where(room, count, nearest)
        targets = self._to(self._numbers["sample"]["target_V"][axes])
        good = self._exchange(at, slots, points, targets, column)
        status = np.full(axes.size, ACCEPTED)
        done, slot = axes[good], slots.cpu().numpy()[good]
        turns["clock"][done] += 1
        born[done, slot] = turns["clock"][done]
        # The others by the processor's compiled code, on copies that are taken over.
        rest, said = axes[~good], np.empty(int((~good).sum()), dtype=np.int64)
        copies = {axis: self.arrays(axis) for axis in rest.tolist()}
        for axis, arrays in copies.items():
            self.handles[axis] = ws.handle_of(arrays)
        learn_all(rest, rows, self.handles, self._numbers, config, said)
        for axis, arrays in copies.items():
            self.put(axis, arrays)
        status[~good] = said
        return status

    def _exchange(self, axes: Tensor, slot: Tensor, x: Tensor, y: Tensor, column: Tensor) -> Any:
        """A sample into ``slot`` of each axis, for the one there or as one more: `steps.replace` and ``append``.

        (k,) which of the steps are made; of the others nothing is.
        """
        if not axes.numel():
            return np.zeros(0, dtype=np.bool_)
        A, k = self._all, torch.arange(axes.numel(), device=axes.device)
        # All axes are stepped in place; of some, copies are.
        whole = axes.numel() == self._numbers.size
        P = A["P"] if whole else A["P"][axes]
        C, F, V = A["C"][axes], A["F"][axes], A["V"][axes]
        gamma, count = F[:, ws.GAMMA], C[:, ws.COUNT]
        grown = torch.maximum(count, slot + 1)
        noise = 1.0 / gamma
        b = column.clone()
        b[k, slot] = 0.0
        p = P[k, slot].clone()
        fresh = slot >= count
        pkk = torch.where(fresh, 1.0, p[k, slot])
        p = torch.where(fresh[:, None], 0.0, p)
        q = torch.bmm(P, b[:, :, None])[:, :, 0] - p * ((p * b).sum(1) / pkk)[:, None]
        q[k, slot] = 0.0
        s = 1.0 + noise - (b * q).sum(1)
        good = (x.abs() <= ws.MOST).all(1) & (y.abs() <= ws.MOST) & (pkk > 0.0) & (s > ws.SCHUR_SHARE * noise)
        good &= torch.isfinite((p * p).sum(1) / pkk + (q * q).sum(1) / s)
        q[k, slot] = -1.0
        V[k, ws.Y, slot] = y
        Y, ones = V[:, ws.Y], (self._slots < grown[:, None]).to(V.dtype)
        # P times 1 and P times y after the exchange, in O(N).
        before = torch.stack((A["S"][axes], V[:, ws.SY]))
        sums = before - p * (before[:, k, slot] / pkk)[:, :, None]
        sums[:, k, slot] = 0.0
        S, SY = sums + q * ((q * torch.stack((ones, Y))).sum(2) / s)[:, :, None]
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
        rotated, worst = cursor + 1 >= grown, torch.maximum(F[:, ws.ROUND_WORST], error)
        F[:, ws.LAST_WORST] = torch.where(rotated, worst, F[:, ws.LAST_WORST])
        F[:, ws.ROUND_WORST], F[:, ws.RESIDUAL] = torch.where(rotated, 0.0, worst), error
        F[:, ws.BETA], F[:, ws.GRAM] = beta, gram.sqrt()
        C[:, ws.COUNT], C[:, ws.CURSOR] = grown, torch.where(rotated, 0, cursor + 1)
        C[:, ws.STEPS] += 1
        C[:, ws.ROUNDS] += rotated
        V[:, ws.SY], V[:, ws.ALPHA] = SY, alpha
        done = good.nonzero()[:, 0]
        at, slot, line = axes[done], slot[done], -(q / s[:, None])[done]
        P[done, slot], P[done, :, slot] = line, line
        if not whole:
            A["P"][at] = P[done]
        A["F"][at], A["C"][at], A["V"][at], A["S"][at] = F[done], C[done], V[done], S[done]
        A["X"][at, :, slot], A["scaled"][at, :, slot] = x[done], x[done] * A["inverse_widths"][at]
        A["R"][at, slot], A["R"][at, :, slot] = row[done], row[done]
        return good.cpu().numpy()
