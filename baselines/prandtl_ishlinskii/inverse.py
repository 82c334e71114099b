"""The inverse MPI model (2.11): motion in, voltage out, play states as memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import BoolArray, Feedforward, FloatArray, StateDict
from baselines.fit_report import Domain
from baselines.prandtl_ishlinskii.model import (
    MpiParameters,
    inverse_thresholds,
    inverse_weights,
    states_from_inverse,
    states_to_inverse,
)
from baselines.prandtl_ishlinskii.operators import dead_zone_sum, play_step
from baselines.validation import (
    checked_memory,
    checked_motion,
    common_fields,
    common_state,
    of_length,
    positive,
    std_or_nan,
)


@compiled
def run_inverse(
    y_um: FloatArray,
    v_um_per_s: FloatArray,
    plays: FloatArray,
    saturation: FloatArray,
    scalars: FloatArray,
    memory_V: FloatArray,
    u_V: FloatArray,
    inside: BoolArray,
) -> None:
    """Voltages ``u_V`` (k,) for points (k,); ``memory_V`` (n+1,), the forward play states, is advanced in place.

    ``plays``: (4, n+1) rows w_h, its partial sums, r*, w_h*. ``saturation``: (2, m+1) rows d*, w_s*.
    ``scalars``: c, y_ref, lag, y_min, y_max, v_max. A point that is not finite gets NaN and does not change the memory.
    """
    n = memory_V.size
    state = np.empty(n)
    states_to_inverse(plays[0], memory_V, state)
    c, y_ref, lag, y_min, y_max, v_max = scalars
    for k in range(y_um.size):
        y, v = y_um[k], v_um_per_s[k]
        lead = y - y_ref + lag * v
        if not math.isfinite(lead):
            u_V[k] = np.nan
            inside[k] = False
            continue
        play_step(dead_zone_sum(lead, saturation[0], saturation[1]) - c, plays[2], state)
        total = 0.0
        for i in range(n):
            total += plays[3, i] * state[i]
        u_V[k] = total
        inside[k] = y_min <= y <= y_max and abs(v) <= v_max
    states_from_inverse(plays[1], state, memory_V)


@compiled
def _track(u_V: FloatArray, r_V: FloatArray, memory_V: FloatArray) -> None:
    for k in range(u_V.size):
        if math.isfinite(u_V[k]):
            play_step(u_V[k], r_V, memory_V)


@dataclass(frozen=True)
class MpiInverse:
    """Exact inverse of an MPI model; implements ``adaptive.types.InverseModel`` under the name ``mpi``.

    The memory holds the states of the forward plays, V. Only the voltage drives them, so ``track`` uses the applied
    voltages, which carry no sensor noise, and ignores the measured motion. After voltages that this model gave,
    ``track`` and ``feedforward`` agree on the memory to round-off. ``voltage_std_V``: NaN where it is unknown.
    """

    parameters: MpiParameters
    dt_s: float
    domain: Domain
    voltage_std_V: float = math.nan
    name: str = "mpi"
    _plays: FloatArray = field(init=False, repr=False, compare=False)
    _saturation: FloatArray = field(init=False, repr=False, compare=False)
    _scalars: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        positive("dt_s", self.dt_s, "s")
        std_or_nan("voltage_std_V", self.voltage_std_V, "V")
        p, domain = self.parameters, self.domain
        w_h, w_s = p.w_h_, p.w_s_
        plays = np.stack([w_h, np.cumsum(w_h), inverse_thresholds(w_h, p.r_), inverse_weights(w_h)])
        saturation = np.stack([inverse_thresholds(w_s, p.d_), inverse_weights(w_s)])
        scalars = np.array(
            [p.c_um, p.y_ref_um, p.lag_s, domain.y_min_um, domain.y_max_um, domain.v_max_um_per_s], dtype=np.float64
        )
        object.__setattr__(self, "_plays", plays)
        object.__setattr__(self, "_saturation", saturation)
        object.__setattr__(self, "_scalars", scalars)

    @property
    def memory_size(self) -> int:
        """One state per play, V."""
        return int(self._plays.shape[1])

    def rest_memory(self, y_um: float) -> FloatArray:
        """Play states (n+1,) V after a monotone motion from rest at 0 V to ``y_um`` µm."""
        y, rest = np.array([float(y_um)]), np.zeros(1)
        return self.feedforward(y, rest, rest, self.parameters.start()).memory

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """Voltages (n,) V for displacements (n,) µm. Raises InputError on bad shapes."""
        y, v, _ = checked_motion(y_um, v_um_per_s, a_um_per_s2)
        after = checked_memory(memory, self._plays.shape[1])
        u, inside = np.empty(y.size), np.empty(y.size, dtype=np.bool_)
        run_inverse(y, v, self._plays, self._saturation, self._scalars, after, u, inside)
        std = np.empty(y.size)
        std.fill(self.voltage_std_V)
        return Feedforward(u, std, inside, after)

    def track(
        self,
        y_um: FloatArray,
        v_um_per_s: FloatArray,
        a_um_per_s2: FloatArray,
        u_V: FloatArray,
        memory: FloatArray,
    ) -> FloatArray:
        """Play states after the voltages ``u_V`` (n,) were applied; values that are not finite are skipped."""
        y, _, _ = checked_motion(y_um, v_um_per_s, a_um_per_s2)
        after = checked_memory(memory, self._plays.shape[1])
        _track(of_length("u_V", u_V, y.size), self.parameters.r_, after)
        return after

    def carry(self, y_um: FloatArray, u_V: FloatArray, memory: FloatArray) -> None:
        """``track`` in place and without checks; ``u_V`` (n,) V is contiguous."""
        _track(u_V, self.parameters.r_, memory)

    def state_dict(self) -> StateDict:
        """Flat numbers and vectors by name."""
        state = common_state(self.dt_s, self.voltage_std_V, self.domain)
        return {**state, "name": self.name, **self.parameters.state_dict()}

    @staticmethod
    def from_state(state: StateDict) -> MpiInverse:
        """Inverse of :meth:`state_dict`. Raises InputError where a field is missing or wrong."""
        dt_s, std_V, domain = common_fields("mpi", state)
        return MpiInverse(MpiParameters.from_state(state), dt_s, domain, std_V, str(state.get("name", "mpi")))
