"""The learner's window: a sliding LSSVM on the residual of the linear part, its eviction rule, its old samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from dehyst.adaptive import features
from dehyst.adaptive.compiled import shared
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates as admission
from dehyst.adaptive.state import Entry, Numbers, load, save
from dehyst.adaptive.types import FloatArray, Hyperparameters, IntArray, StateDict, WindowData
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import Status, WindowArrays
from dehyst.adaptive.window.window import Healing, HealingState, SolverConfig, SolverState, Window, WindowConfig

Eviction = Literal["nearest", "fifo"]
#: A sample with a kernel value above this to a held one takes its slot even where there are free slots.
SAME = 0.98


@shared
def due(updates: int, every: int) -> bool:
    """Whether the window learns what the filter takes as its update number ``updates``: once in ``every`` of them.

    It is one place later in each block than in the last: at a fixed place it would meet periodic motion in the same few
    phases for ever.
    """
    return updates % every == (updates // every) % every


#: Time over which the share of the kernel part is taken, s: a stroke of a usual motion.
SHARE_S = 0.5


class KernelShare(Numbers):
    """Numbers of a window: steps so far, and the share of the kernel part that recent measurements confirm.

    The share is the least-squares factor of the kernel part.

    The kernel part is local. Where it was learnt from another motion than the present one, it only disturbs the linear
    part, which then learns faster without it.
    """

    product_V2: Annotated[float, Entry("mean product of the kernel part and what the linear part leaves", "V²")] = 0.0
    square_V2: Annotated[float, Entry("mean square of the kernel part", "V²", low=0.0)] = 0.0
    share: Annotated[float, Entry("share of the kernel part that is served", low=0.0, high=1.0)] = 1.0
    clock: Annotated[int, Entry("steps so far", low=0)] = 0
    kernel_variance: Annotated[float, Entry("variance of the kernel part away from samples", "V²", low=0.0)] = 0.0

    @shared
    def take(self, kernel_V: float, left_V: float, step_s: float) -> None:
        """Take one measurement: the kernel part there, and what the linear part leaves of the voltage, V."""
        fast = min(1.0, step_s / SHARE_S)
        self.product_V2 += (kernel_V * left_V - self.product_V2) * fast
        self.square_V2 += (kernel_V * kernel_V - self.square_V2) * fast
        if self.square_V2 > 0.0:
            self.share = min(max(self.product_V2 / self.square_V2, 0.0), 1.0)


@dataclass(slots=True)
class KernelState:
    """What a `ResidualWindow` holds beside the arrays of its solver."""

    born: Annotated[IntArray, Entry("step that each sample came with", "", "N")]
    gamma: Annotated[float, Entry("regularisation", low=0.0)]
    widths: Annotated[tuple[float, ...], Entry("kernel widths", "", "d", low=1e-100)]
    healing: Annotated[HealingState | None, Entry("a new factorisation on its way")]
    solver: Annotated[SolverState, Entry("arrays of the solver", name="")]


@shared
def learn(A: WindowArrays, share: KernelShare, x: FloatArray, target_V: float, born: IntArray, fifo: bool) -> int:
    """See `ResidualWindow.learn`: the status of the step. born (N,) : step that a sample came with."""
    n = A.C[ws.COUNT]
    slot, value = steps.nearest(A, x)
    share.clock += 1
    room = n < A.S.shape[0] and value < SAME
    if room:
        slot = n
        status = steps.append(A, x, target_V)
    else:
        if fifo:
            slot = int(np.argmin(born[:n]))
        status = steps.replace(A, slot, x, target_V)
    if status == ws.ACCEPTED:
        born[slot] = share.clock
    return int(status)


class ResidualWindow:
    """A window LSSVM over kernel inputs (d,), targets in V.

    With ``eviction="nearest"`` a new sample takes the slot of its nearest neighbour, so that a rest in one place does
    not remove the samples of the other places. ``"fifo"`` drops the oldest sample.
    """

    def __init__(
        self,
        capacity: int,
        model: LssvmInverse,
        eviction: Eviction = "nearest",
        solver: SolverConfig | None = None,
        arrays: WindowArrays | None = None,
        share: KernelShare | None = None,
        born: IntArray | None = None,
    ) -> None:
        """``arrays``, ``share`` and ``born`` : where its state is kept; of its own unless given."""
        self.eviction: Eviction = eviction
        widths = tuple(float(w) for w in model.widths)
        s = solver or SolverConfig()
        self._config = WindowConfig(capacity, widths, model.gamma, s.form, s.accuracy)
        self._window = Window(self._config, arrays)
        self._healing = Healing(self._window)
        self._born = np.zeros(capacity, dtype=np.int64) if born is None else born
        self._share = share or KernelShare()
        self._share.share, self._share.kernel_variance = 1.0, model.kernel_variance

    @classmethod
    def from_model(cls, model: LssvmInverse, capacity: int, *others: Any) -> ResidualWindow:
        """A window that holds a model's samples and predicts as its kernel part does; the last ``capacity`` of them.

        ``others`` : as of the constructor; ``arrays`` that are given hold the samples already.
        """
        made = cls(capacity, model, *others)
        n = model.support.shape[0]
        if n and not len(made):
            # The targets follow from the solution: y = K alpha + alpha / gamma. Its bias is in the linear part.
            targets = features.gram(model.support, None, model.widths) @ model.alpha + model.alpha / model.gamma
            keep = slice(max(0, n - capacity), n)
            made._window = Window.from_samples(made._config, model.support[keep], targets[keep])
            made._healing = Healing(made._window)
        if len(made):
            # The weight of a share of 1 is the mean square of the kernel part at its samples.
            made._share.product_V2 = made._share.square_V2 = float(np.mean(made._at_samples_V**2))
        return made

    def __len__(self) -> int:
        return len(self._window)

    @property
    def window_arrays(self) -> WindowArrays:
        """The state of the solver; written in place by each step."""
        return self._window.arrays

    def take_arrays(self, arrays: WindowArrays) -> None:
        """Continue with other arrays of the same sizes."""
        self._window.take_arrays(arrays)

    @property
    def handle(self) -> IntArray:
        """The handle of ``window_arrays``; another one after a healing."""
        return self._window.handle

    @property
    def kernel_variance(self) -> float:
        """Variance of the kernel part away from samples, V²."""
        return self._share.kernel_variance

    @property
    def heals(self) -> bool:
        """Whether a new factorisation is on its way."""
        return self._healing.open

    def begin_healing(self) -> None:
        """A step was refused for numerics: make a new factorisation."""
        self._healing.begin()

    @property
    def reach_V(self) -> float:
        """Largest size of the kernel part at the samples of a window that was just made from a model, V."""
        return float(np.max(np.abs(self._at_samples_V), initial=0.0))

    @property
    def _at_samples_V(self) -> FloatArray:
        """(n,) kernel part at the samples of such a window."""
        at: FloatArray = self._window.y - self._window.alpha / self._config.gamma
        return at

    @property
    def residual_V(self) -> float:
        """Worst row residual of the last round over all rows, V."""
        return self._window.round_residual

    @property
    def form(self) -> str:
        """The form in use, ``inverse`` or ``cholesky``."""
        return self._window.form

    @property
    def share(self) -> float:
        """Share of the kernel part that is served, 0 to 1; see `KernelShare`."""
        return self._share.share

    def predict(self, kernel: FloatArray) -> float:
        """The whole kernel part at one point (d,), V."""
        return self._window.predict(kernel)

    def mean(self, kernel: FloatArray) -> float:
        """The share of it that is served, V."""
        return self._share.share * self._window.predict(kernel)

    def learn(self, kernel: FloatArray, target_V: float) -> str:
        """Learn one sample. Returns "learnt", or "numerics" where the step was refused and undone.

        A numerical refusal starts the healing of the window. The same solution is served, and steps that fail are
        refused, until a new factorisation is swapped in `adaptive.window.window.HEALING_STEPS` samples later.
        """
        self._healing.step()
        A, n, x = self._window.arrays, len(self._window), np.ascontiguousarray(kernel, dtype=np.float64)
        status = learn(A, self._share, x, float(target_V), self._born, self.eviction == "fifo")
        if status == Status.ILL_CONDITIONED and n:
            self._healing.begin()
        return admission.LEARNT if status == Status.ACCEPTED else admission.NUMERICS

    def arrays(self) -> tuple[FloatArray, FloatArray, float]:
        """Kernel inputs (n, d), dual weights (n,) and bias, V, of the share that is served. Copies."""
        share = self._share.share
        return self._window.X, share * self._window.alpha, share * self._window.bias

    def counters(self) -> dict[str, int]:
        """Events of the window's numerics; see `Window.counters`."""
        return self._window.counters()

    # ---- hyper-parameters

    @property
    def hyper(self) -> Hyperparameters:
        """Regularisation and kernel widths in use."""
        return Hyperparameters(self._config.gamma, self._config.widths)

    def data(self) -> WindowData:
        """A copy of samples and hyper-parameters."""
        window, n = self._window, len(self._window)
        age = (self._share.clock - self._born[:n]).astype(np.float64)
        return WindowData(window.X, window.y, age, self.hyper)

    def newest(self, count: int) -> FloatArray:
        """(m, d) kernel inputs of the newest samples, m <= count, newest first."""
        return np.ascontiguousarray(self._window.X[self._newest(count)])

    def newest_error_V(self, count: int) -> float:
        """rms leave-one-out error of the newest samples, V; exact; 0 without any."""
        errors = self._window.leave_one_out()[self._newest(count)]
        return float(np.sqrt(np.mean(errors**2))) if errors.size else 0.0

    def with_hyperparameters(self, hyper: Hyperparameters) -> ResidualWindow:
        """A window with the same samples, ages and counters, and other hyper-parameters.

        Raises InputError on values that are not positive, NumericsError where the kernel matrix cannot be factored.
        """
        made = object.__new__(ResidualWindow)
        c = self._config
        made.eviction, made._born = self.eviction, self._born.copy()
        made._share = KernelShare(record=self._share.record.copy())
        widths = tuple(float(w) for w in hyper.widths)
        if len(widths) != c.dimension:
            raise InputError(f"widths: got {len(widths)}, expected {c.dimension}, one an input of the kernel")
        made._config = WindowConfig(c.capacity, widths, float(hyper.gamma), c.form, c.accuracy)
        made._window = Window(made._config)
        if len(self._window):
            made._window = self._window.with_hyperparameters(widths, float(hyper.gamma))
            made._share.kernel_variance = made._window.scale
        made._healing = Healing(made._window)
        made._window.arrays.C[ws.EVENTS] += self._window.arrays.C[ws.EVENTS]
        return made

    def become(self, other: ResidualWindow) -> None:
        """Continue as a window of the same samples with other hyper-parameters."""
        self._config, self._window, self._healing = other._config, other._window, other._healing
        self._share.record[...] = other._share.record

    def _newest(self, count: int) -> IntArray:
        return np.argsort(-self._born[: len(self._window)], kind="stable")[:count]

    # ---- keeping

    def state_dict(self) -> StateDict:
        """All arrays under flat names, and their hyper-parameters; the numbers are its owner's."""
        c, healing = self._config, self._healing.state()
        return save(KernelState(self._born.copy(), c.gamma, c.widths, healing, self._window.state()), copies=False)

    def read(self, values: StateDict) -> KernelState:
        """A ``state_dict`` for `take`. Raises ModelFileError where it does not fit."""
        return load(KernelState, values, {"N": self._config.capacity, "d": self._config.dimension})

    def take(self, state: KernelState) -> None:
        """Continue from ``state``."""
        c = self._config
        self._config = WindowConfig(c.capacity, state.widths, state.gamma, c.form, c.accuracy)
        self._window = Window.of(self._config, state.solver)
        self._healing = Healing.of(self._window, state.healing)
        self._born[:] = state.born
