"""What an effect is: one cause, its parameters and units, and its compiled step.

An effect serves twice. A stage is composed of effects (`sim.stage.stage`), and a diagnosis finds out which effect a
recording holds by fitting the parameters of the same step. ``a + b`` makes a `Chain` (`sim.effects.chain`).

Signals through the chain are arrays of one value a sample: the value at the *end* of the step from ``t_k`` to
``t_(k+1)`` over which the command ``u_k`` is held. How a signal goes from one end to the next is known in closed
form (`sim.effects.holds`), so that no linear part has an error that depends on the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numba
from numba import types

from adaptive.errors import InputError

if TYPE_CHECKING:
    from sim.effects.chain import Chain

_types: Any = types
_cfunc: Any = numba.cfunc
_DOUBLES = _types.CPointer(_types.float64)
#: block(p, s, x, v, w, n, k0): parameters, state, signal (changed in place), drive voltage, displacement of the
#: other axis, number of samples, index of the reading that x[0] leads to.
BLOCK_SIGNATURE = _types.void(*[_DOUBLES] * 5, _types.int64, _types.int64)


class Place(IntEnum):
    """Where in the chain an effect acts, in the order of the signal's way."""

    DAC = 10
    AMPLIFIER = 20
    SLEW = 21
    RAILS = 22
    ACTUATOR = 30
    HYSTERESIS = 31
    CREEP = 40
    MECHANICS = 50
    FRICTION = 51
    CROSS_TALK = 60
    DRIFT = 70
    GAIN = 71
    # the electronics filter the sensor's noise too: that tells their lag from the amplifier's
    NOISE = 80
    SENSOR_LAG = 81
    DELAY = 82
    SENSOR_CURVE = 83
    HUM = 84
    ADC = 85
    TIMING = 90


#: From here on signals are what the sensor makes of the displacement.
SENSOR_FROM = Place.NOISE


class Block:
    """A compiled step of an effect over n samples; compiled (or loaded from the cache) when first asked for."""

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function
        self._compiled: Any = None

    @property
    def address(self) -> int:
        """Address of the machine code, for the chain's loop."""
        if self._compiled is None:
            self._compiled = _cfunc(BLOCK_SIGNATURE, cache=True)(self.function)
        return int(self._compiled.address)


def block(function: Callable[..., None]) -> Block:
    """Make ``function(p, s, x, v, w, n, k0)`` the step of an effect. Arguments are bare pointers to doubles."""
    return Block(function)


@dataclass(frozen=True, slots=True)
class Context:
    """What an effect's coefficients depend on besides its own parameters.

    Attributes
    ----------
    dt_s : sample time, s.
    seed : 53-bit number, the same for equal stage seed, axis and label.
    hold_per_s : how signals between amplifier and mechanics go from sample to sample: exponentially at this
        rate (1/s), the amplifier's; infinity is a jump at the start of the step (a bare D/A with hold).
    payload_ratio : mass added to the moved mass, by `payload_change`.
    """

    dt_s: float
    seed: int = 0
    hold_per_s: float = math.inf
    payload_ratio: float = 0.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect: unit, physical range (the bounds of a fit), typical value."""

    name: str
    unit: str
    low: float
    high: float
    default: float
    meaning: str
    log: bool = False
    """A fit should move it on a logarithmic scale."""

    def check(self, value: Any, label: str) -> float:
        """``value`` as a float within the range, or InputError."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if isinstance(value, bool) or not self.low <= number <= self.high:
            raise InputError(
                f"{label}.{self.name}: got {value!r}, expected a number from {self.low:g} to {self.high:g} "
                f"{self.unit} ({self.meaning}); give a value in this range"
            )
        return number


Derive = Callable[[Mapping[str, float], Context], Sequence[float]]


def _no_state(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return ()


def _registered(name: str) -> Kind:
    """The kind of that name in this process; how kinds travel between processes."""
    from sim.effects import KINDS

    return KINDS[name]


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """One effect of the library, independent of the values of its parameters.

    Attributes
    ----------
    name : its name everywhere: stage files, reports, tests.
    place : where in the chain it acts.
    parameters : in the order in which they are documented.
    derive : (values, context) -> the coefficients ``p`` that the block reads.
    rest : (values, context) -> the state ``s`` of a stage that has always been at 0 V. Its length may not depend
        on the values, so that parameters can change while the stage runs.
    block : the compiled step; None where the effect acts through the coefficients of others.
    neutral : parameter values with which it does nothing, for nested fits.
    signature, mistaken_for, tells_apart, source : for people and reports.
    cause : True for the causes of the catalogue that a diagnosis may name; False for what every stage has.
    """

    name: str
    place: Place
    parameters: tuple[Parameter, ...]
    derive: Derive
    block: Block | None
    signature: str
    source: str
    rest: Derive = _no_state
    neutral: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    mistaken_for: tuple[str, ...] = ()
    tells_apart: str = ""
    cause: bool = True

    def __repr__(self) -> str:
        return f"Kind({self.name!r})"

    def __reduce__(self) -> tuple[Callable[[str], Kind], tuple[str]]:
        return _registered, (self.name,)

    def parameter(self, name: str, label: str = "") -> Parameter:
        """The parameter of that name, or InputError."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        known = ", ".join(p.name for p in self.parameters)
        raise InputError(f"{label or self.name}.{name}: no such parameter, expected one of: {known}")

    def __call__(self, *, label: str = "", **values: float) -> Effect:
        """The effect with these values, the others at their defaults. Raises InputError on names and ranges."""
        label = label or self.name
        for name in values:
            self.parameter(name, label)
        full = tuple(p.check(values.get(p.name, p.default), label) for p in self.parameters)
        return Effect(self, full, label)


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect with the values of its parameters. ``a + b`` composes."""

    kind: Kind
    numbers: tuple[float, ...]
    label: str

    def __repr__(self) -> str:
        label = f"label={self.label!r}, " if self.label != self.name else ""
        return f"{self.name}({label}{', '.join(f'{name}={value:g}' for name, value in self.values.items())})"

    @property
    def name(self) -> str:
        return self.kind.name

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by name."""
        return {p.name: v for p, v in zip(self.kind.parameters, self.numbers, strict=True)}

    def replace(self, **values: float) -> Effect:
        """The same effect with some values changed. Raises InputError on names and ranges."""
        for name in values:
            self.kind.parameter(name, self.label)
        numbers = tuple(
            p.check(values[p.name], self.label) if p.name in values else old
            for p, old in zip(self.kind.parameters, self.numbers, strict=True)
        )
        return Effect(self.kind, numbers, self.label)

    def __add__(self, other: Effect | Chain) -> Chain:
        from sim.effects.chain import Chain

        return Chain((self,)) + other
