"""What moves a stage in a commissioning, within limits, and what watches it."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.service.adapters.adapter import StageAdapter, Tick, Ticks, asked, check_range
from dehyst.service.answers.guard import Limits, limit_voltage
from dehyst.service.protocol.errors import FieldError

#: Standard errors that motion is seen by.
SEEN: Final = 8.0
#: Longest time without a reading, s.
_BLIND_S: Final = 0.5
#: Bounds of the motion relative to the expected one, on a way of this share of the range that takes this long, s.
_FOLLOWS, WAY_SHARE, WAY_S = (0.25, 4.0), 0.1, 0.1
#: Share of the voltage at which the reading stops that is proposed as a limit.
_FREE: Final = 0.9


class StageFault(DehystError):
    """What ends a commissioning early.

    ``kind`` is ``servo``, ``unit``, ``sign``, ``limit``, ``ringing``, ``no_motion``, ``no_reading``, ``failed`` (the
    adapter or the identification raised an error), ``time`` (it is over) or ``stopped``.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


@dataclass(frozen=True, slots=True)
class Order:
    """What is asked of a commissioning.

    Attributes
    ----------
    limits : of voltage, V, and slew rate, V/s, that are never left.
    gain_um_per_V : what the stage should move, µm/V, negative where it moves down; NaN: what the controller says.
    target_pct : largest rms error on the held-out stretch, percent of the range.
    duration_s : longest time, s.
    stage, axis : names for the model file.
    """

    limits: Limits
    gain_um_per_V: float = math.nan
    target_pct: float = 0.2
    duration_s: float = 180.0
    stage: str = "demo"
    axis: str = "x"


class Piece(NamedTuple):
    """A drive as it was applied, (n,) each: sample number, voltage, V, reading before it, µm, and if it was in time."""

    k: NDArray[np.int64]
    u_V: FloatArray
    y_um: FloatArray
    timely: BoolArray


class Mover:
    """Opens a stage, moves it within limits, and keeps its samples: number, V, µm, and whether it was in time.

    ``stopped`` : the reason to stop, "" for none. ``until_s`` : end by ``time.perf_counter``, s.

    Raises FieldError where the limits are beyond those of the adapter, or the stage rests outside them.
    """

    def __init__(
        self, open_stage: Callable[[], StageAdapter], limits: Limits, stopped: Callable[[], str] = str,
        until_s: float = math.inf,
    ) -> None:  # fmt: skip
        self._open_stage, self._stopped, self._until_s = open_stage, stopped, until_s
        self.limits, self.adapter = limits, asked(open_stage)
        self.samples: list[tuple[int, float, float, bool]] = []
        self._blind, self._moved = 0, False
        if not isinstance(self.adapter, StageAdapter):
            raise FieldError("--adapter", type(self.adapter).__name__, "a StageAdapter, see docs/connect.md")
        try:
            self._check()
        except DehystError:
            self.close()
            raise
        self.dt_s, self.ticks = 1.0 / self.adapter.rate_Hz, Ticks(self.adapter.rate_Hz)
        self._clock = iter(self.ticks)

    def _check(self) -> None:
        low_V, high_V = check_range(self.adapter)
        limits = self.limits
        if limits.u_min_V < low_V or limits.u_max_V > high_V:
            raise FieldError(
                "--u-min, --u-max", f"{limits.u_min_V:g} to {limits.u_max_V:g} V",
                f"voltages within {low_V:g} to {high_V:g} V, the limits of the adapter",
            )  # fmt: skip
        self.rest_V = self.u_V = self._applied_V()
        if not limits.u_min_V <= self.rest_V <= limits.u_max_V:
            raise FieldError(
                "applied_V", f"{self.rest_V:g} V", f"{limits.u_min_V:g} to {limits.u_max_V:g} V (--u-min, --u-max)",
                "bring the stage there first, or state other limits",
            )  # fmt: skip

    def _applied_V(self) -> float:
        u_V = float(asked(self.adapter.applied_V))
        if not math.isfinite(u_V):
            raise FieldError("applied_V", u_V, "the voltage that is applied now, in V")
        return u_V

    def play(self, u_V: FloatArray, watch: Callable[[float, float], None] = lambda u_V, y_um: None) -> Piece:
        """Apply (n,) voltages, one each sample time; a busy loop makes it longer and leaves none out.

        ``watch`` gets each reading, µm, with the voltage before it, V. Raises what it raises, StageFault, and
        AdapterError where the stage is gone.
        """
        begin = len(self.samples)
        for wanted_V in u_V.tolist():
            self._sample(next(self._clock), wanted_V, watch)
        return self.piece(begin)

    def piece(self, begin: int) -> Piece:
        """The samples from the ``begin``-th on."""
        k, u_V, y_um, timely = zip(*self.samples[begin:], strict=True)
        return Piece(np.array(k), np.array(u_V), np.array(y_um), np.array(timely))

    def hold(self, done: Callable[[], bool]) -> None:
        """Keep the voltage and go on reading until ``done``."""
        for tick in self._clock:
            self._sample(tick, self.u_V, lambda u_V, y_um: None)
            if done():
                return

    def _sample(self, tick: Tick, wanted_V: float, watch: Callable[[float, float], None]) -> None:
        if reason := self._stopped():
            raise StageFault("stopped", f"stopped by {reason}")
        if time.perf_counter() > self._until_s:
            raise StageFault("time", "the time was over before a model was identified (--duration)")
        y_um = float(asked(self.adapter.read_um))
        self._blind = 0 if math.isfinite(y_um) else self._blind + 1
        if self._blind * self.dt_s > _BLIND_S:
            raise StageFault("no_reading", f"{self._blind} readings in a row are not numbers: look at the sensor")
        watch(self.u_V, y_um)
        self._write(wanted_V)
        self.samples.append((tick.k, self.u_V, y_um, not tick.late))

    def _write(self, wanted_V: float) -> None:
        limits = self.limits
        step_V = limits.slew_V_per_s * self.dt_s
        u_V, _ = limit_voltage(wanted_V, self.u_V, limits.u_min_V, limits.u_max_V, step_V)
        self._moved = self._moved or u_V != self.u_V
        asked(self.adapter.write_V, u_V)
        self.u_V = u_V

    def back(self) -> str:
        """Ramp to the voltage at which the stage was found, without looking; where need be over a new connection.

        Returns where the stage is then.
        """
        if not self._moved:
            return f"where it was found, at {self.rest_V:g} V"
        try:
            try:
                self._ramp_back()
            except DehystError:
                self.close()
                self.adapter = asked(self._open_stage)
                self.u_V = self._applied_V()
                self._ramp_back()
        except DehystError as error:
            return f"NOT at rest: {error}; the voltage stays, last known at {self.u_V:.4g} V"
        return f"back at rest, {self.rest_V:g} V"

    def _ramp_back(self) -> None:
        for _ in Ticks(self.adapter.rate_Hz):
            self._write(self.rest_V)
            if self.u_V == self.rest_V:
                return

    def close(self) -> None:
        """Close the adapter; one that is broken is left as it is."""
        with contextlib.suppress(DehystError):
            asked(self.adapter.close)


class Following:
    """A watch: raises StageFault where the readings leave the motion that the gain lets expect.

    Parameters
    ----------
    gain_um_per_V : of the stage. rest : its voltage, V, and reading, µm, at rest. span_V : of the motion.
    band : largest distance from the line through the rest, as a share of the motion. sigma_um : noise of a reading.
    """

    def __init__(
        self, gain_um_per_V: float, rest: tuple[float, float], span_V: float, band: float, sigma_um: float, dt_s: float
    ) -> None:
        self._gain, self._rest, self._sigma_um, self._dt_s = gain_um_per_V, rest, sigma_um, dt_s
        self._band_um = max(band * abs(gain_um_per_V) * span_V, SEEN * sigma_um)
        self._way_V = WAY_SHARE * span_V
        self._before, self._anchor, self._steps, self._turned = rest, rest, 0, True

    def __call__(self, u_V: float, y_um: float) -> None:
        if not math.isfinite(y_um):
            return
        off_um = abs(y_um - self._rest[1] - self._gain * (u_V - self._rest[0]))
        if off_um > self._band_um:
            raise self._ringing(u_V, f"is {off_um:.3g} µm away from what the gain lets expect")
        if (u_V - self._before[0]) * (self._before[0] - self._anchor[0]) < 0.0:
            self._anchor, self._steps, self._turned = self._before, 0, True
        self._before, self._steps = (u_V, y_um), self._steps + 1
        expected_um = self._gain * (u_V - self._anchor[0])
        far = abs(u_V - self._anchor[0]) >= self._way_V and abs(expected_um) > 2.0 * SEEN * self._sigma_um
        if not far or self._steps * self._dt_s < WAY_S:
            return
        moved_um = y_um - self._anchor[1]
        ratio = moved_um / expected_um
        # Just after a turn creep and hysteresis still go the other way.
        if not self._turned and not _FOLLOWS[0] <= ratio <= _FOLLOWS[1]:
            if abs(ratio) > _FOLLOWS[0]:
                raise self._ringing(u_V, f"moved by {moved_um:.3g} µm, expected about {expected_um:.3g} µm")
            free_V = self._rest[0] + _FREE * (y_um - self._rest[1]) / self._gain
            raise StageFault(
                "limit", f"from {self._anchor[0]:.4g} to {u_V:.4g} V the reading moved by {moved_um:.3g} µm, expected "
                f"about {expected_um:.3g} µm: the end of the travel, a limit switch, or a limit of the sensor; state "
                f"{'--u-max' if u_V > self._anchor[0] else '--u-min'} {free_V:.3g}, or look at the stage",
            )  # fmt: skip
        self._anchor, self._steps, self._turned = (u_V, y_um), 0, False

    @staticmethod
    def _ringing(u_V: float, what: str) -> StageFault:
        advice = "the stage rings or was pushed; state a lower --slew, or look at the stage"
        return StageFault("ringing", f"at {u_V:.4g} V the reading {what}: {advice}")
