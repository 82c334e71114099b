"""The data that a stage model is fitted to, and the description of one model parameter.

`FitData` holds one recording: voltage, reading and what else was recorded, with the scales that make start values and
bounds of the parameters independent of units.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, TypeVar

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.masks import samples_since, samples_until

T = TypeVar("T")

#: A rest ends so long before the drive moves again, s: where the recorder's clock is fast, readings come early (3.5 ms
#: after a minute at 57 ppm), and a single one of them on the edge of a step would count as noise.
EARLY_S = 0.02


class LastResultCache(threading.local):
    """The last result computed from one array, per thread. The array is recognised by identity.

    Signals between the blocks of a model are never changed in place, so identity is enough. The cache is per thread
    because several candidate models are fitted in parallel.
    """

    source: FloatArray | None = None
    key: Hashable = None
    value: FloatArray

    def get(self, source: FloatArray, key: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
        """``make()``, or its last result if ``source`` is the same array and ``key`` is equal."""
        if self.source is not source or self.key != key:
            self.value = make()
            self.source, self.key = source, key
        return self.value


class DerivedArrays:
    """Results that depend on one `FitData` only, each computed at its first use.

    Two threads may compute the same entry twice; both results are equal, and the last one is kept.
    """

    def __init__(self) -> None:
        self._known: dict[Hashable, Any] = {}

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The entry ``key``, made by ``make()`` where it is missing."""
        if key not in self._known:
            self._known[key] = make()
        value: T = self._known[key]
        return value


class ActsOn(IntEnum):
    """The block of the signal path on which a parameter acts. Blocks before it need not be simulated again."""

    DRIVE = 0
    STATIC = 1
    DYNAMICS = 2
    MOTION = 3
    READING = 4


@dataclass(frozen=True, slots=True)
class ModelParameter:
    """One parameter of a model that a fit may change.

    ``neutral`` is the value at which its cause has no effect; ``step`` is its natural scale, used for differences.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    step: float
    acts_on: ActsOn
    #: The model is (almost) linear in it: its Jacobian column is computed once per calibration.
    linear: bool = False


@dataclass(frozen=True, slots=True)
class Scales:
    """Typical sizes of a recording. Start values, bounds and steps of the parameters are multiples of these.

    A model fitted to one recording keeps these scales on another one, so that its numbers mean the same there.
    """

    u_low_V: float
    u_high_V: float
    swing_V: float
    #: Range of the readings without the outermost 0.1 % on each side, which may be dropouts and spikes.
    range_um: float
    middle_um: float
    #: Regression slope of the readings over the voltage.
    gain_um_per_V: float
    #: Displacement at the middle voltage by the regression slope alone, without the sensor's offset.
    centre_um: float
    #: The slowest time constant of the creep model.
    slowest_s: float

    @staticmethod
    def of(dt_s: float, u_V: FloatArray, y_um: FloatArray) -> Scales:
        """The scales of a recording: ``u_V``, ``y_um`` (n,), ``dt_s`` apart."""
        u_low, u_high = float(np.min(u_V)), float(np.max(u_V))
        low, high = np.quantile(y_um, [0.001, 0.999])
        u = u_V - u_V.mean()
        gain = float(u @ y_um / max(float(u @ u), 1e-30))
        return Scales(
            u_low_V=u_low,
            u_high_V=u_high,
            swing_V=u_high - u_low,
            range_um=float(high - low),
            middle_um=float(0.5 * (high + low)),
            gain_um_per_V=gain,
            centre_um=0.5 * (u_low + u_high) * gain,
            slowest_s=min(3.0 * (int(u_V.shape[0]) * dt_s), 300.0),
        )


@dataclass(frozen=True, eq=False)
class FitData:
    """One recording as the cause models use it. Arrays are (n,); µm, V, s, °C."""

    dt_s: float
    u_V: FloatArray
    y_um: FloatArray
    #: Voltage and displacement of a second axis.
    u2_V: FloatArray | None = None
    y2_um: FloatArray | None = None
    #: Voltage of a third axis or actuator.
    u3_V: FloatArray | None = None
    temperature_C: FloatArray | None = None
    monitor_V: FloatArray | None = None
    #: The voltage runs in straight lines between its values (only in a subdivided drive).
    straight: bool = False
    #: The nominal stage has no hysteresis of its own.
    input_is_linear: bool = False
    #: Kind of the nominal stage, and the frequencies (Hz) of those lightly damped modes that a stage file states.
    nominal_kind: str = "bouc_wen"
    known_modes_hz: tuple[float, ...] = ()
    #: The nominal stage has a lightly damped mode, stated or calibrated.
    has_mode: bool = False
    #: The nominal stage has a lag of its own.
    has_lag: bool = True
    #: Lowest static displacement and largest loop of the recording that was fitted, if this is another one.
    fitted_low_um: float | None = None
    fitted_loop_um: float | None = None
    #: Displacement of the other axis and its rate (µm, µm/s), as far as known; set after calibration.
    other_um: FloatArray | None = field(default=None, repr=False)
    other_um_per_s: FloatArray | None = field(default=None, repr=False)
    #: Scales of another recording; None for the scales of this one.
    scales_from: Scales | None = None
    scales: Scales = field(init=False)
    _derived: DerivedArrays = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "scales", self.scales_from or Scales.of(self.dt_s, self.u_V, self.y_um))
        object.__setattr__(self, "_derived", DerivedArrays())

    def subdivided(self, substeps: int, hold: str) -> FitData:
        """The same data with ``substeps`` voltages per sample, held ("zero") or interpolated ("first").

        Readings and scales stay as they are.
        """
        if substeps == 1:
            return self

        def make() -> FitData:
            u = np.repeat(self.u_V, substeps)
            if hold == "first":
                u = np.interp(np.arange(u.size) / substeps, np.arange(self.n), self.u_V)
            return replace(self, dt_s=self.dt_s / substeps, u_V=u, straight=hold == "first", scales_from=self.scales)

        return self._derived.get(("subdivided", substeps, hold), make)

    def derived(self, key: Hashable, make: Callable[[], T]) -> T:
        """A result that depends on these data and ``key`` only; ``make()`` is called at the first use."""
        return self._derived.get(key, make)

    @property
    def n(self) -> int:
        """Number of voltages."""
        return int(self.u_V.shape[0])

    @property
    def duration_s(self) -> float:
        return self.n * self.dt_s

    @property
    def t_s(self) -> FloatArray:
        """(n,) time since the first sample."""
        return self._derived.get("t_s", lambda: np.arange(self.n, dtype=np.float64) * self.dt_s)

    @property
    def rate_V_per_s(self) -> FloatArray:
        """(n,) size of the backward difference of the voltage over time."""
        return self._derived.get("rate", lambda: np.abs(np.diff(self.u_V, prepend=self.u_V[0])) / self.dt_s)

    def standing(self, settle_s: float = 0.3) -> BoolArray:
        """(n,) True where the voltages of both axes have been constant for ``settle_s``, and for `EARLY_S` more."""
        still = self.rate_V_per_s <= 1e-9 * max(self.swing_V, 1e-30) / self.dt_s
        if self.u2_V is not None:
            still &= np.abs(np.diff(self.u2_V, prepend=self.u2_V[0])) == 0.0
        settled = samples_since(~still) >= settle_s / self.dt_s
        return np.asarray(still & settled & (samples_until(~still) > EARLY_S / self.dt_s))

    @property
    def turns(self) -> list[int]:
        """Samples at which the voltage turns by more than a tenth of its swing: a ripple on a slow move is no turn."""
        return self._derived.get("turns", self._turns)

    def _turns(self) -> list[int]:
        u, least = self.u_V, 0.1 * self.swing_V
        turns: list[int] = []
        way, high, low = 0, 0, 0
        for k in np.flatnonzero(np.diff(u, prepend=u[0]) != 0.0):
            if u[k] > u[high]:
                high = int(k)
            if u[k] < u[low]:
                low = int(k)
            if way >= 0 and u[high] - u[k] > least:
                turns.append(high)
                way, low = -1, int(k)
            elif way <= 0 and u[k] - u[low] > least:
                turns.append(low)
                way, high = 1, int(k)
        # The last bottom ends with the record.
        return [*turns, low] if way < 0 else turns

    @property
    def strokes(self) -> tuple[FloatArray, FloatArray]:
        """Duration (s) without rests, and mean rate (V/s), of each move from one turn of the voltage to the next."""
        at = np.array([0, *self.turns], dtype=np.int64)
        moving_s = np.diff(np.cumsum(self.rate_V_per_s > 0.0)[at]) * self.dt_s
        way_V = np.abs(np.diff(self.u_V[at]))
        real = (moving_s > 0.0) & (way_V > 0.05 * self.swing_V)
        return moving_s[real], way_V[real] / moving_s[real]

    @property
    def begins_at_rest(self) -> bool:
        """Whether the drive stays within 1 % of its swing about zero volts for the first 20 ms."""
        first = self.u_V[: max(3, round(0.02 / self.dt_s))]
        return bool(np.max(np.abs(first)) < 0.01 * self.swing_V)

    @property
    def warmth_K(self) -> FloatArray | None:
        """(n,) temperature above that at the start; None if it was not recorded or did not change."""
        return self._derived.get("warmth", self._temperature_rise)

    def _temperature_rise(self) -> FloatArray | None:
        if self.temperature_C is None:
            return None
        rise = self.temperature_C - np.mean(self.temperature_C[: max(1, self.n // 200)])
        return np.asarray(rise, dtype=np.float64) if float(np.ptp(rise)) > 1e-3 else None

    @property
    def u_low_V(self) -> float:
        return self.scales.u_low_V

    @property
    def u_high_V(self) -> float:
        return self.scales.u_high_V

    @property
    def swing_V(self) -> float:
        return self.scales.swing_V

    @property
    def range_um(self) -> float:
        return self.scales.range_um

    @property
    def middle_um(self) -> float:
        return self.scales.middle_um

    @property
    def gain_um_per_V(self) -> float:
        return self.scales.gain_um_per_V

    @property
    def centre_um(self) -> float:
        return self.scales.centre_um

    @property
    def slowest_s(self) -> float:
        return self.scales.slowest_s
