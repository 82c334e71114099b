"""The plainest model: displacement is gain times voltage plus an offset. No memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import Feedforward, FloatArray, StateDict
from baselines.validation import Domain, deviation, memory_copy, model_fields, model_state, points, positive


@dataclass(frozen=True)
class LinearParameters:
    """``y = gain u + offset``; gain µm/V, not zero; offset µm."""

    gain_um_per_V: float
    offset_um: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gain_um_per_V) and self.gain_um_per_V != 0.0):
            raise InputError(f"gain_um_per_V: got {self.gain_um_per_V!r}, expected a finite value other than 0")
        if not math.isfinite(self.offset_um):
            raise InputError(f"offset_um: got {self.offset_um!r}, expected a finite value")

    def simulate(self, u_V: FloatArray, dt_s: float) -> FloatArray:
        """Displacement (n,) µm for voltages (n,) V; ``dt_s`` does not matter."""
        return np.asarray(u_V, dtype=np.float64) * self.gain_um_per_V + self.offset_um


@dataclass(frozen=True)
class LinearInverse:
    """Inverse of :class:`LinearParameters`; implements ``adaptive.types.InverseModel`` under the name ``linear``.

    ``voltage_std_V`` is one standard deviation of the voltage, from the residual of the identification.
    """

    parameters: LinearParameters
    dt_s: float
    domain: Domain
    voltage_std_V: float = math.nan
    name: str = "linear"

    def __post_init__(self) -> None:
        positive("dt_s", self.dt_s, "s")
        deviation("voltage_std_V", self.voltage_std_V, "V")

    @property
    def memory_size(self) -> int:
        """0: a line remembers nothing."""
        return 0

    def rest_memory(self, y_um: float) -> FloatArray:
        """Empty (0,)."""
        return np.empty(0)

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """Voltages (n,) V for displacements (n,) µm; raises InputError on bad shapes."""
        y, _, _ = points(y_um, v_um_per_s, a_um_per_s2)
        p, domain = self.parameters, self.domain
        return Feedforward(
            u_V=(y - p.offset_um) / p.gain_um_per_V,
            std_V=np.full(y.size, self.voltage_std_V),
            inside=(y >= domain.y_min_um) & (y <= domain.y_max_um),
            memory=memory_copy(memory, 0),
        )

    def track(
        self,
        y_um: FloatArray,
        v_um_per_s: FloatArray,
        a_um_per_s2: FloatArray,
        u_V: FloatArray,
        memory: FloatArray,
    ) -> FloatArray:
        """Empty (0,)."""
        return memory_copy(memory, 0)

    def state_dict(self) -> StateDict:
        """Flat numbers by name."""
        p = self.parameters
        state = model_state(self.dt_s, self.voltage_std_V, self.domain)
        return {**state, "name": self.name, "gain_um_per_V": p.gain_um_per_V, "offset_um": p.offset_um}

    @staticmethod
    def from_state(state: StateDict) -> LinearInverse:
        """Inverse of :meth:`state_dict`; raises InputError where a field is missing."""
        dt_s, std_V, domain = model_fields("linear", state)
        try:
            parameters = LinearParameters(float(state["gain_um_per_V"]), float(state["offset_um"]))
        except KeyError as missing:
            raise InputError(f"{missing.args[0]}: missing in the state of a linear model; write it anew") from None
        return LinearInverse(parameters, dt_s, domain, std_V, str(state.get("name", "linear")))
