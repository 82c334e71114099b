"""What a rehearsal accepts as a stage, and its identification as ``dehyst identify`` does it."""

from __future__ import annotations

import copy
import inspect
import math
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.lab.rehearsal.config import RehearsalConfig
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import LEARN
from dehyst.service.identification.identifying import identify_one
from dehyst.service.protocol.errors import FieldError
from dehyst.sim.signals.voltages import CHAPTER_AMPLITUDE_V, training_input
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage

# --- What a rehearsal accepts as a stage: an object or a function that turns a block of voltages into displacements.
#
# Time line of sample k, ``dt_s`` apart: the reading ``read_um[k]`` is taken at the instant at which ``u_V[k]`` begins
# to be applied. So ``read_um[k]`` does not depend on ``u_V[k]``; the voltage shows in reading ``k + 1`` at the
# earliest. A plant begins at rest, at the voltage of its drive nearest to zero.

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


class StagePlant:
    """A simulated stage, as in a stage file, without the changes that it plans; its first axis is the plant."""

    def __init__(self, config: StageConfig) -> None:
        self.dt_s, self.u_min_V, self.u_max_V = config.dt_s, config.u_min_V, config.u_max_V
        self._stage = Stage(replace(config, changes=()))
        self._state = self._stage.initial_state()

    def run(self, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        run = self._stage.run_traced(self._state, u_V)
        return run.true_um, run.y_um


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


# --- Identifies a plant, as ``dehyst identify`` does from a recording.

#: Time of the ramp from the voltage at rest to the lowest voltage, and of the rest there, s.
APPROACH_S, REST_S = 0.5, 0.5
#: The largest voltage of the chapter's excitation as a share of twice its amplitude.
_PEAK: Final = 0.981
#: Default slew limit, spans of the drive per second.
SLEW_SPANS_PER_S: Final = 500.0


@dataclass(frozen=True, slots=True)
class IdentifiedPlant:
    """What is known of a plant before the loop is closed.

    Attributes
    ----------
    models : by name; ``lssvm_adaptive`` is the one that learns. u_V, y_um : (n,) the recording, V and µm.
    limits : of the axis. low_um, high_um : the identified displacement range. rest_um : reading at rest.
    heldout_mae_pct : error of the model on the last quarter of the recording, percent of the voltage span.
    """

    models: dict[str, InverseModel]
    u_V: FloatArray
    y_um: FloatArray
    dt_s: float
    limits: Limits
    low_um: float
    high_um: float
    rest_um: float
    heldout_mae_pct: float


def identify(
    plant_factory: PlantFactory, config: RehearsalConfig, progress: Callable[[float], None] = lambda _: None
) -> IdentifiedPlant:
    """Identify the models from the chapter's excitation on a new plant.

    Raises FieldError if the answer of the plant is no motion, InputError if no model can be identified.
    """
    plant = plant_factory()
    check_numbers(plant)
    dt_s = plant.dt_s
    low_V, high_V = excitation_range(plant, config)
    progress(0.0)
    go_to_lowest(plant, low_V)
    wave_V = training_input(dt_s, config.identify_s)[1] / (2.0 * CHAPTER_AMPLITUDE_V * _PEAK)
    u_V = np.asarray(low_V + (high_V - low_V) * np.clip(wave_V, 0.0, 1.0))
    _, y_um = run_checked(plant, u_V)
    if not np.isfinite(y_um).all():
        k = int(np.argmin(np.isfinite(y_um)))
        raise FieldError(f"plant: read_um[{k}]", f"{y_um[k]:g} µm", "finite readings while a model is identified")
    if not np.ptp(y_um) > 0.0:
        raise FieldError(
            "plant: read_um", f"{y_um[0]:g} µm throughout", f"a motion under {low_V:g} to {high_V:g} V",
            "is the voltage applied, and is the displacement in µm?",
        )  # fmt: skip
    progress(0.3)
    support = max(10, min(config.support, u_V.size // 2))
    model, report = identify_lssvm(u_V, y_um, dt_s, config=IdentifyConfig(n=support), name=LEARN)
    models: dict[str, InverseModel] = {LEARN: model}
    for name in config.compete:
        progress(0.8)
        models[name] = identify_one(name, u_V, y_um, dt_s, support)
    features = model.features
    slew = config.slew_V_per_s or SLEW_SPANS_PER_S * (plant.u_max_V - plant.u_min_V)
    limits = Limits(plant.u_min_V, plant.u_max_V, slew)
    progress(1.0)
    return IdentifiedPlant(
        models, u_V, y_um, dt_s, limits, features.y_min_um, features.y_max_um, features.y_rest_um,
        report.heldout_mae_pct,
    )  # fmt: skip


def excitation_range(plant: Plant, config: RehearsalConfig) -> tuple[float, float]:
    """Lowest and highest voltage of the excitation, V. Raises FieldError if they are beyond the drive."""
    low = plant.u_min_V if config.excite_low_V is None else config.excite_low_V
    high = plant.u_max_V if config.excite_high_V is None else config.excite_high_V
    if not plant.u_min_V <= low < high <= plant.u_max_V:
        raise FieldError(
            "excite_low_V, excite_high_V", f"{low:g} V, {high:g} V",
            f"two voltages within the drive, {plant.u_min_V:g} to {plant.u_max_V:g} V, the first one lower",
        )  # fmt: skip
    return low, high


def go_to_lowest(plant: Plant, low_V: float) -> None:
    """Move a plant from its rest to the lowest voltage of the excitation, and let it rest there."""
    rest_V = min(max(0.0, plant.u_min_V), plant.u_max_V)
    if rest_V == low_V:
        return
    q = np.linspace(0.0, 1.0, max(2, round(APPROACH_S / plant.dt_s)))
    run_checked(plant, rest_V + (low_V - rest_V) * q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3))
    run_checked(plant, np.full(max(1, round(REST_S / plant.dt_s)), low_V))
