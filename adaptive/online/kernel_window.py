"""The learner's window: a sliding LSSVM on what the linear part leaves, and whose slot a new sample takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from adaptive import kernels
from adaptive.errors import InputError
from adaptive.inverse_model import LssvmInverse
from adaptive.online import gates as admission
from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, Hyperparameters, IntArray, StateDict, WindowData
from adaptive.window import arrays as ws
from adaptive.window.arrays import Status
from adaptive.window.config import SolverConfig, WindowConfig
from adaptive.window.healing import Healing
from adaptive.window.window import Window

# --- How much a sample counts: doubtful and old ones less, by their noise weight (weighted LSSVM).
#
# A weight w stands for 1/w times the noise variance, in the window and in the filter alike; 1 is an ordinary sample.


@dataclass(frozen=True, slots=True)
class WeightConfig:
    """All weights 1, but for samples from before a change.

    near_bad : weight of a pair whose smoothing has looked at a reading that was refused.
    on_probation : weight for as long as a jump may still be undone.
    acceleration : noise that acceleration adds, as a share of the ordinary, at full scale of the feature map: the
    weight is 1/(1 + (acceleration a/scale)²). What the smoother leaves is worst where the motion turns fast.
    half_life_s : time after which a sample of the window counts half, s; 0 for never.
    before_change : most that a sample counts from before a change of the stage that was found; 1 to keep them all.
    """

    near_bad: float = 1.0
    on_probation: float = 1.0
    acceleration: float = 0.0
    half_life_s: float = 0.0
    before_change: float = 0.05

    def __post_init__(self) -> None:
        for name in ("near_bad", "on_probation", "before_change"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InputError(f"weights.{name}: got {getattr(self, name)}, expected a weight above 0, up to 1")
        for name in ("acceleration", "half_life_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"weights.{name}: got {value}, expected a finite number, not negative")

    def of(self, near_bad: bool, on_probation: bool, a_share: float) -> float:
        """Weight of a pair that may teach; ``a_share`` is its acceleration, full scale being 1."""
        weight = (self.near_bad if near_bad else 1.0) * (self.on_probation if on_probation else 1.0)
        if self.acceleration > 0.0:
            weight /= 1.0 + (self.acceleration * a_share) ** 2
        return weight

    def faded(self, weight: float, age_s: float) -> float:
        """Weight of a sample that has been in the window for so long; never below a thousandth of its own."""
        return weight * max(float(0.5 ** (age_s / self.half_life_s)), 1e-3) if self.half_life_s > 0.0 else weight


Eviction = Literal["nearest", "fifo"]
#: A sample this close (kernel value) to one that the window holds takes its slot even where there is room.
SAME = 0.98
#: No slot.
NOWHERE = -1


class ResidualWindow:
    """A window LSSVM over kernel inputs (d,), targets in V.

    With ``eviction="nearest"`` a new sample takes the slot of its nearest neighbour: what the window knows of the
    rest of the range stays, however long the stage dwells in one place. ``"fifo"`` drops the oldest.
    """

    def __init__(
        self, capacity: int, model: LssvmInverse, eviction: Eviction = "nearest", solver: SolverConfig | None = None
    ) -> None:
        self.eviction: Eviction = eviction
        widths = tuple(float(w) for w in model.widths)
        s = solver or SolverConfig()
        self._config = WindowConfig(capacity, widths, model.gamma, s.form, s.accuracy)
        #: Variance of the kernel part away from samples, V².
        self.kernel_variance = model.kernel_variance
        self._window = Window(self._config)
        self._healing = Healing(self._window)
        self._born = np.zeros(capacity, dtype=np.int64)
        # The weights that samples came with, before they faded.
        self._own = np.ones(capacity)
        self._clock = 0
        # The samples up to this one are from before the last change; the slots from here on may hold some (-1: none).
        self._changed, self._next = 0, NOWHERE

    @classmethod
    def from_model(
        cls, model: LssvmInverse, capacity: int, eviction: Eviction = "nearest", solver: SolverConfig | None = None
    ) -> ResidualWindow:
        """A window that holds a model's samples and predicts as its kernel part does; the last ``capacity`` of them."""
        made = cls(capacity, model, eviction, solver)
        n = model.support.shape[0]
        if n:
            # A solution knows its targets: y = K alpha + alpha / gamma; its bias is in the linear part already.
            targets = kernels.gram(model.support, None, model.widths) @ model.alpha + model.alpha / model.gamma
            keep = slice(max(0, n - capacity), n)
            made._window = Window.from_samples(made._config, model.support[keep], targets[keep])
            made._healing = Healing(made._window)
        return made

    def __len__(self) -> int:
        return len(self._window)

    @property
    def reach_V(self) -> float:
        """Largest size of the kernel part at the samples of a window that was just made from a model, V."""
        window, gamma = self._window, self._config.gamma
        return float(np.max(np.abs(window.y - window.alpha / gamma), initial=0.0))

    @property
    def residual_V(self) -> float:
        """Worst row residual of the last round over all rows, V."""
        return self._window.round_residual

    @property
    def form(self) -> str:
        """``inverse`` or ``cholesky``, whichever is at work."""
        return self._window.form

    def mean(self, kernel: FloatArray) -> float:
        """Prediction at one point (d,), V."""
        return self._window.predict(kernel)

    def learn(self, kernel: FloatArray, target_V: float, weight: float = 1.0) -> str:
        """Take one sample, of a noise weight. Returns "learnt", or "numerics" where the step was refused, undone.

        A refusal of the window's numerics starts its healing: the same solution is served, and steps that it can't take
        are refused, until a new factorisation is swapped in, `window_healing.STEPS` samples later.
        """
        self._healing.step()
        window, n = self._window, len(self._window)
        slot, value = -1, 0.0
        if n:
            # ``kernels.column`` of inputs that are divided by the widths already.
            away = window.arrays.scaled[:, :n].T - kernel * window.arrays.inverse_widths
            column = np.exp(-np.sum(away**2, axis=1))
            slot = int(np.argmax(column))
            value = float(column[slot])
        self._clock += 1
        room = n < self._config.capacity and value < SAME
        if room:
            slot = n
        elif self.eviction == "fifo":
            slot = int(np.argmin(self._born[:n]))
        status = self._step(slot, room, kernel, target_V, weight)
        if status == Status.ILL_CONDITIONED and n:
            self._healing.begin()
        if status != Status.ACCEPTED:
            return admission.NUMERICS
        self._born[slot] = self._clock
        self._own[slot] = weight
        return admission.LEARNT

    def fade(self, weights: WeightConfig, step_s: float) -> None:
        """Let one sample count by its age, another at each call; ``step_s`` is the time between two steps, s."""
        n = len(self._window)
        if weights.half_life_s <= 0.0 or n == 0:
            return
        slot = self._clock % n
        age_s = float(self._clock - self._born[slot]) * step_s
        self._window.reweight(slot, weights.faded(float(self._own[slot]), age_s))

    def expect_change(self) -> None:
        """The stage has changed: what is in the window is from before. See `let_go`."""
        self._changed, self._next = self._clock, 0

    def keep(self) -> None:
        """There was no change: what has not been let go stays as it is."""
        self._next = NOWHERE

    def let_go(self, most: float) -> None:
        """Let one sample from before the last change count ``most`` at most, another at each call.

        It is not taken out: where nothing newer has come it is still the best there is, but who is nearer or newer now
        outvotes it. One a call, so that no sample has to wait for five hundred steps of the window.
        """
        n = len(self._window)
        while 0 <= self._next < n:
            slot = self._next
            self._next += 1
            if self._born[slot] <= self._changed and self._own[slot] > most:
                if self._window.reweight(slot, most) == Status.ACCEPTED:
                    self._own[slot] = most
                return
        self._next = NOWHERE

    def _step(self, slot: int, room: bool, kernel: FloatArray, target_V: float, weight: float) -> Status:
        return (
            self._window.append(kernel, target_V, weight)
            if room
            else self._window.replace(slot, kernel, target_V, weight)
        )

    def arrays(self) -> tuple[FloatArray, FloatArray, float]:
        """Kernel inputs (n, d), dual weights (n,) and bias, V. Copies."""
        return self._window.X, self._window.alpha, self._window.bias

    def counters(self) -> dict[str, int]:
        """Of the window's numerics."""
        return self._window.counters()

    # ---- hyper-parameters

    @property
    def hyper(self) -> Hyperparameters:
        """Regularisation and kernel widths at work."""
        return Hyperparameters(self._config.gamma, self._config.widths)

    def data(self) -> WindowData:
        """A copy of samples and hyper-parameters."""
        window, n = self._window, len(self._window)
        age = (self._clock - self._born[:n]).astype(np.float64)
        return WindowData(window.X, window.y, window.weights, age, self.hyper)

    def newest(self, count: int) -> FloatArray:
        """(m, d) kernel inputs of the newest samples, m <= count, newest first."""
        return np.ascontiguousarray(self._window.X[self._newest(count)])

    def newest_error_V(self, count: int) -> float:
        """rms, V, of what all others foretell for each of the newest samples: exact leave-one-out; 0 without any."""
        errors = self._window.leave_one_out()[self._newest(count)]
        return float(np.sqrt(np.mean(errors**2))) if errors.size else 0.0

    def with_hyperparameters(self, hyper: Hyperparameters) -> ResidualWindow:
        """A window of the same samples, order of age and counts that works with others.

        Raises InputError on values that are not positive, NumericsError where the kernel matrix can't be factored.
        """
        made = object.__new__(ResidualWindow)
        c = self._config
        made.eviction, made._clock, made._born = self.eviction, self._clock, self._born.copy()
        made._own = self._own.copy()
        made._changed, made._next = self._changed, self._next
        widths = tuple(float(w) for w in hyper.widths)
        if len(widths) != c.dimension:
            raise InputError(f"widths: got {len(widths)}, expected {c.dimension}, one an input of the kernel")
        made._config = WindowConfig(c.capacity, widths, float(hyper.gamma), c.form, c.accuracy)
        made.kernel_variance = self.kernel_variance
        made._window = Window(made._config)
        if len(self._window):
            made._window = self._window.with_hyperparameters(widths, float(hyper.gamma))
            made.kernel_variance = made._window.scale
        made._healing = Healing(made._window)
        made._window.arrays.C[ws.EVENTS] += self._window.arrays.C[ws.EVENTS]
        return made

    def _newest(self, count: int) -> IntArray:
        return np.argsort(-self._born[: len(self._window)], kind="stable")[:count]

    # ---- keeping

    def state_dict(self) -> StateDict:
        """All arrays under flat names, and the hyper-parameters that they are of."""
        own = {
            "born": self._born.copy(),
            "own_weights": self._own.copy(),
            "clock": self._clock,
            "changed": self._changed,
            "next": self._next,
            "kernel_variance": self.kernel_variance,
        }
        hyper = {"gamma": self._config.gamma, "widths": np.array(self._config.widths)}
        healing = prefixed("healing.", self._healing.state_dict())
        return {**self._window.state_dict(), **own, **hyper, **healing}

    def restore(self, values: StateDict) -> None:
        """Go on from a ``state_dict``. Raises InputError where it is of another capacity or number of inputs."""
        c = self._config
        widths = tuple(float(w) for w in values["widths"])
        self._config = WindowConfig(c.capacity, widths, float(values["gamma"]), c.form, c.accuracy)
        self._window = Window.from_state(self._config, values)
        self._healing = Healing.from_state(self._window, under("healing.", values))
        self._born = np.array(values["born"], dtype=np.int64)
        self._own = np.array(values["own_weights"], dtype=np.float64)
        self._clock = int(values["clock"])
        self._changed, self._next = int(values["changed"]), int(values["next"])
        self.kernel_variance = float(values["kernel_variance"])
