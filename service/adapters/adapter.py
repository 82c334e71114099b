"""What an adapter of a real stage has to offer, its errors, and the clock by which it is read."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

from dehyst.adaptive.errors import DehystError
from dehyst.service.protocol.errors import FieldError


class AdapterError(DehystError):
    """The controller of a stage, or the library that speaks to it, is missing or does not answer."""


@runtime_checkable
class StageAdapter(Protocol):
    """One axis of a real stage in open loop: its sensor is read, its voltage is set. One thread calls it.

    Attributes
    ----------
    rate_Hz : sample rate at which it is run, Hz; it must be that of the served model.
    u_min_V, u_max_V : limits of the voltage, V. Nothing outside them is written.
    """

    @property
    def rate_Hz(self) -> float: ...

    @property
    def u_min_V(self) -> float: ...

    @property
    def u_max_V(self) -> float: ...

    def read_um(self) -> float:
        """The position now, µm. NaN where the sensor has no reading. Raises AdapterError where it does not answer."""
        ...

    def write_V(self, u_V: float) -> None:
        """Apply the voltage, V, from now on. Raises AdapterError where the controller refuses."""
        ...

    def applied_V(self) -> float:
        """The voltage that is applied now, V. Asked at the start, so that the first voltage is reached by a ramp."""
        ...

    def close(self) -> None:
        """Release the controller. The voltage stays as it is."""
        ...


class Stated(NamedTuple):
    """What a controller says about its axis.

    servo : it holds positions in closed loop. unit : of its positions, "" where it does not say.
    travel : length of its travel in that unit, from the lowest to the highest voltage; NaN where it does not say.
    """

    servo: bool
    unit: str
    travel: float


@runtime_checkable
class StatesAxis(Protocol):
    """The ability of an adapter whose controller can be asked about its axis, for `commission`."""

    def stated(self) -> Stated:
        """What the controller says now. Raises AdapterError where it does not answer."""
        ...


class Closing:
    """What closes itself at the end of its ``with``."""

    def close(self) -> None:
        """Release the controller. The voltage stays as it is."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def load_library(module: str, package: str) -> ModuleType:
    """The vendor's library ``module`` of the distribution ``package``. Raises AdapterError that says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise AdapterError(
            f"{module}: not installed ({error}); this adapter needs it: pip install {package}, or install dehyst with "
            "the extra 'hardware'"
        ) from error


def asked(call: Callable[..., Any], *values: float) -> Any:
    """What a call of the adapter returns. Raises AdapterError where the vendor's library raises anything."""
    try:
        return call(*values)
    except DehystError:
        raise
    except Exception as error:
        raise AdapterError(f"{call.__qualname__}: {type(error).__name__}: {error}") from error


def check_rate(rate_Hz: float) -> float:
    """``rate_Hz``. Raises FieldError unless it is a positive rate in Hz."""
    if not (math.isfinite(rate_Hz) and rate_Hz > 0.0):
        raise FieldError("rate_Hz", rate_Hz, "a positive sample rate in Hz")
    return float(rate_Hz)


def check_range(adapter: StageAdapter) -> tuple[float, float]:
    """(u_min_V, u_max_V) of the adapter. Raises FieldError unless they are finite and rising."""
    low_V, high_V = adapter.u_min_V, adapter.u_max_V
    if not (math.isfinite(low_V) and math.isfinite(high_V) and low_V < high_V):
        raise FieldError("u_min_V, u_max_V", f"{low_V}, {high_V}", "two finite voltages, the lower one first")
    return low_V, high_V


#: Lateness, as a share of the sample time, beyond which a reading is no sample: the stage has moved on meanwhile.
LATE_SHARE = 0.25


class Tick(NamedTuple):
    """One sample time: its number from 0 on, its time since the start, s, and whether it is too late for a sample."""

    k: int
    t_s: float
    late: bool


class Ticks:
    """Sample times in real time, as an iterator of `Tick`.

    Tick k is due at ``start + k / rate_Hz``, computed from k and never summed. Where the loop is late by a whole sample
    time, the numbers it missed are left out: a real stage cannot be read in the past.

    Attributes
    ----------
    late : ticks that were late by more than `LATE_SHARE` of the sample time, and those that were left out.
    worst_late_s : largest lateness of all, s.
    """

    def __init__(self, rate_Hz: float, n: int | None = None, stopped: Callable[[], bool] = lambda: False) -> None:
        self.late = 0
        self.worst_late_s = 0.0
        self._dt_s, self._n, self._stopped = 1.0 / check_rate(rate_Hz), n, stopped

    def __iter__(self) -> Iterator[Tick]:
        dt_s, k = self._dt_s, 0
        start = time.perf_counter()
        while (self._n is None or k < self._n) and not self._stopped():
            now_s = time.perf_counter() - start
            if k * dt_s > now_s:
                time.sleep(k * dt_s - now_s)
                now_s = time.perf_counter() - start
            behind_s = now_s - k * dt_s
            self.worst_late_s = max(self.worst_late_s, behind_s)
            missed = int(behind_s / dt_s)
            if missed > 0:
                last = k + missed if self._n is None else min(k + missed, self._n)
                self.late += last - k
                k = last
                continue
            late = behind_s > LATE_SHARE * dt_s
            self.late += late
            yield Tick(k, now_s, late)
            k += 1
