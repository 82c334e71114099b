"""What the fit forms of the causes are handed: the drive, its sampling, what else was recorded, and scales."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from adaptive.types import FloatArray


class Kept:
    """The last result for one array, by identity: signals between stretches are never changed in place.

    Kept apart by thread, because candidates are fitted side by side.
    """

    def __init__(self) -> None:
        self._local = threading.local()

    def of(self, source: FloatArray, key: object, make: Callable[[], FloatArray]) -> FloatArray:
        """``make()``, or what it gave for this very array and key the last time."""
        if getattr(self._local, "source", None) is not source or self._local.key != key:
            self._local.value = make()
            self._local.source, self._local.key = source, key
        value: FloatArray = self._local.value
        return value

    def forget(self) -> None:
        """Let go of the arrays held for this thread."""
        self._local.__dict__.clear()


#: Scales by which numbers fitted in one recording mean the same in another.
_SCALES = (
    "u_low_V", "u_high_V", "swing_V", "range_um", "middle_um", "gain_um_per_V", "slowest_s", "centre_um"
)  # fmt: skip


class At(IntEnum):
    """Where along the signal's way a parameter acts; everything before it need not be simulated again."""

    DRIVE = 0
    STATIC = 1
    DYNAMICS = 2
    MOTION = 3
    READING = 4


@dataclass(frozen=True, slots=True)
class Slot:
    """One number of the model that a fit may move.

    ``neutral`` is the value with which its cause does nothing; ``step`` its natural scale, used for differences.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    step: float
    at: At
    #: Its column hardly changes along a fit (the model is linear in it): computed once a calibration.
    steady: bool = False


@dataclass(frozen=True)
class Setting:
    """A recording as the fit forms see it. Arrays are (n,); µm, V, s, °C."""

    dt_s: float
    u_V: FloatArray
    y_um: FloatArray
    u2_V: FloatArray | None = None
    y2_um: FloatArray | None = None
    #: A third axis or actuator.
    u3_V: FloatArray | None = None
    temperature_C: FloatArray | None = None
    monitor_V: FloatArray | None = None
    #: The drive runs in straight lines between its values (only where it was refined so).
    straight: bool = False
    #: The nominal stage has no hysteresis of its own.
    input_is_linear: bool = False
    #: Kind of the nominal stage, and its lightly damped modes whose frequency (Hz) is known beforehand.
    nominal_kind: str = "bouc_wen"
    known_modes_hz: tuple[float, ...] = ()
    #: The nominal stage has a lightly damped mode, known or calibrated.
    has_mode: bool = False
    #: Lowest static displacement and largest loop of the recording that was fitted, where this is another.
    fitted_low_um: float | None = None
    fitted_loop_um: float | None = None
    #: Displacement of the other axis as far as it is known, and its rate (µm, µm/s); set after calibration.
    other_um: FloatArray | None = field(default=None, repr=False)
    other_um_per_s: FloatArray | None = field(default=None, repr=False)

    def fine(self, substeps: int, hold: str) -> Setting:
        """The same drive in ``substeps`` shorter steps a sample, held or straight between two samples ("first");
        readings stay as they are."""
        if substeps == 1:
            return self
        known: dict[tuple[int, str], Setting] = self.__dict__.setdefault("_fine", {})
        if (substeps, hold) not in known:
            u = np.repeat(self.u_V, substeps)
            if hold == "first":
                u = np.interp(np.arange(u.size) / substeps, np.arange(self.n), self.u_V)
            finer = replace(self, dt_s=self.dt_s / substeps, u_V=u, straight=hold == "first")
            known[substeps, hold] = finer.scaled_as(self)
        return known[substeps, hold]

    def scaled_as(self, other: Setting) -> Setting:
        """This setting with the scales of another, so that numbers fitted there mean the same here."""
        for name in (
            "u_low_V",
            "u_high_V",
            "swing_V",
            "range_um",
            "middle_um",
            "gain_um_per_V",
            "slowest_s",
            "centre_um",
        ):
            self.__dict__[name] = getattr(other, name)
        return self

    @property
    def n(self) -> int:
        return int(self.u_V.shape[0])

    @cached_property
    def t_s(self) -> FloatArray:
        return np.arange(self.n, dtype=np.float64) * self.dt_s

    @cached_property
    def u_low_V(self) -> float:
        return float(np.min(self.u_V))

    @cached_property
    def u_high_V(self) -> float:
        return float(np.max(self.u_V))

    @cached_property
    def swing_V(self) -> float:
        return self.u_high_V - self.u_low_V

    @cached_property
    def range_um(self) -> float:
        """Range of the readings without the outermost per mille, which dropouts and spikes may own."""
        low, high = np.quantile(self.y_um, [0.001, 0.999])
        return float(high - low)

    @cached_property
    def gain_um_per_V(self) -> float:
        """Slope of the readings over the voltage, the start of every calibration."""
        u = self.u_V - self.u_V.mean()
        return float(u @ self.y_um / max(float(u @ u), 1e-30))

    @cached_property
    def middle_um(self) -> float:
        low, high = np.quantile(self.y_um, [0.001, 0.999])
        return float(0.5 * (high + low))

    @cached_property
    def duration_s(self) -> float:
        return self.n * self.dt_s

    @cached_property
    def centre_um(self) -> float:
        """Displacement at the middle of the voltages by the mean slope alone, without the sensor's offset."""
        return 0.5 * (self.u_low_V + self.u_high_V) * self.gain_um_per_V

    @cached_property
    def slowest_s(self) -> float:
        """The slowest time constant that creep is given, the same in every recording of one diagnosis."""
        return min(3.0 * self.duration_s, 300.0)

    @cached_property
    def rate_V_per_s(self) -> FloatArray:
        """Size of the backward difference of the voltage over time, (n,)."""
        return np.abs(np.diff(self.u_V, prepend=self.u_V[0])) / self.dt_s

    @cached_property
    def warmth_K(self) -> FloatArray | None:
        """Temperature less that of the start, or None where it was not recorded or did not move."""
        if self.temperature_C is None:
            return None
        rise = self.temperature_C - np.mean(self.temperature_C[: max(1, self.n // 200)])
        return np.asarray(rise, dtype=np.float64) if float(np.ptp(rise)) > 1e-3 else None
