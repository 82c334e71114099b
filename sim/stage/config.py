"""Configuration of a simulated stage: chains of effects, sample time, seed, limits, and parameter changes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from dehyst.adaptive.errors import InputError
from dehyst.sim.effects import Chain

#: ``(t_s, {"label.parameter": value})``; ``"axis2/label.parameter"`` is a parameter of the second axis.
ParameterChange = tuple[float, Mapping[str, float]]
SECOND = "axis2/"


@dataclass(frozen=True)
class StageConfig:
    """Configuration of a simulated stage.

    Attributes
    ----------
    name : for people and files.
    effects : chain of the first axis.
    second_axis : chain of the second axis, or None for a stage of one axis.
    dt_s : sample time, s.
    seed : of all its noise and drift.
    u_min_V, u_max_V : limits to which commands are clamped before the D/A converter.
    changes : parameter changes by time; the state is continuous, readings from ``t_s`` on are of the changed stage.
    """

    name: str
    effects: Chain
    second_axis: Chain | None = None
    dt_s: float = 1e-3
    seed: int = 0
    u_min_V: float = -2.0
    u_max_V: float = 10.0
    changes: tuple[ParameterChange, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dt_s) and 1e-6 <= self.dt_s <= 1.0):
            raise InputError(f"dt_s: got {self.dt_s!r}, expected a sample time from 1e-6 to 1 s")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError(f"seed: got {self.seed!r}, expected an integer from 0 on")
        if not (math.isfinite(self.u_min_V) and math.isfinite(self.u_max_V) and self.u_min_V < self.u_max_V):
            raise InputError(
                f"u_min_V, u_max_V: got {self.u_min_V!r}, {self.u_max_V!r}, expected finite volts, the first lower"
            )
        if not self.u_min_V <= 0.0 <= self.u_max_V:
            raise InputError(
                f"u_min_V, u_max_V: got {self.u_min_V!r}, {self.u_max_V!r}, expected 0 V (rest) between them"
            )
        chains = self.chains
        for t_s, values in self.changes:
            if not (math.isfinite(t_s) and t_s > 0.0):
                raise InputError(f"changes: got time {t_s!r}, expected seconds after the start, above 0")
            chains = changed(chains, values)
        object.__setattr__(self, "changes", tuple(sorted(self.changes, key=lambda c: c[0])))

    @property
    def chains(self) -> tuple[Chain, ...]:
        """The chain of each axis."""
        return (self.effects,) if self.second_axis is None else (self.effects, self.second_axis)


def changed(chains: tuple[Chain, ...], values: Mapping[str, float]) -> tuple[Chain, ...]:
    """The chains with parameters changed by path. Raises InputError on unknown names and values out of range."""
    first = {path: v for path, v in values.items() if not path.startswith(SECOND)}
    second = {path.removeprefix(SECOND): v for path, v in values.items() if path.startswith(SECOND)}
    if second and len(chains) < 2:
        raise InputError(f"changes: got {SECOND}{next(iter(second))}, expected parameters of the only axis")
    return tuple(chain.replace(part) for chain, part in zip(chains, (first, second), strict=False))
