"""Exact one-step coefficients of first- and second-order systems for a known shape of the input within a step.

Within a step of length ``dt`` the input goes from ``x0`` to ``x1`` as ``A + B exp(-hold t)``:

- ``hold = inf``: it jumps to ``x1`` at the start and stays (a D/A converter with hold),
- ``hold`` finite: the output of a first-order amplifier of that rate,
- ``hold = 0``: a straight line.

The response is closed for a step of any length, so converter, amplifier, actuator and mechanics together are exact.
The slow parts of creep are exact too; that they reach the mechanics in the shape of the amplifier's output instead of
their own is an error below 1e-4 of the change within a step.
"""

from __future__ import annotations

import cmath
import math

#: The input's rate is moved where it is within this relative distance of a pole, where the closed form divides by zero.
_NEAR = 1e-7


def _parts(dt_s: float, hold: float) -> tuple[float, float]:
    """Weights (of x0, of x1) in B of ``A + B exp(-hold t)``; A = x0 - B."""
    if math.isinf(hold):
        return 0.0, 0.0
    scale = -math.expm1(-hold * dt_s)
    return 1.0 / scale, -1.0 / scale


def first_order(tau_s: float, dt_s: float, hold_per_s: float) -> tuple[float, float, float]:
    """(a, b0, b1) of ``z' = a z + b0 x0 + b1 x1`` for ``tau dz/dt = x - z``; tau = 0 gives z' = x1."""
    if tau_s <= 0.0:
        return 0.0, 0.0, 1.0
    q = dt_s / tau_s
    a = math.exp(-q)
    if math.isinf(hold_per_s):
        return a, 0.0, -math.expm1(-q)
    if hold_per_s * dt_s < 1e-6:  # straight line
        mean = -math.expm1(-q) / q
        return a, mean - a, 1.0 - mean
    hold = hold_per_s
    if abs(hold * tau_s - 1.0) < _NEAR:
        hold *= 1.0 + _NEAR
    end = math.exp(-hold * dt_s)
    # particular solution A + B exp(-hold t)/(1 - hold tau), the rest decays with the pole
    of_b = (end - a) / (1.0 - hold * tau_s) - (1.0 - a)
    w0, w1 = _parts(dt_s, hold)
    return a, (1.0 - a) + of_b * w0, of_b * w1


def second_order(omega_rad_per_s: float, zeta: float, dt_s: float, hold_per_s: float) -> tuple[float, ...]:
    """(a11, a12, b10, b11, a21, a22, b20, b21) of position and velocity over one step.

    System: ``y'' + 2 zeta omega y' + omega² y = omega² x`` (any damping, stiff and overdamped too).
    ``y' = a11 y + a12 v + b10 x0 + b11 x1``; ``v' = a21 y + a22 v + b20 x0 + b21 x1``.
    """
    w, sigma = omega_rad_per_s, zeta * omega_rad_per_s
    root = cmath.sqrt(complex(sigma * sigma - w * w))
    if abs(root) * dt_s < 1e-6:  # double pole: the closed form's limit
        decay = math.exp(-sigma * dt_s)
        cosh, sinh = decay, decay * dt_s
    else:
        # the slow pole as a product: sigma - root would cancel where the system is overdamped
        fast = cmath.exp(-(sigma + root) * dt_s)
        slow = cmath.exp(-(w * w / (sigma + root)) * dt_s)
        cosh, sinh = ((slow + fast) / 2).real, ((slow - fast) / (2 * root)).real
    a11, a12 = cosh + sigma * sinh, sinh
    a21, a22 = -w * w * sinh, cosh - sigma * sinh
    if math.isinf(hold_per_s):
        return a11, a12, 0.0, 1.0 - a11, a21, a22, 0.0, -a21
    if hold_per_s * dt_s < 1e-6:
        # straight line x0 + r t: particular solution x0 - 2 zeta r/omega + r t, velocity r
        lag = 2.0 * zeta / w
        # start minus particular: position x0 - lag r, velocity r, with r = (x1 - x0)/dt
        y_r, v_r = (a11 * lag - a12 + dt_s - lag) / dt_s, (a21 * lag - a22 + 1.0) / dt_s
        return a11, a12, 1.0 - a11 - y_r, y_r, a21, a22, -a21 - v_r, v_r
    hold = hold_per_s
    gap = hold * hold - 2.0 * sigma * hold + w * w
    if abs(gap) < _NEAR * (hold * hold + w * w):
        hold *= 1.0 + 10.0 * math.sqrt(_NEAR)
        gap = hold * hold - 2.0 * sigma * hold + w * w
    h, end = w * w / gap, math.exp(-hold * dt_s)
    y_b = h * (end - a11 + hold * a12) - (1.0 - a11)
    v_b = h * (-hold * end - a21 + hold * a22) + a21
    w0, w1 = _parts(dt_s, hold)
    return a11, a12, (1.0 - a11) + y_b * w0, y_b * w1, a21, a22, -a21 + v_b * w0, v_b * w1
