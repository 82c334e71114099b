"""The Bouc-Wen stage (2.1), (2.2) with n = 1, simulated without step-size error, and its inverse.

Divided by k, (2.1) is a second-order system of unit gain, driven by ``w = u - g`` in volts::

    (m/k) y'' + (b/k) y' + y = d w + y0,        g = h/d

so only the ratios m/k and b/k matter, and the hysteresis (2.2) runs in volts, independent of d.

**Hold.** ``hold="linear"`` (default) joins the voltages by straight lines. That is right for recordings of smooth
signals at any sample time, decimated ones too. For a stage behind a D/A converter, the converter's half step of delay
and the convention that y is read before u is applied then appear as part of b/k, which the inverse leads.
``hold="zero_order"`` lets u jump at t_k and rest until t_{k+1}, as the converter does; y_k is read before the jump.

`baselines.bouc_wen.step` holds the steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.baselines.bouc_wen.step import crossing, hysteresis_step, poles, run_stage, settled
from dehyst.baselines.common import BaselineInverse


@dataclass(frozen=True)
class BoucWenParameters:
    """The seven parameters of (2.1), (2.2), an offset, and the hold convention of the module.

    Raises InputError unless m, b, k, d are positive and the drive u - g rises with u along every branch, which the
    inverse needs: alpha < 1, 2 alpha beta < beta + gamma, and beta + gamma > 0.
    """

    m_kg: Annotated[float, Entry("m", "kg")]
    b_N_s_per_m: Annotated[float, Entry("b", "N s/m")]
    k_N_per_m: Annotated[float, Entry("k", "N/m")]
    d_um_per_V: Annotated[float, Entry("d", "µm/V")]
    alpha: Annotated[float, Entry("alpha")]
    beta_per_V: Annotated[float, Entry("beta", "1/V")]
    gamma_per_V: Annotated[float, Entry("gamma", "1/V")]
    offset_um: Annotated[float, Entry("displacement at 0 V", "µm")] = 0.0
    hold: Annotated[str, Entry("hold convention", among=("linear", "zero_order"))] = "linear"
    shape: FloatArray = field(init=False, repr=False, compare=False)
    modes: tuple[complex, complex] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("m_kg", "b_N_s_per_m", "k_N_per_m", "d_um_per_V"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"{name}: got {value!r}, expected a finite value above 0")
        alpha, beta, gamma = self.alpha, self.beta_per_V, self.gamma_per_V
        if not all(math.isfinite(value) for value in (alpha, beta, gamma, self.offset_um)):
            raise InputError(f"alpha, beta_per_V, gamma_per_V, offset_um: got {self!r}, expected finite values")
        if not (0.0 <= alpha < 1.0 and beta >= 0.0 and beta + gamma > 0.0 and 2.0 * alpha * beta < beta + gamma):
            raise InputError(
                f"alpha, beta_per_V, gamma_per_V: got {alpha!r}, {beta!r}, {gamma!r}, expected 0 <= alpha < 1, "
                "beta >= 0 and 2 alpha beta < beta + gamma; otherwise displacement does not rise with voltage"
            )
        if self.hold not in ("linear", "zero_order"):
            raise InputError(f"hold: got {self.hold!r}, expected 'linear' or 'zero_order'")
        object.__setattr__(self, "shape", np.array([alpha, beta, gamma]))
        object.__setattr__(self, "modes", poles(self.lag_s, self.inertia_s2))

    @property
    def lag_s(self) -> float:
        """b/k, s."""
        return self.b_N_s_per_m / self.k_N_per_m

    @property
    def inertia_s2(self) -> float:
        """m/k, s²."""
        return self.m_kg / self.k_N_per_m

    def at_rest(self, u_V: float = 0.0) -> FloatArray:
        """State (6,) after a monotone change from rest at 0 V to ``u_V``, settled there."""
        g = hysteresis_step(0.0, float(u_V), self.alpha, self.beta_per_V, self.gamma_per_V)
        return settled(float(u_V), g)

    def simulate(self, u_V: FloatArray, dt_s: float, state: FloatArray | None = None) -> FloatArray:
        """Displacement (n,) µm for voltages (n,) V, ``dt_s`` s apart; see :meth:`motion`."""
        return self.motion(u_V, dt_s, state)[0]

    def motion(
        self, u_V: FloatArray, dt_s: float, state: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement µm, velocity µm/s and acceleration µm/s², (n,) each, for voltages (n,) V.

        Starts from a copy of ``state`` (6,); by default settled at ``u_V[0]`` under the linear hold and at 0 V under
        the zero-order hold. Under the zero-order hold the acceleration is that after the jump.
        """
        u = np.ascontiguousarray(u_V, dtype=np.float64)
        out = np.empty((u.size, 3))
        linear = self.hold == "linear"
        if u.size:
            first = self.at_rest(float(u[0]) if linear else 0.0) if state is None else state.copy()
            run_stage(u, float(dt_s), *self.modes, self.shape, linear, first, out)
        d = self.d_um_per_V
        a = (out[:, 2] - out[:, 0] - self.lag_s * out[:, 1]) / self.inertia_s2
        return d * out[:, 0] + self.offset_um, d * out[:, 1], d * a

    def with_gain(self, d_um_per_V: float, offset_um: float) -> BoucWenParameters:
        """The same hysteresis and dynamics with another gain and offset."""
        return replace(self, d_um_per_V=d_um_per_V, offset_um=offset_um)


#: The chapter's identified stage, Table 2.1 (d: 1.1351e-5 m/V).
TABLE_2_1 = BoucWenParameters(0.2789, 8.9055e5, 3.5244e8, 11.351, 0.4754, 0.8718, 0.9925)


# --- The inverse Bouc-Wen model (Fig. 2.5): motion in, voltage out, (u, g) as memory.
#
# At each point (2.1) gives the drive that the motion needs, ``w = (y - y0 + (b/k) v + (m/k) a)/d``. The voltage is the
# root of ``u - g(u) = w`` on the branch that leaves the remembered (u, g). With s = |u - u_prev| this reads
# ``s - (q(s) - q0) = |w - w_prev|``, a line plus an exponential on each side of q = 0. Newton's method, started from
# the side where it cannot overshoot, converges to round-off in a few steps.


_FLAT = 1e-7
_NEWTON_LIMIT = 60


@compiled
def _solve(q: float, target: float, alpha: float, rate: float) -> float:
    """Root s >= 0 of s - (q(s) - q) = target with q' = alpha - rate q.

    The left side rises; it is convex for rate > 0 and concave for rate < 0 (q' > 0 here). The root of the first
    tangent lies right of the solution, or left of it, and all further ones stay on that side.
    """
    if abs(rate) < _FLAT:
        return target / (1.0 - alpha)
    span = q - alpha / rate
    s = target / (1.0 - alpha + rate * q)
    for _ in range(_NEWTON_LIMIT):
        shrink = math.expm1(-rate * s)
        step = (s - span * shrink - target) / (1.0 + span * rate * (shrink + 1.0))
        s -= step
        if abs(step) <= 1e-15 * (1.0 + s):
            break
    return max(s, 0.0)


@compiled
def voltage(w_V: float, u0_V: float, g0_V: float, alpha: float, beta: float, gamma: float) -> float:
    """The voltage u with the drive u - g = ``w_V``, on the branch that leaves (u0, g0)."""
    target = w_V - (u0_V - g0_V)
    sign = 1.0 if target > 0.0 else -1.0
    target = abs(target)
    q = sign * g0_V
    s = 0.0
    if q < 0.0:
        s0 = crossing(q, alpha, beta - gamma)
        if target < s0 + q:
            return u0_V + sign * _solve(q, target, alpha, beta - gamma)
        s, target, q = s0, target - (s0 + q), 0.0
    return u0_V + sign * (s + _solve(q, target, alpha, beta + gamma))


@compiled
def run_inverse(
    y_um: FloatArray,
    v_um_per_s: FloatArray,
    a_um_per_s2: FloatArray,
    constants: FloatArray,
    memory_V: FloatArray,
    u_V: FloatArray,
    inside: BoolArray,
) -> None:
    """Voltages ``u_V`` (n,) for points (n,); ``memory_V`` = (u, g) is advanced in place.

    ``constants``: 1/d, y0, lag, inertia, alpha, beta, gamma, y_min, y_max, v_max. A point that is not finite gets NaN
    and does not change the memory.
    """
    per_um, offset, lag, inertia, alpha, beta, gamma, y_min, y_max, v_max = constants
    bound = alpha / (beta + gamma)
    u, g = memory_V[0], min(max(memory_V[1], -bound), bound)  # so that a memory of other parameters is reachable
    for k in range(y_um.size):
        y, v = y_um[k], v_um_per_s[k]
        w = (y - offset + lag * v + inertia * a_um_per_s2[k]) * per_um
        if not math.isfinite(w):
            u_V[k] = np.nan
            inside[k] = False
            continue
        new = voltage(w, u, g, alpha, beta, gamma)
        g = hysteresis_step(g, new - u, alpha, beta, gamma)
        u = new
        u_V[k] = u
        inside[k] = y_min <= y <= y_max and abs(v) <= v_max
    memory_V[0], memory_V[1] = u, g


@compiled
def _track(u_V: FloatArray, shape: FloatArray, memory_V: FloatArray) -> None:
    for k in range(u_V.size):
        if math.isfinite(u_V[k]):
            memory_V[1] = hysteresis_step(memory_V[1], u_V[k] - memory_V[0], shape[0], shape[1], shape[2])
            memory_V[0] = u_V[k]


@dataclass(frozen=True)
class BoucWenInverse(BaselineInverse):
    """Inverse of a Bouc-Wen stage.

    Under the zero-order hold the voltage acts half a sample after its instant on average. The inverse then looks half
    a sample ahead by the Taylor series of the motion, ``w(t + T/2)``. Under the linear hold the identification has put
    that delay into b/k, and nothing is added.

    The memory is (u, g) in V, driven by the voltage alone. ``track`` uses the applied voltages and not the measured
    motion, because (2.2) responds to every reversal and sensor noise would wear the hysteresis off.
    """

    parameters: Annotated[BoucWenParameters, Entry("the identified stage", name="")]
    name: Annotated[str, Entry("by which it is served", most=1000)] = "bouc_wen"
    #: (10,) what `run_inverse` takes: 1/d, y0, lag, inertia, alpha, beta, gamma, y_min, y_max, v_max; read only.
    constants: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        p, domain = self.parameters, self.domain
        ahead = 0.5 * self.dt_s if p.hold == "zero_order" else 0.0
        constants = [
            1.0 / p.d_um_per_V,
            p.offset_um,
            p.lag_s + ahead,
            p.inertia_s2 + p.lag_s * ahead + 0.5 * ahead * ahead,
            p.alpha,
            p.beta_per_V,
            p.gamma_per_V,
            domain.y_min_um,
            domain.y_max_um,
            domain.v_max_um_per_s,
        ]
        object.__setattr__(self, "constants", np.array(constants, dtype=np.float64))

    @property
    def memory_size(self) -> int:
        return 2

    def _run(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray, u_V: FloatArray,
        inside: BoolArray,
    ) -> None:  # fmt: skip
        run_inverse(y_um, v_um_per_s, a_um_per_s2, self.constants, memory, u_V, inside)

    def _drive(self, u_V: FloatArray, memory: FloatArray) -> None:
        _track(u_V, self.parameters.shape, memory)
