"""The Bouc-Wen stage (2.1), (2.2) with n = 1, simulated without step-size error.

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

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray, StateDict
from baselines.bouc_wen.step import hysteresis_step, poles, run_stage, settled


@dataclass(frozen=True)
class BoucWenParameters:
    """The seven parameters of (2.1), (2.2), an offset, and the hold convention of the module.

    Units: m kg, b N s/m, k N/m, d µm/V, alpha 1, beta and gamma 1/V, offset µm.

    Raises InputError unless m, b, k, d are positive and the drive u - g rises with u along every branch, which the
    inverse needs: alpha < 1, 2 alpha beta < beta + gamma, and beta + gamma > 0.
    """

    m_kg: float
    b_N_s_per_m: float
    k_N_per_m: float
    d_um_per_V: float
    alpha: float
    beta_per_V: float
    gamma_per_V: float
    offset_um: float = 0.0
    hold: str = "linear"
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

    def state_dict(self) -> StateDict:
        """Values by field name."""
        names = ("m_kg", "b_N_s_per_m", "k_N_per_m", "d_um_per_V", "alpha", "beta_per_V", "gamma_per_V")
        return {**{name: getattr(self, name) for name in names}, "offset_um": self.offset_um, "hold": self.hold}

    @staticmethod
    def from_state(state: StateDict) -> BoucWenParameters:
        """Inverse of :meth:`state_dict`. Raises InputError where a field is missing or wrong."""
        names = ("m_kg", "b_N_s_per_m", "k_N_per_m", "d_um_per_V", "alpha", "beta_per_V", "gamma_per_V", "offset_um")
        try:
            numbers = {name: float(state[name]) for name in names}
            return BoucWenParameters(**numbers, hold=str(state["hold"]))
        except KeyError as missing:
            raise InputError(f"{missing.args[0]}: missing in the state of a bouc_wen model; write it again") from None


#: The chapter's identified stage, Table 2.1 (d: 1.1351e-5 m/V).
TABLE_2_1 = BoucWenParameters(0.2789, 8.9055e5, 3.5244e8, 11.351, 0.4754, 0.8718, 0.9925)
