"""What a rehearsal accepts as a stage: an object or a function that turns a block of voltages into displacements.

Time line of sample k, ``dt_s`` apart: the reading ``read_um[k]`` is taken at the instant at which ``u_V[k]`` begins to
be applied. So ``read_um[k]`` does not depend on ``u_V[k]``; the voltage shows in reading ``k + 1`` at the earliest. A
plant begins at rest, at the voltage of its drive nearest to zero.
"""

from __future__ import annotations

import copy
import inspect
import math
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from adaptive.types import FloatArray
from service.protocol.errors import FieldError

#: (n,) voltages, V, in; (n,) true displacement and (n,) reading of the sensor, µm, out.
PlantFunction = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@runtime_checkable
class Plant(Protocol):
    """A stage. It keeps its state from one block to the next.

    Attributes
    ----------
    dt_s : sample time, s. u_min_V, u_max_V : limits of the drive, V.
    """

    dt_s: float
    u_min_V: float
    u_max_V: float

    def run(self, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Apply (n,) voltages one after another; returns (n,) true displacement and (n,) readings, µm."""
        ...


#: Makes a new plant, at rest. All plants of one factory give the same bits, including their noise.
PlantFactory = Callable[[], Plant]


@dataclass(frozen=True, slots=True)
class Change:
    """A physical change of a stage, from the next sample on.

    Attributes
    ----------
    kind : ``gain`` (displacement grows by the share ``size``), ``zero`` (it shifts by ``size`` µm), ``payload`` (the
    moved mass grows by the share ``size``), ``lag`` (the drive gets another time constant of ``size`` s), ``knock``
    (the stage rings with an amplitude of ``size`` µm; nothing else changes).
    over_s : time over which it comes, linearly, s; 0 at once. seed : of its random parts.
    """

    kind: str
    size: float
    over_s: float = 0.0
    seed: int = 0


@runtime_checkable
class Changeable(Protocol):
    """A plant that applies physical events itself; other plants are disturbed from outside as far as possible."""

    def change(self, change: Change) -> bool:
        """Apply the change from the next sample on. Return False if this plant cannot: it is then emulated."""
        ...


class FunctionPlant:
    """A plant around a function; any state is kept by the function.

    Raises FieldError if sample time or limits are missing or impossible.
    """

    def __init__(self, function: PlantFunction, dt_s: float, u_min_V: float, u_max_V: float) -> None:
        self.dt_s, self.u_min_V, self.u_max_V = dt_s, u_min_V, u_max_V
        self._function = function
        check_numbers(self)

    def run(self, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self._function(u_V)


def check_numbers(plant: Plant) -> None:
    """Raise FieldError unless sample time and limits of a plant are possible."""
    for name, value in (("dt_s", plant.dt_s), ("u_min_V", plant.u_min_V), ("u_max_V", plant.u_max_V)):
        if not isinstance(value, int | float | np.number) or not math.isfinite(value):
            raise FieldError(f"plant.{name}", repr(value), "a finite number")
    if not 1e-5 <= plant.dt_s <= 0.1:
        raise FieldError("plant.dt_s", f"{plant.dt_s:g} s", "a sample time from 1e-5 to 0.1 s")
    if not plant.u_min_V < plant.u_max_V:
        raise FieldError("plant.u_max_V", f"{plant.u_max_V:g} V", f"more than u_min_V, which is {plant.u_min_V:g} V")


def run_checked(plant: Plant, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``plant.run`` with its result checked. Raises FieldError on a wrong shape or a true displacement that is not
    finite.

    A reading may be anything, as that of a sensor may.
    """
    got = _guarded("run", plant.run, u_V.copy())
    shape = f"({u_V.size},)"
    advice = "return (true_um, read_um), one displacement in µm for each voltage"
    if not isinstance(got, tuple | list) or len(got) != 2:
        raise FieldError("plant", _described(got), f"two arrays {shape}", advice)
    arrays = []
    for name, values in zip(("true_um", "read_um"), got, strict=True):
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise FieldError(f"plant: {name}", _described(values), f"{shape} numbers", advice) from error
        if array.shape != u_V.shape:
            raise FieldError(f"plant: {name}", f"shape {array.shape}", f"shape {shape}", advice)
        arrays.append(array)
    true_um, read_um = arrays
    if not np.isfinite(true_um).all():
        k = int(np.argmin(np.isfinite(true_um)))
        raise FieldError(
            f"plant: true_um[{k}]", f"{true_um[k]:g} µm at {u_V[k]:g} V", "a finite displacement in µm",
            "mend the simulation: its step may be too long for its fastest part",
        )  # fmt: skip
    return true_um, read_um


def factory_of(
    given: object, dt_s: float | None = None, u_min_V: float | None = None, u_max_V: float | None = None
) -> PlantFactory:
    """A factory of new plants from ``given``: a plant, a function of the voltages, or something that makes one of the
    two.

    An object is copied for each run (``copy.deepcopy``), so that each run begins with its present state. A class or
    another callable without arguments is called. If both the plant and the arguments give sample time or limits, the
    arguments count. Raises FieldError if it is none of these or a number is missing.
    """
    called = _needs_no_argument(given)

    def make() -> Plant:
        made = _guarded("making it", given) if called else copy.deepcopy(given)
        return _as_plant(made, dt_s, u_min_V, u_max_V)

    make()  # report errors now, not at the first run
    return make


def _as_plant(made: object, dt_s: float | None, u_min_V: float | None, u_max_V: float | None) -> Plant:
    given = {"dt_s": dt_s, "u_min_V": u_min_V, "u_max_V": u_max_V}
    if isinstance(made, Plant):
        for name, value in given.items():
            if value is not None:
                _guarded(f"setting {name}", setattr, made, name, value)
        check_numbers(made)
        return made
    run = getattr(made, "run", made)
    if not callable(run):
        raise FieldError(
            "plant", _described(made), "an object with run(u_V), a function of u_V, or what makes one of them"
        )
    numbers: dict[str, float] = {}
    for name, value in given.items():
        number = getattr(made, name, None) if value is None else value
        if number is None:
            raise FieldError(
                f"plant.{name}", "nothing", "a number", "give the plant such an attribute, or say it beside the plant"
            )
        numbers[name] = number
    return FunctionPlant(run, **numbers)


def _guarded(what: str, call: Any, *arguments: object) -> Any:
    """The result of a call into the user's code; FieldError with file and line if it raised."""
    try:
        return call(*arguments)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)[1:]
        where = f", {Path(frames[-1].filename).name} line {frames[-1].lineno}" if frames else ""
        raise FieldError(
            f"plant: {what}", f"{type(error).__name__}: {error}{where}", "no error", "mend the simulation"
        ) from error


def _needs_no_argument(given: object) -> bool:
    """Whether it is a class or a function that can be called without an argument."""
    if isinstance(given, Plant) and not isinstance(given, type):
        return False
    if not callable(given):
        return False
    try:
        inspect.signature(given).bind()
    except (TypeError, ValueError):
        return False
    return True


def _described(value: object) -> str:
    text = repr(value)
    return f"a {type(value).__name__}: {text if len(text) <= 60 else text[:57] + '...'}"
