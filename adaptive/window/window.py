"""What is read of a sliding window: the samples it holds, its solution, its predictions, how good its numbers are.

Compiled code or numpy answers, as the window's configuration says. `adaptive.window.window.Window` adds what changes
a window.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal

import numpy as np

from adaptive import kernels, lapack, lssvm
from adaptive.errors import InputError, NumericsError
from adaptive.types import FloatArray, StateDict
from adaptive.window import arrays as ws
from adaptive.window import condition
from adaptive.window import handle as window_handle
from adaptive.window import plain as window_plain
from adaptive.window import steps as window_core
from adaptive.window.arrays import Status, WindowArrays
from adaptive.window.config import WindowConfig


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


# --- The sliding window: an LSSVM over at most N samples, exact after every sample that comes, goes or changes.
#
# `WindowConfig` says what it is, `WindowArrays` is its state, `WindowReading` what is read of it; `Window` is all of it
# behind one interface with two forms (the inverse, the Cholesky factor) and two backends (compiled, numpy). A step
# costs
# O(N²): one kernel column, one pass over one triangle. Compiled code of other modules steps the arrays directly through
# `adaptive.window.steps`. The direct solver `adaptive.lssvm.fit` is the oracle of all of it.


class Window(WindowReading):
    """A window with its state; see the module. Not for two threads at a time.

    Steps return a `Status` and never raise on data; a step that is not ``ACCEPTED`` leaves the window as it was.
    """

    def __reduce__(self) -> tuple[type[Window], tuple[WindowConfig, WindowArrays]]:
        # A handle is of one process, and of these arrays.
        return Window, (self.config, self._arrays)

    @classmethod
    def from_samples(
        cls, config: WindowConfig, X: FloatArray, y: FloatArray, weights: FloatArray | None = None
    ) -> Window:
        """A window that holds the samples ``X`` (n, d), ``y`` (n,), n <= N, solved by one factorisation.

        Raises
        ------
        InputError : shapes, too many samples, values that are not finite.
        NumericsError : their kernel matrix is singular in double precision.
        """
        X, y = np.asarray(X, dtype=np.float64), np.asarray(y, dtype=np.float64)
        w = np.ones(y.shape) if weights is None else np.asarray(weights, dtype=np.float64)
        n = y.size
        if X.shape != (n, config.dimension) or y.shape != (n,) or w.shape != (n,) or not 0 < n <= config.capacity:
            raise InputError(
                f"X, y, weights: got shapes {X.shape}, {y.shape}, {w.shape}, expected (n, {config.dimension}), (n,), "
                f"(n,) with 1 <= n <= {config.capacity}, the capacity"
            )
        precision = config.gamma * w
        held = np.all(np.abs(X) <= ws.MOST) and np.all(np.abs(y) <= ws.MOST)
        if not (held and np.all((precision >= ws.LEAST_PRECISION) & (precision <= ws.MOST_PRECISION))):
            raise InputError(
                f"X, y, weights: got values that are not finite, larger than {ws.MOST:g}, or weights with gamma w not "
                f"within {ws.LEAST_PRECISION:g} to {ws.MOST_PRECISION:g}; normalise, and drop what is no number"
            )
        window = cls(config)
        A = window.arrays
        A.C[ws.COUNT] = n
        A.X[:, :n] = X.T
        A.scaled[:, :n] = X.T * A.inverse_widths[:, None]
        A.H[:, :n] = lssvm.design(X, config.linear).T
        A.V[ws.Y, :n], A.V[ws.W, :n] = y, w
        A.R[:n, :n] = kernels.gram(A.scaled[:, :n].T, None, np.ones(config.dimension))
        A.R[np.arange(n), np.arange(n)] = 1.0 + 1.0 / (config.gamma * w)
        if config.form == "auto" and config.backend == "compiled":
            serves = condition.inverse_form_serves(window.condition(), config.accuracy)
            A.C[ws.FORM] = ws.INVERSE_FORM if serves else ws.CHOLESKY_FORM
        window.rebuild()
        return window

    # --- steps ---------------------------------------------------------------------------------------------

    def append(self, x: FloatArray, y: float, weight: float = 1.0) -> Status:
        """Take one more sample; ``x`` is (d,). NO_SLOT where the window is full."""
        return Status(self._core.append(self.arrays, self._point(x), float(y), float(weight)))

    def replace(self, slot: int, x: FloatArray, y: float, weight: float = 1.0) -> Status:
        """The sample in ``slot`` makes way for a new one. The heart of it all, O(N²)."""
        return Status(self._core.replace(self.arrays, int(slot), self._point(x), float(y), float(weight)))

    def undo(self) -> Status:
        """Take back the last `append` or `replace` if no other change came since; NOTHING_TO_UNDO otherwise."""
        return Status(self._core.undo(self.arrays))

    def remove(self, slot: int) -> Status:
        """Drop the sample in ``slot``; the sample of the last slot moves there."""
        return Status(self._core.remove(self.arrays, int(slot)))

    def reweight(self, slot: int, weight: float) -> Status:
        """Change the noise weight of the sample in ``slot``: less than 1 for one that is old or doubtful."""
        return Status(self._core.reweight(self.arrays, int(slot), float(weight)))

    def rescale_targets(self, gain: float, offset: float) -> Status:
        """All targets y <- (1 + gain) y + offset, O(N): what a filter on gain and offset has found, absorbed."""
        return Status(self._core.rescale_targets(self.arrays, float(gain), float(offset)))

    def shift_targets(self, delta: FloatArray) -> Status:
        """All targets y <- y + delta, (n,) by slot; O(N²)."""
        padded = np.zeros(self.config.capacity)
        padded[: len(self)] = delta
        return Status(self._core.shift_targets(self.arrays, padded))

    # --- numerics ------------------------------------------------------------------------------------------

    def refine(self) -> bool:
        """One step of iterative refinement of beta and alpha; O(N² p). False, and nothing changed, where not finite."""
        return self._solved_anew(self._core.refine)

    def resum(self) -> bool:
        """Beta and alpha anew from the factorisation as it stands; O(N² p). False as `refine`."""
        return self._solved_anew(self._core.resum)

    def rebuild(self) -> None:
        """Factor R anew in place, by Cholesky; O(N³), without the interpreter's lock.

        `adaptive.window.healing` does the same beside a window that keeps learning. Raises NumericsError where R
        is not positive definite in double precision; the window is then as it was.
        """
        A, n = self.arrays, len(self)
        P = A.R.copy()
        if A.C[ws.FORM] == ws.CHOLESKY_FORM:
            lapack.cholesky_upper(P, n)
        else:
            lapack.cholesky_lower(P, n)
            lapack.inverse_from_cholesky(P, n)
        before = ws.duplicate(A)
        A.P[:] = P
        if A.C[ws.FORM] == ws.CHOLESKY_FORM:
            A.order[:n] = np.arange(n)
        A.V[ws.MINUS], A.V[ws.PLUS] = 0.0, 0.0
        A.C[ws.PENDING], A.C[ws.UNDO], A.C[ws.CARRIED] = 0, ws.UNDO_NOTHING, 0
        if not self._core.resum(A):
            ws.take_over(A, before)
            raise NumericsError("window: its solution is not finite after a new factorisation; lower gamma")
        A.C[ws.REFRESHES] += 1

    def switch_form(self, form: Literal["inverse", "cholesky"]) -> None:
        """Go on in the other form; one factorisation."""
        if form == "cholesky" and self.config.backend == "plain":
            raise InputError("form: the plain backend has the inverse form only; take backend='compiled'")
        wanted = ws.CHOLESKY_FORM if form == "cholesky" else ws.INVERSE_FORM
        if self.arrays.C[ws.FORM] != wanted:
            self._rebuild_as(wanted)

    def heal(self) -> bool:
        """Factor anew after a refused step, in the form that the samples' condition calls for now (``auto``).

        What a caller does with ILL_CONDITIONED on samples that are good: the step may then be taken again. O(N³),
        some hundred steps' worth, without the interpreter's lock. False where R itself is not positive definite.
        """
        if len(self) == 0:
            return False
        try:
            self._rebuild_as(self.form_called_for())
        except NumericsError:
            return False
        return True

    def form_called_for(self) -> int:
        """Of a new factorisation: the form at work, or Cholesky where that is free and the condition asks for it."""
        free = self.config.form == "auto" and self.config.backend == "compiled"
        if free and not condition.inverse_form_serves(self.condition(), self.config.accuracy):
            return ws.CHOLESKY_FORM
        return int(self.arrays.C[ws.FORM])

    def _rebuild_as(self, form: int) -> None:
        before = int(self.arrays.C[ws.FORM])
        self.arrays.C[ws.FORM] = form
        try:
            self.rebuild()
        except NumericsError:
            self.arrays.C[ws.FORM] = before
            raise

    def _solved_anew(self, solve: Callable[[WindowArrays], bool]) -> bool:
        A = self.arrays
        before = [field.copy() for field in (A.S, A.G, A.beta, A.V)]
        good = bool(solve(A))
        if not good:
            for field, kept in zip((A.S, A.G, A.beta, A.V), before, strict=True):
                field[...] = kept
            A.C[ws.ILL_STEPS] += 1
        return good

    def with_hyperparameters(self, widths: tuple[float, ...], gamma: float) -> Window:
        """A new window over the same samples with other hyper-parameters; counters start anew."""
        return Window.from_samples(self._config_with(widths, gamma), self.X, self.y, self.weights)

    # --- keeping -------------------------------------------------------------------------------------------

    def copy(self) -> Window:
        """An independent window in the same state, to the last bit."""
        return Window(self.config, ws.duplicate(self.arrays))

    def state_dict(self) -> StateDict:
        """All arrays under flat names; `from_state` goes on from them with the same result to the last bit."""
        return {name: field.copy() for name, field in self.arrays._asdict().items()}

    @classmethod
    def from_state(cls, config: WindowConfig, state: StateDict) -> Window:
        """Raises InputError where a field is missing or its shape is not that of ``config``."""
        window = cls(config)
        for name, field in window.arrays._asdict().items():
            given = np.shape(state[name]) if name in state else ()
            # An older version's lacks the last rows of V and C, which are zero where nothing is known yet.
            older = name in ("V", "C") and len(given) == field.ndim and given[1:] == field.shape[1:]
            if name not in state or not (given == field.shape or (older and given[0] < field.shape[0])):
                got = given if name in state else "nothing"
                raise InputError(f"{name}: got {got}, expected an array {field.shape}; the state is of another window")
            field[: len(state[name])] = state[name]
        if np.shape(state["C"]) != window.arrays.C.shape:
            window.arrays.C[ws.UNDO] = ws.UNDO_NOTHING
        return window

    def _config_with(self, widths: tuple[float, ...], gamma: float) -> WindowConfig:
        c = self.config
        return WindowConfig(c.capacity, widths, gamma, c.linear, c.form, c.backend, c.accuracy)
