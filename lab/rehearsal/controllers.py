"""Controllers on one stage: the service's model with and without its corrections, beside their rivals.

All get readings of the same age and follow the same motion. Errors are mean absolute errors of the true position in
percent of the commanded range. The age, in samples, counts for learner and correction alike: 1 is the reading of the
sample before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from scipy.signal import butter, filtfilt

from dehyst.adaptive.correction.integral import Correction, sensitivity
from dehyst.adaptive.types import FloatArray
from dehyst.lab.loop import Controller, Stepped, samples, stepped
from dehyst.lab.rehearsal.disturbance import DisturbedPlant, DisturbedSensor, Event, EventScale
from dehyst.lab.rehearsal.plant import IdentifiedPlant, PlantFactory, go_to_lowest
from dehyst.lab.rehearsal.reference import (
    BEGIN_S,
    Motion,
    Placed,
    RandomReference,
    ReferenceMaker,
    ReferenceRequest,
    Sawtooth,
)
from dehyst.lab.rehearsal.rehearsal import AXIS, STAGE, bundle_of
from dehyst.lab.rehearsal.runs import IDLE_S, times
from dehyst.service.answers.correcting import Answer, Correcting
from dehyst.service.answers.guard import Limits
from dehyst.service.client.follower import Follower
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.config.settings import LEARN, AxisConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.model import ModelMessage, encode_model
from dehyst.service.reports import tables
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis

#: Controllers by name, and what they are. "frozen": the identified model, which does not learn. "I" keeps to the
#: drive's range alone and doubts nothing; it is of the same design as the correction.
WAYS: Final = {
    "alone": "the learning model",
    "corrected": "the learning model with the correction",
    "repetition": "the learning model with correction and repetition",
    "frozen": "the identified model",
    "frozen+I": "the identified model and an integrator",
    "I": "an integrator alone",
    "iterative": "iterative learning control that begins with the mean slope",
    "frozen+iterative": "iterative learning control that begins with the identified model",
}
_LEARNING: Final = ("alone", "corrected", "repetition")
#: The iterative control: share of the error that a line corrects, and its cut-off as a share of ``mode_Hz``.
ITERATIVE: Final = (0.5, 0.7)
#: Length of a run, when its event happens, and when its errors begin to count, s.
SECONDS: Final = 6.0
EVENT_S: Final = 4.0
COUNT_S: Final = 2.0
#: Lines of a raster that are followed, and that are shown.
LINES, SHOWN = 20, (1, 5, 10, 20)
RESYNCHRONISE_S: Final = 0.25
SNAPSHOT_EVERY: Final = 5


class Unbounded(Correcting):
    """The rival: the same integral, that keeps to the drive's range alone and doubts nothing."""

    def __init__(self, config: CorrectionConfig, limits: Limits, dt_s: float) -> None:
        super().__init__(replace(config, share=1.0), limits, dt_s)

    def voltage(
        self, first: int, model: Any, points: Any, memory: FloatArray, answer: Answer, trouble: str = ""
    ) -> FloatArray:
        """As of a model of unknown error, whatever the service says."""
        return super().voltage(first, model, points, memory, (answer[0], math.inf))


class Following:
    """A follower of ``axis``, which is kept up to date sample by sample; without ``learns`` it keeps its first model.

    Parameters
    ----------
    first : number of sample 0 in the axis' count. correcting : what the follower corrects by; None: nothing.

    Attributes
    ----------
    added_V : the integral's part of each voltage, V.
    """

    def __init__(self, axis: Axis, wanted: Motion, first: int, correcting: Correcting | None, learns: bool) -> None:
        self._axis, self._first, self._learns, self.correcting = axis, first, learns, correcting
        begun = self._newest()
        payload = encode_model(LEARN, begun.model, begun.snapshot_seq, begun.memory, begun.safety)
        self._follower = Follower(
            None, None, LEARN, lambda: payload, axis.limits, correcting=correcting  # type: ignore[arg-type]
        )  # fmt: skip
        self._served = axis.newest
        self._wanted = tuple(column.tolist() for column in wanted)
        self._every = round(RESYNCHRONISE_S / axis.dt_s)
        self._u_V, self._read_um = np.zeros(wanted.y_um.size), np.zeros(wanted.y_um.size)
        self.added_V: list[float] = []

    def _newest(self) -> ModelMessage:
        model, seq, memory = self._axis.model(LEARN)
        return ModelMessage(LEARN, model, seq, memory, self._axis.safety(LEARN))

    def read(self, k: int, u_V: float, y_um: float) -> None:
        self._u_V[k], self._read_um[k] = u_V, y_um
        axis, follower, first = self._axis, self._follower, self._first
        if self._learns:
            axis.handle(samples(first + k, axis.dt_s, self._u_V[k : k + 1], self._read_um[k : k + 1]))
            if axis.newest is not self._served:
                self._served = axis.newest
                follower._take(self._newest())
            if len(self.added_V) % self._every == self._every - 1:
                part = np.arange(max(follower.snapshot_seq - 1 - first, 0), k + 1)
                follower.resynchronise(first + part, self._u_V[part], self._read_um[part])
        follower.read(first + k, y_um)

    def voltage(self, k: int) -> float:
        y, v, a = (column[k] for column in self._wanted)
        u_V = self._follower.point(y, v, a, seq=self._first + k)
        self.added_V.append(0.0 if self.correcting is None else self.correcting.integral_V)
        return u_V


def repeating(axis: Axis, mode_Hz: float) -> Correcting:
    """The correction of ``axis`` with the repetition; ``mode_Hz`` : lowest frequency at which the stage rings, Hz."""
    config, repetition = CorrectionConfig(on=True, mode_Hz=mode_Hz), RepetitionConfig(on=True, mode_Hz=mode_Hz)
    return Correcting(config, axis.limits, axis.dt_s, repetition)


class _Integral:
    """The rival without a feedforward: the mean slope of the stage, and the same design."""

    def __init__(self, course: Course, config: CorrectionConfig, age: int) -> None:
        known = course.known
        gain = float(np.polyfit(known.u_V, known.y_um, 1)[0])
        self._limits, self._low_V, self._wanted_um = known.limits, course.low_V, course.wanted.y_um
        self._integral = Correction(known.dt_s, config.mode_Hz, config.fade_s)
        self._integral.set(age, 1.0 / gain, 0.0, 1e9)
        self._u_V = course.low_V

    def read(self, k: int, u_V: float, y_um: float) -> None:
        self._integral.take(self._wanted_um.item(k) - y_um, math.inf)
        self._u_V = min(max(self._low_V + self._integral.u_V, self._limits.u_min_V), self._limits.u_max_V)
        self._integral.u_V = self._u_V - self._low_V  # no wind-up at the limits

    def voltage(self, k: int) -> float:
        return self._u_V


class _Iterative:
    """The rival of the repetition: an iterative learning control, u <- Q (u + gain slope e), line by line.

    Q is a Butterworth low-pass, forth and back; e leads by the identified lag. Until a line has been learnt ``first``
    gives the voltages, or the mean slope.
    """

    def __init__(self, course: Course, config: CorrectionConfig, first: Controller | None) -> None:
        known = course.known
        model = known.models[LEARN]
        lag_s = sensitivity(model, known.rest_um, model.rest_memory(known.rest_um), known.high_um - known.low_um)[1]
        self._first, self._limits, self._wanted_um = first, known.limits, course.wanted.y_um
        self._slope = 1.0 / float(np.polyfit(known.u_V, known.y_um, 1)[0])
        self._rise = self._slope * (course.wanted.y_um - course.wanted.y_um[0]) + course.low_V
        self._filter = butter(2, min(2.0 * ITERATIVE[1] * config.mode_Hz * known.dt_s, 0.9))
        self._period, self._begin = 1.0 / course.raster_Hz / known.dt_s, BEGIN_S / known.dt_s
        self._lead, self._table = lag_s / known.dt_s, np.empty(0)
        self._places = np.arange(math.ceil(self._period)) * self._period / math.ceil(self._period)
        self._pass: list[tuple[float, float, float]] = []

    def read(self, k: int, u_V: float, y_um: float) -> None:
        """Learns once a line is complete."""
        if self._first is not None:
            self._first.read(k, u_V, y_um)
        if k < self._begin:
            return
        place = (k - self._begin) % self._period
        if self._pass and place < self._pass[-1][0]:
            at, u, e = np.array(self._pass).T
            if not self._table.size:
                self._table = np.interp(self._places, at, u, period=self._period)
            e = np.interp(self._places + self._lead, at, e, period=self._period)
            table = np.tile(self._table + ITERATIVE[0] * self._slope * e, 3)
            self._table = filtfilt(*self._filter, table)[self._places.size : 2 * self._places.size]
            self._pass.clear()
        self._pass.append((place, u_V, self._wanted_um.item(k) - y_um))

    def voltage(self, k: int) -> float:
        u_V = float(self._rise[k]) if self._first is None else self._first.voltage(k)
        if self._table.size:
            u_V = float(np.interp((k - self._begin) % self._period, self._places, self._table, period=self._period))
        return min(max(u_V, self._limits.u_min_V), self._limits.u_max_V)


def triangles(frequency_Hz: float) -> ReferenceMaker:
    """Sharp triangles of so many hertz over the whole band, after a rest and a slow move."""
    return lambda wish: Placed(Sawtooth(frequency_Hz), wish.start_um, wish.low_um, wish.high_um - wish.low_um)


def raster_times(frequency_Hz: float, dt_s: float) -> FloatArray:
    """(n,) times, s, of a motion that repeats `LINES` times with this frequency from `BEGIN_S` on."""
    return times(math.ceil((BEGIN_S + LINES / frequency_Hz) / dt_s), dt_s)


def line_errors_pct(wanted_um: FloatArray, true_um: FloatArray, frequency_Hz: float, dt_s: float) -> FloatArray:
    """(`LINES`,) mean absolute errors of the lines of a raster, percent of its range."""
    t_s = times(wanted_um.size, dt_s) - BEGIN_S
    error = 100.0 / np.ptp(wanted_um[t_s >= 0.0]) * np.abs(wanted_um - true_um)
    line = np.floor(t_s * frequency_Hz + 1e-9)
    return np.array([error[line == k].mean() for k in range(LINES)])


@dataclass(frozen=True, slots=True)
class Course:
    """A stage, identified, and the motion that all controllers are to make it follow.

    Attributes
    ----------
    low_V : voltage at which it rests. mode_Hz : lowest frequency at which it rings, Hz. range_um : what errors refer
    to. raster_Hz : of a raster; NaN for other motion.
    """

    seed: int
    make: PlantFactory
    low_V: float
    mode_Hz: float
    known: IdentifiedPlant
    wanted: Motion
    range_um: float
    raster_Hz: float = math.nan

    @classmethod
    def of(
        cls, make: PlantFactory, known: IdentifiedPlant, low_V: float, mode_Hz: float, seed: int, **more: Any
    ) -> Self:
        """A motion that does not repeat."""
        span, n = known.high_um - known.low_um, round(SECONDS / known.dt_s)
        wish = ReferenceRequest(known.rest_um, known.low_um + 0.1 * span, known.low_um + 0.9 * span, SECONDS, seed)
        wanted = RandomReference(wish)(times(n, known.dt_s))
        range_um = float(np.ptp(wanted.y_um[round(2.0 / known.dt_s) :]))
        return cls(seed, make, low_V, mode_Hz, known, wanted, range_um, **more)

    def raster(self, frequency_Hz: float, reference: ReferenceMaker | None = None) -> Self:
        """A raster of so many hertz on the same stage; of `triangles`, where no ``reference`` makes another one."""
        known, t_s = self.known, raster_times(frequency_Hz, self.known.dt_s)
        span, until_s = known.high_um - known.low_um, BEGIN_S + LINES / frequency_Hz
        wish = ReferenceRequest(
            known.rest_um, known.low_um + 0.1 * span, known.low_um + 0.9 * span, until_s, self.seed
        )  # fmt: skip
        wanted = (reference or triangles(frequency_Hz))(wish)(t_s)
        range_um = float(np.ptp(wanted.y_um[t_s >= BEGIN_S]))
        return replace(self, wanted=wanted, range_um=range_um, raster_Hz=frequency_Hz)

    def follow(
        self, way: str, age: int, event: Event, drift_per_s: float = 0.0
    ) -> tuple[Stepped, Following | None, Axis]:
        """The run of a controller (a key of `WAYS`), itself if it follows the service's model, and its axis.

        drift_per_s : of the sensor from the event on, share of the range a second.
        """
        known, n = self.known, self.wanted.y_um.size
        config = CorrectionConfig(on=True, mode_Hz=self.mode_Hz)
        dt_s, limits, low_V = known.dt_s, known.limits, self.low_V
        axis = load_axis(
            STAGE, AxisConfig(AXIS, Path("rehearsal"), limits, compete=(), snapshot_every=SNAPSHOT_EVERY),
            bundle=bundle_of(known),
        )  # fmt: skip
        inner = self.make()
        go_to_lowest(inner, low_V)
        scale = EventScale(self.range_um, 0.5 * (known.low_um + known.high_um), known.rest_um)
        plant, sensor = DisturbedPlant(inner, event, scale), DisturbedSensor(event, scale, dt_s, n)
        rest = round(IDLE_S / dt_s)
        rest_V = np.full(rest, low_V)
        axis.handle(samples(1, dt_s, rest_V, plant.run(-rest, rest_V)[1]))
        correcting = None
        if way == "repetition":
            correcting = repeating(axis, self.mode_Hz)
        elif way in ("corrected", "frozen+I"):
            correcting = (Correcting if way == "corrected" else Unbounded)(config, axis.limits, dt_s)
        following = Following(axis, self.wanted, rest + 1, correcting, way in _LEARNING)
        controller: Controller = following
        if way == "I":
            controller = _Integral(self, config, age)
        elif "iterative" in way:
            controller = _Iterative(self, config, following if way == "frozen+iterative" else None)

        def stage(k: int, u_V: FloatArray) -> tuple[float, float]:
            true_um, read_um = plant.run(k, u_V)
            drift_um = drift_per_s * self.range_um * max(k * dt_s - EVENT_S, 0.0)
            return true_um.item(), sensor.read(k, read_um).item() + drift_um

        return stepped(controller, n, age, stage), following if way != "I" else None, axis


# --- In a rehearsal

#: The step of the gain, controllers of each motion, and the frequency of the raster, Hz.
_STEP: Final = 0.06
_MOVING: Final = ("alone", "corrected", "frozen+I", "I")
REPEATING: Final = ("alone", "corrected", "repetition", "frozen+I", "I", "iterative")
RASTER_HZ: Final = 15.0
HEAD: Final = ("controller", "age", "moving", f"1 s after gain {100.0 * _STEP:+g} %", *(f"line {k}" for k in SHOWN))


@dataclass(frozen=True, slots=True)
class Compared:
    """A controller with readings of an age, samples: errors in percent of the range, NaN where it does not apply.

    Attributes
    ----------
    moving_pct : of motion that does not repeat. first_second_pct : after a step of the gain. lines_pct : of the lines
    `SHOWN` of a raster of `RASTER_HZ`.
    """

    way: str
    age: int
    moving_pct: float
    first_second_pct: float
    lines_pct: tuple[float, ...]


def compare(
    plant_factory: PlantFactory,
    known: IdentifiedPlant,
    low_V: float,
    mode_Hz: float,
    ages: Sequence[int],
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> tuple[Compared, ...]:
    """All controllers on an identified plant, with readings of each of the ``ages``, samples.

    low_V : lowest voltage of the excitation. mode_Hz : lowest frequency at which the stage rings, Hz. Raises FieldError
    on an age below 1, and what the plant raises.
    """
    if not all(age >= 1 for age in ages):
        raise FieldError("ages", f"{min(ages)}", "samples, 1 or more")
    course = Course.of(plant_factory, known, low_V, mode_Hz, seed)
    lines = course.raster(RASTER_HZ)
    at, second = (round(time_s / known.dt_s) for time_s in (EVENT_S, 1.0))
    counted = slice(round(COUNT_S / known.dt_s), at)
    found: list[Compared] = []
    for age in ages:
        for way in REPEATING:
            progress(f"{WAYS[way]}, readings {age} samples old", len(found) / (len(ages) * len(REPEATING)))
            moving = first_second = math.nan
            if way in _MOVING:
                got = course.follow(way, age, Event("gain", "gain", EVENT_S, _STEP, 0.0, seed))[0]
                error = 100.0 / course.range_um * np.abs(course.wanted.y_um - got.true_um)
                moving, first_second = float(error[counted].mean()), float(error[at : at + second].mean())
            got = lines.follow(way, age, Event("none", "none", EVENT_S, 0.0, 0.0, seed))[0]
            errors = line_errors_pct(lines.wanted.y_um, got.true_um, RASTER_HZ, known.dt_s)
            found.append(Compared(way, age, moving, first_second, tuple(errors[k - 1].item() for k in SHOWN)))
    return tuple(found)


def table(found: Sequence[Compared], markdown: bool = False) -> str:
    """All controllers as a table; ``markdown`` for a page."""

    def cell(value: float) -> str:
        return f"{value:.3f}" if math.isfinite(value) else "-"

    rows = [
        (WAYS[one.way], str(one.age), *map(cell, (one.moving_pct, one.first_second_pct, *one.lines_pct)))
        for one in found
    ]
    if markdown:
        return tables.markdown(HEAD, rows)
    told = f"errors: mean absolute, % of the commanded range; lines of a raster of {RASTER_HZ:g} Hz; age in samples"
    return "\n".join([*tables.aligned(HEAD, rows, left=(0,)), told])
