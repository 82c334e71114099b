"""The learner's window: a sliding LSSVM on what the linear part leaves, and whose slot a new sample takes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from adaptive import admission, kernels
from adaptive.snapshot import LssvmInverse
from adaptive.types import FloatArray, StateDict
from adaptive.window import Window, WindowConfig
from adaptive.window_state import Status

Eviction = Literal["nearest", "fifo"]
#: A sample this close (kernel value) to one that the window holds takes its slot even where there is room.
SAME = 0.98


class ResidualWindow:
    """A window LSSVM over kernel inputs (d,), targets in V.

    With ``eviction="nearest"`` a new sample takes the slot of its nearest neighbour: what the window knows of the
    rest of the range stays, however long the stage dwells in one place. ``"fifo"`` drops the oldest.
    """

    def __init__(self, capacity: int, model: LssvmInverse, eviction: Eviction = "nearest") -> None:
        self.eviction: Eviction = eviction
        widths = tuple(float(w) for w in model.widths)
        self._config = WindowConfig(capacity, widths, model.gamma)
        self._window = Window(self._config)
        self._born = np.zeros(capacity, dtype=np.int64)
        self._clock = 0

    @classmethod
    def from_model(cls, model: LssvmInverse, capacity: int, eviction: Eviction = "nearest") -> ResidualWindow:
        """A window that holds a model's samples and predicts as its kernel part does; the last ``capacity`` of them."""
        made = cls(capacity, model, eviction)
        n = model.support.shape[0]
        if n:
            # A solution knows its targets: y = K alpha + alpha / gamma; its bias is in the linear part already.
            targets = kernels.gram(model.support, None, model.widths) @ model.alpha + model.alpha / model.gamma
            keep = slice(max(0, n - capacity), n)
            made._window = Window.from_samples(made._config, model.support[keep], targets[keep])
        return made

    def __len__(self) -> int:
        return len(self._window)

    @property
    def residual_V(self) -> float:
        """Worst row residual of the last round over all rows, V."""
        return self._window.round_residual

    def mean(self, kernel: FloatArray) -> float:
        """Prediction at one point (d,), V."""
        return self._window.predict(kernel)

    def learn(self, kernel: FloatArray, target_V: float) -> str:
        """Take one sample. Returns "learnt", or "numerics" where the step was refused and rolled back."""
        window, n = self._window, len(self._window)
        slot, value = -1, 0.0
        if n:
            column = kernels.column(window.arrays.scaled[:, :n].T, kernel * window.arrays.inverse_widths, ONE)
            slot = int(np.argmax(column))
            value = float(column[slot])
        self._clock += 1
        room = n < self._config.capacity and value < SAME
        if room:
            slot = n
        elif self.eviction == "fifo":
            slot = int(np.argmin(self._born[:n]))
        status = self._step(slot, room, kernel, target_V)
        # In line and not beside the work, so that a replay heals at the same sample; queries are not held up by it.
        if status == Status.ILL_CONDITIONED and window.heal():
            status = self._step(slot, room, kernel, target_V)
        if status != Status.ACCEPTED:
            return admission.NUMERICS
        self._born[slot] = self._clock
        return admission.LEARNT

    def _step(self, slot: int, room: bool, kernel: FloatArray, target_V: float) -> Status:
        return self._window.append(kernel, target_V) if room else self._window.replace(slot, kernel, target_V)

    def arrays(self) -> tuple[FloatArray, FloatArray, float]:
        """Kernel inputs (n, d), dual weights (n,) and bias, V. Copies."""
        return self._window.X, self._window.alpha, float(self._window.arrays.beta[0])

    def counters(self) -> dict[str, int]:
        """Of the window's numerics."""
        return self._window.counters()

    def state_dict(self) -> StateDict:
        return {**self._window.state_dict(), "born": self._born.copy(), "clock": self._clock}

    def restore(self, values: StateDict) -> None:
        """Go on from a ``state_dict``. Raises InputError where it is of another configuration."""
        self._window = Window.from_state(self._config, values)
        self._born = np.array(values["born"], dtype=np.int64)
        self._clock = int(values["clock"])


ONE = np.ones(1)
