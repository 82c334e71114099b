"""What is read of a sliding window: the samples it holds, its solution, its predictions, how good its numbers are.

Compiled code or numpy answers, as the window's configuration says. `adaptive.window.Window` adds what changes a window.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from adaptive import condition, lssvm, window_core, window_handle, window_plain
from adaptive import window_state as ws
from adaptive.errors import InputError
from adaptive.types import FloatArray
from adaptive.window_config import WindowConfig
from adaptive.window_state import WindowArrays


class WindowReading:
    """A window's state and all that is read of it."""

    def __init__(self, config: WindowConfig, arrays: WindowArrays | None = None) -> None:
        self.config = config
        form = ws.CHOLESKY_FORM if config.form == "cholesky" else ws.INVERSE_FORM
        self.arrays = arrays or ws.allocate(
            config.capacity, np.array(config.widths), config.gamma, config.linear, 0.25 * config.accuracy, form
        )

    @property
    def arrays(self) -> WindowArrays:
        """The state; its arrays are written in place."""
        return self._arrays

    @arrays.setter
    def arrays(self, arrays: WindowArrays) -> None:
        self._arrays = arrays
        # What answers, and what it is given: compiled code a handle, numpy the arrays.
        compiled = self.config.backend == "compiled"
        self._answers: ModuleType = window_handle if compiled else window_plain
        self._given: Any = window_handle.handle_of(arrays) if compiled else arrays

    # --- what it holds -------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return int(self.arrays.C[ws.COUNT])

    @property
    def full(self) -> bool:
        """True where every slot is taken."""
        return len(self) == self.config.capacity

    @property
    def form(self) -> str:
        """``inverse`` or ``cholesky``, whichever is at work."""
        return "cholesky" if self.arrays.C[ws.FORM] == ws.CHOLESKY_FORM else "inverse"

    @property
    def X(self) -> FloatArray:
        """Features by slot, (n, d), a copy."""
        return np.ascontiguousarray(self.arrays.X[:, : len(self)].T)

    @property
    def y(self) -> FloatArray:
        """Targets by slot, (n,), a copy."""
        return self.arrays.V[ws.Y, : len(self)].copy()

    @property
    def weights(self) -> FloatArray:
        """Noise weights by slot, (n,), a copy."""
        return self.arrays.V[ws.W, : len(self)].copy()

    @property
    def alpha(self) -> FloatArray:
        """Dual weights by slot, (n,), a copy."""
        return self.arrays.V[ws.ALPHA, : len(self)].copy()

    @property
    def beta(self) -> FloatArray:
        """Bias, then the slopes of the linear part, (p,), a copy."""
        return self.arrays.beta.copy()

    # --- answers -------------------------------------------------------------------------------------------

    def predict(self, x: FloatArray) -> float:
        """Mean at one point ``x`` (d,); 0 while the window is empty."""
        return float(self._answers.predict(self._given, self._point(x)))

    def predict_with_variance(self, x: FloatArray, include_noise: bool = False) -> tuple[float, float]:
        """Mean and variance at one point, of the function or of a sample of weight 1, in squared target units."""
        mean, latent, scale = self._answers.predict_with_variance(self._given, self._point(x))
        noise = 1.0 / self.config.gamma if include_noise else 0.0
        return float(mean), float((latent + noise) * scale)

    @property
    def scale(self) -> float:
        """Variance of the kernel process, y'alpha/(n - p); the noise variance is scale/gamma."""
        return float(self._core.scale(self.arrays))

    def leave_one_out(self) -> FloatArray:
        """y_i minus what the others predict for it, exact, by slot, (n,)."""
        out = np.zeros(self.config.capacity)
        self._core.leave_one_out(self.arrays, out)
        return out[: len(self)]

    def model(self) -> lssvm.LssvmModel:
        """The solution as an immutable model; copies O(N d) numbers."""
        sigma = np.array(self.config.widths)
        return lssvm.LssvmModel(
            self.X, self.alpha, self.beta, sigma, self.config.gamma, self.weights, self.config.linear, self.scale
        )

    # --- numerics ------------------------------------------------------------------------------------------

    def worst_residual(self) -> float:
        """Largest residual of all rows, in target units. O(N²)."""
        return float(self._core.worst_residual(self.arrays))

    def condition(self) -> float:
        """Upper bound of cond(R), close for wide kernels; O(N²)."""
        n = len(self)
        return condition.condition_bound(self.arrays.R[:n, :n], self.config.gamma, self.arrays.V[ws.W, :n])

    def counters(self) -> dict[str, int]:
        """What happened since the window was made."""
        C = self.arrays.C
        names = {
            "steps": ws.STEPS,
            "bad_inputs": ws.BAD_INPUTS,
            "ill_conditioned": ws.ILL_STEPS,
            "undone": ws.UNDONE,
            "residuals_exceeded": ws.RESIDUALS_EXCEEDED,
            "residual_rounds": ws.ROUNDS,
            "refinements": ws.REFINEMENTS,
            "refreshes": ws.REFRESHES,
        }
        return {name: int(C[index]) for name, index in names.items()}

    @property
    def last_residual(self) -> float:
        """Residual of the row checked last, in target units."""
        return float(self.arrays.F[ws.RESIDUAL])

    @property
    def round_residual(self) -> float:
        """Largest residual over the last whole round of rows, in target units."""
        return float(self.arrays.F[ws.LAST_WORST])

    def _point(self, x: Any) -> FloatArray:
        point = np.ascontiguousarray(x, dtype=np.float64)
        if point.shape != (self.config.dimension,):
            raise InputError(f"x: got shape {point.shape}, expected ({self.config.dimension},), one value a feature")
        return point

    @property
    def _core(self) -> ModuleType:
        return window_core if self.config.backend == "compiled" else window_plain
