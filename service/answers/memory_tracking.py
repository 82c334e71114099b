"""The hysteresis memory that the service tracks from measured samples, for queries that bring none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from adaptive.types import FloatArray, InverseModel


class MemoryTracker:
    """Collects samples between two snapshots and advances the memory of every model by them at once.

    Velocity and acceleration are backward differences; sample (k) pairs the motion at t_k with the voltage applied
    from t_k on. What is not finite is left out.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._rows: list[tuple[float, float, float, float]] = []
        self._begun = False
        self.forget()

    def forget(self) -> None:
        """Drop what waits, and begin the differences anew."""
        self._rows.clear()
        self._seq = -1
        self._y = math.nan
        self._v = math.nan

    def state_dict(self) -> dict[str, float | FloatArray]:
        """All of it: numbers, and (n, 4) rows that wait."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 4)
        return {"rows": rows, "begun": float(self._begun), "seq": self._seq, "y": self._y, "v": self._v}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``. Raises KeyError or ValueError, before anything changes, where it is damaged."""
        rows = [(y, v, a, u) for y, v, a, u in np.asarray(state["rows"], dtype=np.float64).reshape(-1, 4).tolist()]
        begun, seq, y, v = bool(state["begun"]), int(state["seq"]), float(state["y"]), float(state["v"])
        self._rows, self._begun, self._seq, self._y, self._v = rows, begun, seq, y, v

    def add(self, seq: int, u_V: float, y_um: float) -> None:
        """One sample in order: voltage in V, displacement in µm."""
        if not (math.isfinite(u_V) and math.isfinite(y_um)):
            return
        step_s = (seq - self._seq) * self._dt_s
        v = (y_um - self._y) / step_s if math.isfinite(self._y) else 0.0
        a = (v - self._v) / step_s if math.isfinite(self._v) else 0.0
        self._rows.append((y_um, v, a, u_V))
        self._seq, self._y, self._v = seq, y_um, v

    def advance(self, models: dict[str, InverseModel], memories: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """New memories by name after all that was added since the last call; the given ones are not changed."""
        if not self._rows:
            return memories
        y, v, a, u = np.array(self._rows).T.copy()
        self._rows.clear()
        advanced = {}
        for name, model in models.items():
            memory = memories[name]
            # Before the first samples nobody knew where the stage rests.
            if not self._begun or memory.size != model.memory_size:
                memory = model.rest_memory(float(y[0]))
            after = model.track(y, v, a, u, memory)
            advanced[name] = after if np.isfinite(after).all() else memory
        self._begun = True
        return advanced
