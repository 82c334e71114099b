"""What an effect is: its parameters with units, its compiled step, and chains of effects.

An effect is one physical cause. A stage is composed of effects (`sim.stage.stage`), and ``a + b`` makes a `Chain`.

A signal through the chain is an array with one value per sample: the value at the *end* of the step from ``t_k`` to
``t_(k+1)``, over which the command ``u_k`` is held. The shape of the signal within a step is known in closed form
(`sim.effects.holds`), so no linear part has an error that depends on the step.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numba import types

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import CauseModel
from dehyst.sim.pictures import Draw, over_time
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings

_types: Any = types
_cfunc: Any = numba.cfunc
_DOUBLES = _types.CPointer(_types.float64)
#: block(p, s, x, v, w, n, k0): coefficients, state, signal (changed in place), voltage at the actuator, displacement of
#: the other axis, number of samples, index of the reading that x[0] becomes.
BLOCK_SIGNATURE = _types.void(*[_DOUBLES] * 5, _types.int64, _types.int64)


class Place(IntEnum):
    """Where in the chain an effect acts, in the order of the signal."""

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
    # before the lag, because the electronics filter the noise too; that tells their lag from the amplifier's
    NOISE = 80
    SENSOR_LAG = 81
    DELAY = 82
    SENSOR_CURVE = 83
    HUM = 84
    ADC = 85
    TIMING = 90


#: From here on, the signal is the sensor's image of the displacement.
SENSOR_FROM = Place.NOISE


class Block:
    """The step of an effect over n samples, compiled (or loaded from the cache) at the first use."""

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function
        self._compiled: Any = None

    @property
    def address(self) -> int:
        """Address of the machine code, for the loop over the chain."""
        if self._compiled is None:
            self._compiled = _cfunc(BLOCK_SIGNATURE, cache=True)(self.function)
        return int(self._compiled.address)


def block(function: Callable[..., None]) -> Block:
    """Decorator: make ``function(p, s, x, v, w, n, k0)`` the step of an effect; p to w are pointers to doubles."""
    return Block(function)


@dataclass(frozen=True, slots=True)
class Context:
    """What the coefficients of an effect depend on besides its own parameters.

    Attributes
    ----------
    dt_s : sample time, s.
    seed : 53-bit number that follows from the stage's seed, the axis and the label.
    hold_per_s : shape of the signals between amplifier and mechanics within a step: exponential at this rate, 1/s, that
        of the amplifier. Infinity is a jump at the start of the step (a D/A converter with hold alone).
    payload_ratio : mass added by `payload_change`, relative to the moved mass.
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

    def check(self, value: Any, label: str) -> float:
        """``value`` as a float. Raises InputError where it is not a number within the range."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if isinstance(value, bool) or not self.low <= number <= self.high:
            raise InputError(
                f"{label}.{self.name}: got {value!r}, expected a number from {self.low:g} to {self.high:g} "
                f"{self.unit} ({self.meaning})"
            )
        return number


Derive = Callable[[Mapping[str, float], Context], Sequence[float]]


def _no_state(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return ()


def _kind_named(name: str) -> Kind:
    """The kind ``name`` of the library. Pickled kinds are loaded by it."""
    kind: Kind = importlib.import_module("dehyst.sim.effects").EFFECTS[name]
    return kind


@dataclass(frozen=True)
class InLibrary:
    """A fitted cause as effects of the library.

    ``refit``: form and effect differ, so the numbers of the effects are still to be fitted to the form.
    ``changed``: what becomes of each effect of the nominal stage, where the cause sits inside one of them.
    """

    effects: tuple[Effect, ...] = ()
    refit: bool = False
    changed: Callable[[Effect], Effect] | None = None


@dataclass(frozen=True)
class FoundInReadings:
    """A cause that the readings show without a fit: its numbers, their intervals, the share (of the squared error that
    is left) that it makes, and what was seen."""

    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    share: float
    words: str


@dataclass(frozen=True)
class InReadings:
    """What the readings show of an effect without a fit.

    ``find``: (recording; residual of the model with all causes, µm, and samples that count, (n,) each; noise floor,
    µm). ``effects``: its numbers as effects of the library, and their part of the noise, µm².
    """

    find: Callable[[FitData, FloatArray, BoolArray, float], FoundInReadings | None]
    effects: Callable[[dict[str, float]], tuple[tuple[Effect, ...], float]]


def _not_in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    return None


def same_numbers(name: str, refit: bool = False, **numbers: str) -> Callable[..., InLibrary]:
    """What becomes of a form whose reported ``numbers`` are those of the effect ``name``, by its parameters."""

    def made(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary:
        found = form.reported(p, data)
        values = {parameter: found[number][0] for parameter, number in numbers.items()}
        return InLibrary((_kind_named(name).clipped("", **values),), refit)

    return made


@dataclass(frozen=True)
class Cause:
    """How a diagnosis finds and shows an effect, and what becomes of its numbers.

    Attributes
    ----------
    sign : what must be seen in the readings; empty where there is no direct test.
    forms : the forms that are fitted; several are variants of one cause.
    tests : its direct tests, which use no fit. What sees it counts before what does not.
    in_library : (form, fitted parameters, data) -> effects of the library; None where the library has no equal.
    picture : draws it.
    same_as : causes that one voltage and one sensor cannot tell from it; either side may say so.
    in_readings : what of it is found without a fit.
    """

    sign: str = ""
    forms: tuple[CauseModel, ...] = ()
    tests: tuple[Callable[[Readings], Sight], ...] = ()
    in_library: Callable[[CauseModel, FloatArray, FitData], InLibrary | None] = _not_in_library
    picture: Draw = over_time
    same_as: tuple[str, ...] = ()
    in_readings: InReadings | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """One effect of the library, independent of the values of its parameters.

    Attributes
    ----------
    name : its name in stage files, reports and tests.
    place : where in the chain it acts.
    parameters : in the order of the documentation.
    derive : (values, context) -> the coefficients ``p`` that the block reads.
    rest : (values, context) -> the state ``s`` of a stage that has always been at 0 V. Its length must not depend on
        the values, so that parameters can change while the stage runs.
    block : the compiled step; None where the effect acts through the coefficients of others.
    signature, mistaken_for, tells_apart, source : for people and reports.
    shares : (values, context) -> the context of all effects of the chain, where this one changes it for the others.
    needs : names of effects of which one must be in the chain.
    cause : how a diagnosis finds it; None for what every stage has, which a diagnosis never names.
    """

    name: str
    place: Place
    parameters: tuple[Parameter, ...]
    derive: Derive
    block: Block | None
    signature: str
    source: str
    rest: Derive = _no_state
    mistaken_for: tuple[str, ...] = ()
    tells_apart: str = ""
    shares: Callable[[Mapping[str, float], Context], Context] | None = None
    needs: tuple[str, ...] = ()
    cause: Cause | None = None

    def __repr__(self) -> str:
        return f"Kind({self.name!r})"

    def __reduce__(self) -> tuple[Callable[[str], Kind], tuple[str]]:
        return _kind_named, (self.name,)

    def parameter(self, name: str, label: str = "") -> Parameter:
        """The parameter ``name``. Raises InputError where there is none."""
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

    def clipped(self, label: str = "", **values: float) -> Effect:
        """The effect with these values, each moved into its range. Raises InputError on names."""
        ranges = {name: self.parameter(name, label) for name in values}
        inside = {name: float(np.clip(v, ranges[name].low, ranges[name].high)) for name, v in values.items()}
        return self(label=label, **inside)


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
        """Name of the kind."""
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
        return Chain((self,)) + other


@dataclass(frozen=True)
class Chain:
    """Effects ordered by their place. ``chain + effect`` and ``chain + chain`` compose.

    Effects of one place keep their order. Raises InputError where two effects have the same label.
    """

    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        ordered = tuple(sorted(self.effects, key=lambda e: e.kind.place))
        object.__setattr__(self, "effects", ordered)
        labels = [e.label for e in ordered]
        for label in labels:
            if labels.count(label) > 1:
                raise InputError(
                    f"effects: {label!r} appears twice, expected unique labels; give one of them another label"
                )

    def __add__(self, other: Effect | Chain | Iterable[Effect]) -> Chain:
        more = (other,) if isinstance(other, Effect) else tuple(other)
        return Chain(self.effects + more)

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    def __len__(self) -> int:
        return len(self.effects)

    def __contains__(self, label: object) -> bool:
        return any(e.label == label for e in self.effects)

    def __getitem__(self, label: str) -> Effect:
        for effect in self.effects:
            if effect.label == label:
                return effect
        known = ", ".join(e.label for e in self.effects)
        raise InputError(f"effects: no {label!r} in this chain, expected one of: {known}")

    @property
    def parameters(self) -> dict[str, float]:
        """All parameter values by ``label.parameter``."""
        return {f"{e.label}.{name}": value for e in self.effects for name, value in e.values.items()}

    def replace(self, values: Mapping[str, float]) -> Chain:
        """The chain with parameters changed by ``label.parameter``. Raises InputError on names and ranges."""
        grouped: dict[str, dict[str, float]] = {}
        for path, value in values.items():
            label, _, name = path.rpartition(".")
            self[label].kind.parameter(name, label)
            grouped.setdefault(label, {})[name] = value
        return Chain(tuple(e.replace(**grouped[e.label]) if e.label in grouped else e for e in self.effects))

    def without(self, label: str) -> Chain:
        """The chain without the effect ``label``. Raises InputError where there is none."""
        gone = self[label]
        return Chain(tuple(e for e in self.effects if e is not gone))
