"""The guard: every voltage is finite, within the limits, and no faster than the slew limit.

`limit_voltage` is the one rule, for the service, a follower, a client's commands and the loop of a stage alike.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.query import LIMITED_SLEW, LIMITED_VOLTAGE, NOT_FINITE_REPLACED, OUTSIDE_DOMAIN


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one axis: voltage in V, slew in V/s, displacement in µm (infinite where there is none)."""

    u_min_V: float
    u_max_V: float
    slew_V_per_s: float
    y_min_um: float = -math.inf
    y_max_um: float = math.inf

    def __post_init__(self) -> None:
        if not (math.isfinite(self.u_min_V) and math.isfinite(self.u_max_V) and self.u_min_V < self.u_max_V):
            raise FieldError("u_max_V", f"{self.u_max_V} (u_min_V {self.u_min_V})", "finite limits, u_min_V < u_max_V")
        if not self.slew_V_per_s > 0:
            raise FieldError("slew_V_per_s", self.slew_V_per_s, "a positive slew limit in V/s")
        if not self.y_min_um < self.y_max_um:
            raise FieldError("y_max_um", f"{self.y_max_um} (y_min_um {self.y_min_um})", "y_min_um < y_max_um, in µm")

    def to_json(self) -> dict[str, Any]:
        """For the status: infinite limits, which JSON cannot say, become null."""
        return {name: value if math.isfinite(value) else None for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Limits:
        """The limits in a status. Raises InputError where they are not acceptable."""
        none = {"slew_V_per_s": math.inf, "y_min_um": -math.inf, "y_max_um": math.inf}
        try:
            given = {one.name: data[one.name] for one in fields(cls)}
            return cls(**{name: none[name] if value is None else float(value) for name, value in given.items()})
        except (KeyError, TypeError, ValueError) as error:
            raise FieldError("limits", repr(data)[:200], "the five limits of an axis") from error


def check_domain(y_um: FloatArray, limits: Limits, field: str = "y_um") -> None:
    """InputError naming the first desired point, (n,) µm, that is not within the displacement limits."""
    if y_um.size == 1 and limits.y_min_um <= y_um.item(0) <= limits.y_max_um:
        return
    # The extremes decide for all points; only the message needs to know which point it was.
    if y_um.min() >= limits.y_min_um and y_um.max() <= limits.y_max_um:
        return
    bad = int(np.flatnonzero(~((y_um >= limits.y_min_um) & (y_um <= limits.y_max_um)))[0])
    raise FieldError(
        f"{field}[{bad}]",
        f"{y_um[bad]:g} µm",
        f"{limits.y_min_um:g} to {limits.y_max_um:g} µm",
        "keep the trajectory within the range of the stage",
    )


def limit_voltage(u_V: float, previous_V: float, u_min_V: float, u_max_V: float, step_V: float) -> tuple[float, int]:
    """(safe voltage, V; flags) of one point; compiled for a trajectory, called in Python for a point.

    In order: a voltage that is not finite becomes ``previous_V`` (mid-range if there is none); the voltage limits; at
    most ``step_V`` away from ``previous_V``, if that is finite. So from a voltage within the limits none leaves them.
    From one outside, as after a restart with narrower limits, the way back is a ramp: each voltage is ``step_V``
    nearer, because a jump makes the stage ring. Limiting a limited voltage again does not change it.
    """
    flags = 0
    known = math.isfinite(previous_V)
    if not math.isfinite(u_V):
        u_V = previous_V if known else 0.5 * (u_min_V + u_max_V)
        flags |= NOT_FINITE_REPLACED
    if u_V < u_min_V:
        u_V = u_min_V
        flags |= LIMITED_VOLTAGE
    elif u_V > u_max_V:
        u_V = u_max_V
        flags |= LIMITED_VOLTAGE
    if known:
        if u_V > previous_V + step_V:
            u_V = previous_V + step_V
            flags |= LIMITED_SLEW
        elif u_V < previous_V - step_V:
            u_V = previous_V - step_V
            flags |= LIMITED_SLEW
    return u_V, flags


_limit_voltage = compiled(limit_voltage)


@compiled
def limit(
    u_V: FloatArray,
    inside: BoolArray,
    u_before_V: float,
    u_min_V: float,
    u_max_V: float,
    step_V: float,
    flags: NDArray[np.uint8],
) -> int:
    """Apply `limit_voltage` to (n,) ``u_V`` in place, add to (n,) ``flags``; returns the bits of all points in one.

    ``u_before_V`` is the voltage before the first point, V; NaN if there is none.
    """
    found = 0
    previous = u_before_V
    for i in range(u_V.size):
        previous, bits = _limit_voltage(u_V[i], previous, u_min_V, u_max_V, step_V)
        if not inside[i]:
            bits |= OUTSIDE_DOMAIN
        bits |= flags[i]
        u_V[i] = previous
        flags[i] = bits
        found |= bits
    return found


def guard(
    u_V: FloatArray, inside: BoolArray, dt_s: float, limits: Limits, u_before_V: float = math.nan
) -> tuple[FloatArray, NDArray[np.uint8]]:
    """(voltages, flags), both (n,), of what a model answered for points ``dt_s`` apart; the inputs are not changed."""
    return guarded(u_V, inside, dt_s, limits, u_before_V)[:2]


def guarded(
    u_V: FloatArray, inside: BoolArray, dt_s: float, limits: Limits, u_before_V: float
) -> tuple[FloatArray, NDArray[np.uint8], int]:
    """As :func:`guard`, and all bits of the flags in one: 0 where nothing was done and nothing is outside."""
    safe = np.array(u_V, dtype=np.float64)
    flags = np.zeros(safe.size, dtype=np.uint8)
    found = limit(safe, inside, u_before_V, limits.u_min_V, limits.u_max_V, limits.slew_V_per_s * dt_s, flags)
    return safe, flags, int(found)


def warm() -> None:
    """Compile the loop of this module once."""
    guard(np.zeros(1), np.ones(1, dtype=np.bool_), 1e-3, Limits(0.0, 1.0, 1.0))
