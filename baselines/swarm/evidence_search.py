"""Starts for re-tuning: the evidence of many hyper-parameters at once, as one batch in torch.

All starts descend together (Adam on J2, with torch's gradient), on a GPU where there is one. The search finds basins;
``adaptive.tuning.retuning`` refines the result. torch is imported only when a search starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.tuning.evidence import EvidenceSamples
from dehyst.adaptive.tuning.retuning import pattern
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.swarm.identification import torch_module

#: J2 of a point whose kernel matrix cannot be factored.
_REFUSED = 1e12


@dataclass(frozen=True, slots=True)
class EvidenceSearchConfig:
    """Settings of the search.

    Attributes
    ----------
    starts, steps : descents, and steps of each.
    rate : largest step, in logarithms of the hyper-parameters.
    keep : number of results, best first.
    apart : results closer than this in every logarithm count as one.
    device : device name for torch; "auto" is a GPU where there is one.
    """

    starts: int = 24
    steps: int = 30
    rate: float = 0.25
    keep: int = 4
    apart: float = 0.1
    device: str = "auto"

    def __post_init__(self) -> None:
        if min(self.starts, self.steps, self.keep) < 1 or not (self.rate > 0.0 and self.apart >= 0.0):
            raise InputError(
                f"starts, steps, keep, rate, apart: got {self!r}, expected at least 1, 1, 1, more than 0, at least 0"
            )


class EvidenceSearch:
    """Implements ``adaptive.tuning.retuning.Search``. Deterministic on one device.

    Raises MissingTorchError where torch is not installed.
    """

    def __init__(self, config: EvidenceSearchConfig | None = None) -> None:
        self.config = config or EvidenceSearchConfig()
        torch = torch_module()
        self.device: str = self.config.device
        if self.device == "auto":
            self.device = "cuda" if torch.cuda.is_available() else "cpu"

    def __call__(self, data: EvidenceSamples, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """(k, 1 + d) starts within the box from ``low`` to ``high``, best first; ``start`` is one of the seeds."""
        c, torch = self.config, torch_module()
        batch = _Batch(torch, data, self.device)
        floor, ceiling = (torch.as_tensor(np.asarray(x), device=self.device) for x in (low, high))
        theta = torch.as_tensor(pattern(start, low, high, c.starts), device=self.device)
        best, best_J2 = theta.clone(), torch.full((theta.shape[0],), _REFUSED, dtype=theta.dtype, device=self.device)
        first, second = torch.zeros_like(theta), torch.zeros_like(theta)
        for step in range(1, c.steps + 1):
            J2, gradient = batch(theta)
            better = best_J2 > J2
            best, best_J2 = torch.where(better[:, None], theta, best), torch.where(better, J2, best_J2)
            # Adam makes the step independent of the scale of J2; steps shrink towards the end.
            first = 0.8 * first + 0.2 * gradient
            second = 0.95 * second + 0.05 * gradient**2
            pace = c.rate * (1.0 - (step - 1) / c.steps)
            move = (first / (1.0 - 0.8**step)) / (torch.sqrt(second / (1.0 - 0.95**step)) + 1e-12)
            theta = torch.minimum(torch.maximum(theta - pace * move, floor), ceiling)
        J2, _ = batch(theta)
        better = best_J2 > J2
        best, best_J2 = torch.where(better[:, None], theta, best), torch.where(better, J2, best_J2)
        return self._distinct(best.cpu().numpy(), best_J2.cpu().numpy(), start)

    def _distinct(self, points: FloatArray, J2: FloatArray, start: FloatArray) -> FloatArray:
        kept: list[FloatArray] = []
        for i in np.argsort(J2, kind="stable"):
            if J2[i] < _REFUSED and all(np.max(np.abs(points[i] - other)) > self.config.apart for other in kept):
                kept.append(points[i])
            if len(kept) == self.config.keep:
                break
        return np.array(kept or [start], dtype=np.float64)


class _Batch:
    """J2 (s,) and its gradient (s, 1 + d) at logarithms (s, 1 + d) of gamma and widths.

    See ``adaptive.tuning.evidence``.
    """

    def __init__(self, torch: Any, data: EvidenceSamples, device: str) -> None:
        self._torch = torch

        def on(values: FloatArray) -> Any:
            return torch.as_tensor(np.asarray(values, dtype=np.float64), device=device)

        X = on(data.X)
        self._apart = (X[:, None, :] - X[None, :, :]) ** 2
        self._y, self._H, self._noise = on(data.y), on(data.H), 1.0 / on(data.weights)
        self._design = float(np.linalg.slogdet(data.H.T @ data.H)[1])

    def __call__(self, theta: Any) -> tuple[Any, Any]:
        torch = self._torch
        theta = theta.detach().requires_grad_(True)
        n, p = self._H.shape
        scales = torch.exp(-2.0 * theta[:, 1:])
        K = torch.exp(-torch.einsum("ijd,sd->sij", self._apart, scales))
        R = K + torch.diag_embed(torch.exp(-theta[:, :1]) * self._noise)
        L, failed = torch.linalg.cholesky_ex(R)
        good = failed == 0
        # The identity replaces a failed factor, so that it cannot spoil the others; its value is refused below.
        L = torch.where(good[:, None, None], L, torch.eye(n, dtype=L.dtype, device=L.device))
        columns = torch.linalg.solve_triangular(
            L, torch.cat([self._H, self._y[:, None]], dim=1).expand(len(theta), -1, -1), upper=False
        )
        A, b = columns[:, :, :p], columns[:, :, p]
        G = A.transpose(1, 2) @ A
        left = b - (A @ torch.linalg.solve(G, A.transpose(1, 2) @ b[:, :, None]))[:, :, 0]
        twice_J1 = (left * left).sum(dim=1)
        log_det = 2.0 * torch.log(torch.diagonal(L, dim1=1, dim2=2)).sum(dim=1)
        J2 = log_det + torch.linalg.slogdet(G)[1] - self._design + (n - p) * torch.log(0.5 * twice_J1)
        usable = good & torch.isfinite(J2)
        (gradient,) = torch.autograd.grad(torch.where(usable, J2, torch.zeros_like(J2)).sum(), theta)
        gradient = torch.where(torch.isfinite(gradient), gradient, torch.zeros_like(gradient))
        return torch.where(usable, J2, torch.full_like(J2, _REFUSED)).detach(), gradient
