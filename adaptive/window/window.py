"""The sliding window: an LSSVM over at most N samples, solved exactly after every sample that comes, goes or changes.

`WindowConfig` says how it is solved, `WindowArrays` is its state, `Window` is both behind one interface. There are two
forms, the inverse and the Cholesky factor of the kernel matrix. A step costs O(N²): one kernel column, and one pass
over one triangle. Other compiled code calls `adaptive.window.steps` directly. The direct solver `adaptive.lssvm.fit` is
the oracle that the tests compare with.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final, Literal

import numpy as np

from dehyst.adaptive import features, lssvm
from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import Status, WindowArrays

# --- Configuration.


Form = Literal["inverse", "cholesky", "auto"]


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """How the window is solved, as `WindowConfig` explains.

    form : "inverse" is the fastest, "cholesky" the most exact; "auto" takes what accuracy requires.
    accuracy : relative error of the solution to be kept.

    Raises InputError on other values.
    """

    form: Form = "auto"
    accuracy: float = 1e-8

    def __post_init__(self) -> None:
        if self.form not in ("inverse", "cholesky", "auto"):
            raise InputError(f"form: got {self.form!r}, expected 'inverse', 'cholesky' or 'auto'")
        if not self.accuracy > 0:
            raise InputError(f"accuracy: got {self.accuracy!r}, expected a positive number, 1e-8 say")


_SOLVER: Final = SolverConfig()


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Configuration of a window. Features and targets are normalised (dimensionless, of order 1).

    Attributes
    ----------
    capacity : N, the number of slots.
    widths : kernel width of each of the d features, (2.31).
    gamma : regularisation, > 0; the noise variance is 1/gamma of the kernel's.
    form : ``inverse`` is the fastest, its error grows with cond(R)²; ``cholesky`` takes about twice the time, its
        error grows with cond(R); ``auto`` takes the one that ``accuracy`` and the condition of the samples require,
        each time the window is made from samples or healed. An empty window starts as ``inverse``.
    accuracy : relative error of alpha to be kept. A step whose checked row shows more than a quarter of it (other
        rows may be worse) is followed by a step of refinement, which takes some six products. Infinite: never.

    Raises InputError on values out of range.
    """

    capacity: int
    widths: tuple[float, ...]
    gamma: float
    form: Form = _SOLVER.form
    accuracy: float = _SOLVER.accuracy

    def __post_init__(self) -> None:
        if self.capacity < 1:
            raise InputError(f"capacity: got {self.capacity}, expected the number of samples to keep, at least 1")
        if len(self.widths) < 1:
            raise InputError("widths: got none, expected one kernel width a feature")
        object.__setattr__(self, "widths", tuple(map(float, features.as_widths(self.widths, len(self.widths)))))
        object.__setattr__(self, "gamma", lssvm.check_gamma(self.gamma))
        if not ws.LEAST_PRECISION <= self.gamma <= ws.MOST_PRECISION:
            raise InputError(
                f"gamma: got {self.gamma!r}, expected {ws.LEAST_PRECISION:g} to {ws.MOST_PRECISION:g}: outside, double "
                "precision cannot tell a sample's noise from the kernel"
            )
        SolverConfig(self.form, self.accuracy)  # Raises on wrong values.

    @property
    def dimension(self) -> int:
        """Number of features d."""
        return len(self.widths)


#: Relative error of alpha that the inverse form settles at, as a share of cond(R)². Measured from cond 3e3 to 8e7 with
#: windows of 100 to 500 samples with near-duplicates (docs/measurements/solver.md), with some margin.
INVERSE_ERROR_SHARE = 3e-18

#: Arrays whose entry in a state is the array itself.
_SAVED = ("X", "scaled", "inverse_widths", "S", "V", "U", "F", "C", "order")


@dataclass(slots=True)
class SolverState:
    """The arrays of a window; see `adaptive.window.arrays`. It has PR in the inverse form, else P and R."""

    X: Annotated[FloatArray, Entry("features", "", "d,N")]
    scaled: Annotated[FloatArray, Entry("features over their widths", "", "d,N")]
    inverse_widths: Annotated[FloatArray, Entry("one over the widths", "", "d", low=1e-100)]
    S: Annotated[FloatArray, Entry("P 1, or L^-1 1 by position", "", "N")]
    V: Annotated[FloatArray, Entry("targets, dual weights and other vectors", "V", f"{ws.ROWS},N")]
    U: Annotated[FloatArray, Entry("what a refused step restores", "", f"{ws.UNDO_ROWS},room")]
    F: Annotated[FloatArray, Entry("regularisation, residuals, bias", "", f"{ws.FLOATS}")]
    C: Annotated[IntArray, Entry("counters", "", f"{ws.COUNTERS}", low=-1)]
    order: Annotated[IntArray, Entry("slot at each position of the factor", "", "N")]
    PR: Annotated[FloatArray | None, Entry("lower triangle of P beside the upper one of R", "", "N,room_PR")] = None
    P: Annotated[FloatArray | None, Entry("the Cholesky factor L' by position", "", "N,N")] = None
    R: Annotated[FloatArray | None, Entry("kernel matrix with the noise variances", "", "N,N")] = None

    def check_state(self) -> None:
        """Raise ValueError where counters or places would lead out of the arrays."""
        d, n = self.X.shape
        C = self.C.tolist()
        places = (ws.COUNT, ws.UNDO_SLOT, ws.CURSOR)
        if max(C[place] for place in places) > n:
            raise ValueError(f"C: got {C}, expected at most the window's {n} samples")
        if C[ws.COUNT] < 0 or not 0 <= C[ws.FORM] <= 1 or C[ws.CURSOR] < 0:
            raise ValueError(f"C: got {C}, expected a count, a form of 0 or 1 and a cursor")
        if not np.array_equal(np.sort(self.order), np.arange(n)):
            raise ValueError(f"order: no permutation, expected each of 0 to {n - 1} once")
        if self.U.shape[1] != max(n, 1 + d):
            raise ValueError(f"U: got {self.U.shape[1]} columns, expected {max(n, 1 + d)}")
        whole, packed = (self.P is not None, self.R is not None), self.PR is not None
        if whole != ((C[ws.FORM] == ws.CHOLESKY_FORM),) * 2 or packed == whole[0]:
            raise ValueError(f"PR: got P and R: {whole[0]}, {whole[1]}; expected them in the Cholesky form, else PR")
        if self.PR is not None and self.PR.shape[1] != n + 1:
            raise ValueError(f"PR: got {self.PR.shape[1]} columns, expected {n + 1}")


class Window:
    """A window with its state. Not for two threads at a time.

    Steps return a `Status` and never raise on data. A step that is not ``ACCEPTED`` leaves the window as it was.
    """

    def __init__(self, config: WindowConfig, arrays: WindowArrays | None = None) -> None:
        self.config = config
        form = ws.CHOLESKY_FORM if config.form == "cholesky" else ws.INVERSE_FORM
        self.take_arrays(
            arrays or ws.allocate(config.capacity, np.array(config.widths), config.gamma, 0.25 * config.accuracy, form)
        )

    def __reduce__(self) -> tuple[type[Window], tuple[WindowConfig, WindowArrays]]:
        # Addresses are valid in one process only: a copy makes its own handle.
        return Window, (self.config, self._arrays)

    @classmethod
    def from_samples(cls, config: WindowConfig, X: FloatArray, y: FloatArray) -> Window:
        """A window that holds the samples ``X`` (n, d), ``y`` (n,), n <= N, solved by one factorisation.

        Raises
        ------
        InputError : shapes, too many samples, values that are not finite or too large.
        NumericsError : their kernel matrix is singular in double precision.
        """
        X, y = np.asarray(X, dtype=np.float64), np.asarray(y, dtype=np.float64)
        n = y.size
        if X.shape != (n, config.dimension) or y.shape != (n,) or not 0 < n <= config.capacity:
            raise InputError(
                f"X, y: got shapes {X.shape}, {y.shape}, expected (n, {config.dimension}), (n,) with "
                f"1 <= n <= {config.capacity}, the capacity"
            )
        if not (np.all(np.abs(X) <= ws.MOST) and np.all(np.abs(y) <= ws.MOST)):
            raise InputError(
                f"X, y: got values that are not finite or larger than {ws.MOST:g}; normalise them, and drop samples "
                "that are not finite"
            )
        window = cls(config)
        A = window.arrays
        A.C[ws.COUNT] = n
        A.X[:, :n] = X.T
        A.scaled[:, :n] = X.T * A.inverse_widths[:, None]
        A.V[ws.Y, :n] = y
        A.R[:n, :n] = features.gram(A.scaled[:, :n].T, None, np.ones(config.dimension))
        A.R[np.arange(n), np.arange(n)] = 1.0 + 1.0 / config.gamma
        A.C[ws.FORM] = window.form_called_for()
        window.rebuild()
        return window

    # --- state ---------------------------------------------------------------------------------------------

    @property
    def arrays(self) -> WindowArrays:
        """The state; its arrays are written in place."""
        return self._arrays

    def take_arrays(self, arrays: WindowArrays) -> None:
        """Continue with other arrays of the same sizes."""
        self._arrays = arrays
        self._handle = ws.handle_of(arrays)

    @property
    def handle(self) -> IntArray:
        """The handle of ``arrays``."""
        return self._handle

    def __len__(self) -> int:
        return int(self._arrays.C[ws.COUNT])

    @property
    def full(self) -> bool:
        """True where every slot is taken."""
        return len(self) == self.config.capacity

    @property
    def form(self) -> str:
        """The form in use, ``inverse`` or ``cholesky``."""
        return "cholesky" if self._arrays.C[ws.FORM] == ws.CHOLESKY_FORM else "inverse"

    @property
    def X(self) -> FloatArray:
        """Features by slot, (n, d), a copy."""
        return np.ascontiguousarray(self._arrays.X[:, : len(self)].T)

    @property
    def y(self) -> FloatArray:
        """Targets by slot, (n,), a copy."""
        return self._arrays.V[ws.Y, : len(self)].copy()

    @property
    def alpha(self) -> FloatArray:
        """Dual weights by slot, (n,), a copy."""
        return self._arrays.V[ws.ALPHA, : len(self)].copy()

    @property
    def bias(self) -> float:
        """The bias b of (2.32)."""
        return float(self._arrays.F[ws.BETA])

    # --- answers -------------------------------------------------------------------------------------------

    def predict(self, x: FloatArray) -> float:
        """Mean at one point ``x`` (d,), (2.32); 0 while the window is empty."""
        return float(steps.predict_by_handle(self._handle, self._point(x)))

    def nearest(self, x: FloatArray) -> tuple[int, float]:
        """Slot of the sample with the largest kernel value to ``x`` (d,), and that value; (-1, 0.0) while empty."""
        slot, value = steps.nearest(self._arrays, self._point(x))
        return int(slot), float(value)

    @property
    def scale(self) -> float:
        """Variance of the kernel process, y'alpha/(n - 1); the noise variance is scale/gamma."""
        return float(steps.scale(self._arrays))

    def leave_one_out(self) -> FloatArray:
        """y_i minus the prediction from all other samples, exact, by slot, (n,)."""
        out = np.zeros(self.config.capacity)
        steps.leave_one_out(self._arrays, out)
        return out[: len(self)]

    # --- steps ---------------------------------------------------------------------------------------------

    def append(self, x: FloatArray, y: float) -> Status:
        """Take one more sample; ``x`` is (d,). NO_SLOT where the window is full."""
        return Status(steps.append(self._arrays, self._point(x), float(y)))

    def replace(self, slot: int, x: FloatArray, y: float) -> Status:
        """Put a new sample in place of the one in ``slot``; ``x`` is (d,). O(N²)."""
        return Status(steps.replace(self._arrays, int(slot), self._point(x), float(y)))

    def _point(self, x: FloatArray) -> FloatArray:
        point = np.ascontiguousarray(x, dtype=np.float64)
        if point.shape != (self.config.dimension,):
            raise InputError(f"x: got shape {point.shape}, expected ({self.config.dimension},), one value a feature")
        return point

    # --- numerics ------------------------------------------------------------------------------------------

    def rebuild(self) -> None:
        """Factor R anew in place, by Cholesky; O(N³), without the interpreter's lock.

        `adaptive.window.window` does the same beside a window that keeps learning. Raises NumericsError where R
        is not positive definite in double precision; the window is then as it was.
        """
        A, n = self._arrays, len(self)
        P = A.R.copy()
        if A.C[ws.FORM] == ws.CHOLESKY_FORM:
            lssvm.cholesky_upper(P, n)
        else:
            lssvm.cholesky_lower(P, n)
            lssvm.inverse_from_cholesky(P, n)
        before = ws.duplicate(A)
        if A.C[ws.FORM] == ws.CHOLESKY_FORM:
            A.order[:n] = np.arange(n)
            ws.take_upper(A, P)
        else:
            A.P[:] = P
        A.V[ws.MINUS], A.V[ws.PLUS] = 0.0, 0.0
        A.C[ws.PENDING], A.C[ws.UNDO] = 0, ws.UNDO_NOTHING
        if not steps.resum(A):
            ws.take_over(A, before)
            raise NumericsError("window: its solution is not finite after a new factorisation; lower gamma")
        A.C[ws.REFRESHES] += 1

    def heal(self) -> bool:
        """Factor anew after a refused step, in the form that the samples' condition requires now (``auto``).

        For ILL_CONDITIONED on good samples: the step may then be taken again. O(N³), as long as some hundred steps,
        without the interpreter's lock. False where R itself is not positive definite, or the window is empty.
        """
        if len(self) == 0:
            return False
        A, before = self._arrays, int(self._arrays.C[ws.FORM])
        A.C[ws.FORM] = self.form_called_for()
        try:
            self.rebuild()
        except NumericsError:
            A.C[ws.FORM] = before
            return False
        return True

    def form_called_for(self) -> int:
        """Form for a new factorisation: Cholesky where the form is free and the condition requires it, else as now."""
        # The error of alpha in the inverse form is a share of cond(R)².
        if self.config.form == "auto" and INVERSE_ERROR_SHARE * self.condition() ** 2 > self.config.accuracy:
            return ws.CHOLESKY_FORM
        return int(self._arrays.C[ws.FORM])

    def condition(self) -> float:
        """Upper bound of cond(R): its largest eigenvalue over the least noise variance. O(N²).

        Omega is positive semidefinite, so no eigenvalue of R lies below the least 1/(gamma w_i). For kernels wider
        than the samples' spacing the bound is close.
        """
        n = len(self)
        if n == 0:
            return 1.0
        return _largest_eigenvalue(self._arrays.R[:n, :n]) * self.config.gamma

    @property
    def round_residual(self) -> float:
        """Largest residual over the last whole round of rows, in target units."""
        return float(self._arrays.F[ws.LAST_WORST])

    def counters(self) -> dict[str, int]:
        """Events since the window was made."""
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
        return {name: int(self._arrays.C[index]) for name, index in names.items()}

    # --- copies --------------------------------------------------------------------------------------------

    def with_hyperparameters(self, widths: tuple[float, ...], gamma: float) -> Window:
        """A new window over the same samples with other hyper-parameters; its counters start at zero."""
        return Window.from_samples(replace(self.config, widths=widths, gamma=gamma), self.X, self.y)

    def copy(self) -> Window:
        """An independent window in the same state, to the last bit."""
        return Window(self.config, ws.duplicate(self._arrays))

    def state(self) -> SolverState:
        """All that changes; `of` continues from it with the same result to the last bit. Copies."""
        A = self._arrays
        saved: dict[str, Any] = {name: getattr(A, name).copy() for name in _SAVED}
        if A.C[ws.FORM] == ws.CHOLESKY_FORM:
            saved["C"][ws.LOGGED] = 0
        return SolverState(**(saved | _matrices(A)))

    @classmethod
    def of(cls, config: WindowConfig, state: SolverState) -> Window:
        """Inverse of ``state``, which is of the sizes of ``config``."""
        window = cls(config)
        A = window.arrays
        if state.PR is None:
            A.P[:], A.R[:] = state.P, state.R
        else:
            below = np.tri(config.capacity, dtype=np.bool_)
            A.P[:] = np.where(below, state.PR[:, :-1], 0.0)
            A.R[:] = np.where(below, state.PR[:, 1:].T, state.PR[:, 1:])
        for name in _SAVED:
            getattr(A, name)[...] = getattr(state, name)
        A.C[ws.UNDO] = ws.UNDO_NOTHING
        if A.C[ws.FORM] == ws.CHOLESKY_FORM:
            ws.take_upper(A, A.P.copy())
        return window


def _matrices(A: ws.WindowArrays) -> dict[str, FloatArray]:
    """P and R of a state.

    In the inverse form the lower triangle of P holds all of it, and R is symmetric: ``PR`` (N, N + 1) is the lower
    triangle of P, and beside it the upper one of R. In the Cholesky form the upper triangle of ``P`` is L' by position.
    """
    if A.C[ws.FORM] == ws.CHOLESKY_FORM:
        upper = np.zeros_like(A.P)
        ws.write_upper(A, upper)
        return {"P": upper, "R": A.R.copy()}
    n = A.P.shape[0]
    packed = np.empty((n, n + 1))
    below = np.tri(n, dtype=np.bool_)
    np.copyto(packed[:, :-1], A.P, where=below)
    np.copyto(packed[:, 1:], A.R, where=below.T)
    return {"PR": packed}


def _largest_eigenvalue(R: FloatArray, iterations: int = 12) -> float:
    """Of a symmetric matrix with positive elements (N, N), by power iteration from the vector of ones.

    The leading eigenvector of such a matrix has one sign (Perron), so the start is never orthogonal to it. The
    Rayleigh quotient is then accurate to some per cent within a dozen steps.
    """
    v = np.ones(R.shape[0])
    value = 0.0
    for _ in range(iterations):
        w = R @ v
        value = float(v @ w / (v @ v))
        v = w / np.linalg.norm(w)
    return value


# --- Healing a window at work: a thread makes a new factorisation, which is swapped in a fixed number of steps later.
#
# The result does not depend on the speed of the thread: where it is not ready in time, the stepping thread waits for
# it. A replay, a copy and a window restored from its state continue with the same numbers to the last bit.


# --- A refresh costs O(N³), as much as some hundred steps. It has three parts: `begin_refresh` copies the state
# (stepping thread, O(N²)), `Refresh.factor` factors the copy (any thread, without the interpreter's lock),
# `Refresh.finish` applies the steps made meanwhile, one for each changed slot, and swaps the arrays in (stepping
# thread).


#: Arrays that a factorisation reads and does not write.
_FIELDS = ("R", "X", "scaled")


@dataclass(slots=True)
class HealingState:
    """A refresh in progress: what it factors."""

    left: Annotated[int, Entry("steps until it is swapped in", low=-1, high=1000)]
    R: Annotated[FloatArray, Entry("kernel matrix with the noise variances", "", "N,N")]
    X: Annotated[FloatArray, Entry("features", "", "d,N")]
    scaled: Annotated[FloatArray, Entry("features over their widths", "", "d,N")]
    y: Annotated[FloatArray, Entry("targets", "V", "N")]
    count: Annotated[int, Entry("samples at its beginning", low=1)]
    form: Annotated[int, Entry("form of the window: 0 inverse, 1 Cholesky", low=0, high=1)]
    new_form: Annotated[int, Entry("form of the new factorisation", low=0, high=1)]

    def check_state(self) -> None:
        """Raise ValueError where there are more samples than slots."""
        if self.count > self.y.size:
            raise ValueError(f"count: got {self.count}, expected at most the window's {self.y.size} samples")


class Refresh:
    """A refresh in progress. ``form`` : of the new factorisation; that of the window unless given."""

    def __init__(self, window: Window, form: int | None = None) -> None:
        self._source = window
        self._form = int(window.arrays.C[ws.FORM])
        self._copy = window.copy()
        self._copy.arrays.C[ws.FORM] = self._form if form is None else form
        self._count = len(window)
        self._factored = False

    def factor(self) -> None:
        """Factor the copy. Any thread. Raises NumericsError where R is not positive definite."""
        self._copy.rebuild()
        self._factored = True

    @property
    def factored(self) -> bool:
        """Whether `factor` has succeeded."""
        return self._factored

    def changed_slots(self) -> IntArray:
        """Slots whose sample differs from the copy's, in order."""
        n, now, then = self._count, self._source.arrays, self._copy.arrays
        return np.flatnonzero(np.any(now.X[:, :n] != then.X[:, :n], axis=0))

    def finish(self) -> bool:
        """Bring the factored copy up to date and swap it in. The stepping thread.

        Returns
        -------
        False where nothing was swapped: not factored yet, the form changed since, or a step of the catch-up refused.
        """
        n, source, copy = len(self._source), self._source.arrays, self._copy
        if not self._factored or source.C[ws.FORM] != self._form:
            return False
        y = source.V[ws.Y]
        for slot in self.changed_slots():
            if copy.replace(int(slot), np.ascontiguousarray(source.X[:, slot]), y[slot]) != ws.ACCEPTED:
                return False
        for slot in range(self._count, n):
            if copy.append(np.ascontiguousarray(source.X[:, slot]), y[slot]) != ws.ACCEPTED:
                return False
        copy.arrays.V[ws.Y, :n] = y[:n]
        copy.arrays.C[ws.CURSOR :] = source.C[ws.CURSOR :]
        copy.arrays.C[ws.REFRESHES] += 1
        copy.arrays.F[ws.RESIDUAL : ws.LAST_WORST + 1] = source.F[ws.RESIDUAL : ws.LAST_WORST + 1]
        if not steps.resum(copy.arrays):
            return False
        copy.arrays.C[ws.UNDO] = ws.UNDO_NOTHING
        self._source.take_arrays(copy.arrays)
        return True

    def state(self, left: int) -> HealingState:
        """The input of the factorisation, as it was at the beginning. May be called while `factor` runs."""
        A = self._copy.arrays
        fields = {name: getattr(A, name).copy() for name in _FIELDS}
        y = A.V[ws.Y].copy()
        return HealingState(left, **fields, y=y, count=self._count, form=self._form, new_form=int(A.C[ws.FORM]))

    @classmethod
    def of(cls, window: Window, state: HealingState) -> Refresh:
        """Inverse of ``state``, for ``window``. The factor has to be made again; it comes out the same."""
        made = cls(window, state.new_form)
        A = made._copy.arrays
        for name in _FIELDS:
            getattr(A, name)[...] = getattr(state, name)
        A.V[ws.Y] = state.y
        A.C[ws.COUNT] = made._count = state.count
        made._form = state.form
        return made


def begin_refresh(window: Window, form: int | None = None) -> Refresh:
    """Start refreshing ``window``, which may continue to step. Raises NumericsError while it is empty."""
    if len(window) == 0:
        raise NumericsError("refresh: the window is empty, there is nothing to factor; wait for samples")
    return Refresh(window, form)


#: Steps from the refusal that begins a refresh to the swap. At 100 steps a second this is a third of a second, ten
#: times the time to factor 500 samples; to catch up costs at most a fifth of a factorisation.
HEALING_STEPS = 32


class Healing:
    """At most one refresh of one window. Owns the thread ``window-healing``. Not for two threads at a time."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._refresh: Refresh | None = None
        self._thread: threading.Thread | None = None
        self._left = 0

    @property
    def open(self) -> bool:
        """Whether a refresh is in progress."""
        return self._refresh is not None

    def begin(self) -> None:
        """Start a refresh unless one is in progress. The window must hold samples."""
        if self._refresh is None:
            self._refresh, self._left = begin_refresh(self._window, self._window.form_called_for()), HEALING_STEPS
            self._start()

    def step(self) -> None:
        """Call before each step of the window: swap in the refresh that is due. Where that fails, heal in line."""
        if self._refresh is None:
            return
        self._left -= 1
        if self._left > 0:
            return
        self._wait()
        refresh, self._refresh = self._refresh, None
        if not refresh.finish():
            self._window.heal()

    def _start(self) -> None:
        assert self._refresh is not None
        self._thread = threading.Thread(target=_factor, args=(self._refresh,), name="window-healing", daemon=True)
        self._thread.start()

    def _wait(self) -> None:
        if self._thread is not None:
            self._thread.join()
        elif self._refresh is not None and not self._refresh.factored:
            _factor(self._refresh)
        self._thread = None

    def __getstate__(self) -> dict[str, Any]:
        # Threads are not copied: wait, so that the copy has the factor.
        self._wait()
        return self.__dict__.copy()

    def state(self) -> HealingState | None:
        """None where no refresh is in progress. Does not wait for the thread."""
        return None if self._refresh is None else self._refresh.state(self._left)

    @classmethod
    def of(cls, window: Window, state: HealingState | None) -> Healing:
        """Inverse of ``state``: continues with the same result to the last bit."""
        made = cls(window)
        if state is not None:
            made._left, made._refresh = state.left, Refresh.of(window, state)
            made._start()
        return made


def _factor(refresh: Refresh) -> None:
    try:
        refresh.factor()
    except NumericsError:
        return  # `Refresh.finish` returns False then.
