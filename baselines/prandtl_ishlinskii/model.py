"""The modified Prandtl-Ishlinskii (MPI) model (2.4)-(2.10) and its exact inverse (2.11)-(2.18).

The forward model takes the voltage u through a sum of plays to x, and through a sum of dead zones to y::

    x = sum_i w_h[i] H_r[i][u] + c,     y - y_ref = sum_j w_s[j] S_d[j][x]

``c`` and ``y_ref`` extend the chapter's model to recordings whose displacement at 0 V is not zero; with both zero
these are (2.7)-(2.10). Without dead zones it is the Prandtl-Ishlinskii (PI) model.

The memory is always the states of the *forward* plays, in volts. They do not depend on the weights, so a memory stays
valid when the weights are learnt anew. The inverse works on (2.15) of it and converts back, which is exact because
all partial sums of w_h are positive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.baselines.common import BaselineInverse
from dehyst.baselines.prandtl_ishlinskii.operators import dead_zone_sum, play_start, play_step


def inverse_weights(w: FloatArray) -> FloatArray:
    """Weights (n+1,) of the inverse operator: (2.12), (2.13) for plays, (2.16), (2.17) for dead zones."""
    sums = np.cumsum(w)
    out = np.empty_like(w)
    out[0] = 1.0 / w[0]
    out[1:] = -w[1:] / (sums[1:] * sums[:-1])
    return out


def inverse_thresholds(w: FloatArray, r: FloatArray) -> FloatArray:
    """Thresholds (n+1,) of the inverse operator: (2.14) for plays, (2.18) for dead zones."""
    return np.cumsum(w) * r - np.cumsum(w * r)


@compiled
def states_to_inverse(w_h: FloatArray, state_V: FloatArray, out_um: FloatArray) -> None:
    """Inverse play states ``out_um`` from forward ones (2.15); all (n+1,)."""
    tail = 0.0
    for j in range(w_h.size):
        tail += w_h[j] * state_V[j]
    head = 0.0
    for i in range(w_h.size):
        head += w_h[i]
        tail -= w_h[i] * state_V[i]
        out_um[i] = head * state_V[i] + tail


@compiled
def states_from_inverse(sum_h: FloatArray, inverse_um: FloatArray, out_V: FloatArray) -> None:
    """Forward play states ``out_V`` from inverse ones, (2.15) solved; ``sum_h``: partial sums of w_h, all positive."""
    n = sum_h.size
    out_V[n - 1] = inverse_um[n - 1] / sum_h[n - 1]
    for i in range(n - 2, -1, -1):
        out_V[i] = out_V[i + 1] + (inverse_um[i] - inverse_um[i + 1]) / sum_h[i]


@compiled
def _run_forward(
    u_V: FloatArray,
    r_V: FloatArray,
    w_h: FloatArray,
    d_um: FloatArray,
    w_s: FloatArray,
    c_um: float,
    y_ref_um: float,
    state_V: FloatArray,
    y_um: FloatArray,
) -> None:
    """Displacements (n,) for voltages (n,); ``state_V`` is advanced in place."""
    for k in range(u_V.size):
        play_step(u_V[k], r_V, state_V)
        x = c_um
        for i in range(r_V.size):
            x += w_h[i] * state_V[i]
        y_um[k] = dead_zone_sum(x, d_um, w_s) + y_ref_um


def _tuple(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


@dataclass(frozen=True)
class MpiParameters:
    """An MPI model (2.10): thresholds, weights, offsets. The defaults of ``d_um`` and ``w_s`` make it a PI model (2.7).

    Attributes
    ----------
    r_V, w_h : (n+1,) play thresholds, V, ascending from 0, and weights, µm/V; partial sums positive.
    d_um, w_s : (m+1,) dead-zone thresholds, µm of x, ascending from 0, and weights; partial sums positive.
    c_um : offset of x, µm. y_ref_um : displacement where x = 0, µm.
    lag_s : first-order lag of the stage, s, which the inverse leads as y + lag v; 0 is the chapter's model.

    Raises InputError on thresholds, weights or offsets that do not make an invertible model.
    """

    r_V: Annotated[tuple[float, ...], Entry("play thresholds, ascending from 0", "V", "plays", most=10_000)]
    w_h: Annotated[tuple[float, ...], Entry("their weights", "µm/V", "plays", most=10_000)]
    d_um: Annotated[tuple[float, ...], Entry("dead-zone thresholds, ascending from 0", "µm", "zones", most=10_000)] = (
        0.0,
    )
    w_s: Annotated[tuple[float, ...], Entry("their weights", "", "zones", most=10_000)] = (1.0,)
    c_um: Annotated[float, Entry("offset of x", "µm")] = 0.0
    y_ref_um: Annotated[float, Entry("displacement where x is 0", "µm")] = 0.0
    lag_s: Annotated[float, Entry("first-order lag of the stage", "s")] = 0.0
    r_: FloatArray = field(init=False, repr=False, compare=False)
    w_h_: FloatArray = field(init=False, repr=False, compare=False)
    d_: FloatArray = field(init=False, repr=False, compare=False)
    w_s_: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        pairs = (("r_V", "w_h"), ("d_um", "w_s"))
        for threshold_field, weight_field in pairs:
            thresholds = np.array(getattr(self, threshold_field), dtype=np.float64)
            weights = np.array(getattr(self, weight_field), dtype=np.float64)
            if thresholds.shape != weights.shape or thresholds.size == 0:
                raise InputError(
                    f"{weight_field}: got {weights.size} weights for {thresholds.size} thresholds, expected as many"
                )
            if thresholds[0] != 0.0 or not np.all(np.diff(thresholds) > 0.0):
                raise InputError(f"{threshold_field}: got {thresholds.tolist()}, expected ascending values from 0")
            if not (np.all(np.isfinite(weights)) and np.all(np.cumsum(weights) > 0.0)):
                raise InputError(
                    f"{weight_field}: got {weights.tolist()}, expected partial sums above 0; else there is no inverse"
                )
            object.__setattr__(self, "r_" if threshold_field == "r_V" else "d_", thresholds)
            object.__setattr__(self, f"{weight_field}_", weights)
        for name in ("c_um", "y_ref_um", "lag_s"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name}: got {getattr(self, name)!r}, expected a finite number")

    def start(self, u_V: float = 0.0) -> FloatArray:
        """Play states (n+1,) V after a monotone change from rest at 0 V to ``u_V`` (2.5)."""
        return play_start(u_V, self.r_)

    def simulate(self, u_V: FloatArray, dt_s: float, state_V: FloatArray | None = None) -> FloatArray:
        """Displacement (n,) µm for voltages (n,) V, ``dt_s`` s apart, from a copy of ``state_V`` or from rest."""
        u = np.ascontiguousarray(u_V, dtype=np.float64)
        if u.size == 0:
            return np.empty(0)
        state = self.start(float(u[0])) if state_V is None else state_V.copy()
        y = np.empty(u.size)
        _run_forward(u, self.r_, self.w_h_, self.d_, self.w_s_, self.c_um, self.y_ref_um, state, y)
        return _lag(y, self.lag_s / dt_s) if self.lag_s > 0.0 else y


def from_inverse_saturation(
    r_V: FloatArray,
    w_h: FloatArray,
    d_star_um: FloatArray,
    w_star: FloatArray,
    c_um: float,
    y_ref_um: float,
    lag_s: float = 0.0,
) -> MpiParameters:
    """Model from plays and the *inverse* saturation (d*, w*), which (2.40) identifies.

    (2.16)-(2.18) are their own inverse, so they give w_s and d.
    """
    return MpiParameters(
        r_V=_tuple(r_V),
        w_h=_tuple(w_h),
        d_um=_tuple(inverse_thresholds(w_star, d_star_um)),
        w_s=_tuple(inverse_weights(w_star)),
        c_um=float(c_um),
        y_ref_um=float(y_ref_um),
        lag_s=float(lag_s),
    )


@compiled
def _lag(y_um: FloatArray, lag_samples: float) -> FloatArray:
    """First-order lag, exact for an input that is linear within each step, started in equilibrium."""
    decay = math.exp(-1.0 / lag_samples)
    mean = lag_samples * (1.0 - decay)
    out = np.empty(y_um.size)
    out[0] = y_um[0]
    for k in range(1, y_um.size):
        out[k] = decay * out[k - 1] + (mean - decay) * y_um[k - 1] + (1.0 - mean) * y_um[k]
    return out


# --- The inverse MPI model (2.11): motion in, voltage out, play states as memory.


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
class MpiInverse(BaselineInverse):
    """Exact inverse of an MPI model. The memory holds the states of the forward plays, V.

    After voltages that this model gave, ``track`` and ``feedforward`` agree on the memory to round-off.
    """

    parameters: Annotated[MpiParameters, Entry("the identified stage", name="")]
    name: Annotated[str, Entry("by which it is served", most=1000)] = "mpi"
    _plays: FloatArray = field(init=False, repr=False, compare=False)
    _saturation: FloatArray = field(init=False, repr=False, compare=False)
    _scalars: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
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
        return int(self._plays.shape[1])

    def _start(self) -> FloatArray:
        return self.parameters.start()

    def _run(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray, u_V: FloatArray,
        inside: BoolArray,
    ) -> None:  # fmt: skip
        run_inverse(y_um, v_um_per_s, self._plays, self._saturation, self._scalars, memory, u_V, inside)

    def _drive(self, u_V: FloatArray, memory: FloatArray) -> None:
        _track(u_V, self.parameters.r_, memory)
