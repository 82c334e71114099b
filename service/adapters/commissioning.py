"""Identification on live hardware (``dehyst commission``): a stage is moved further and further, watched, recorded.

Opening moves nothing. The readings at rest give the noise. Pulses then grow from `START_V` until the stage is seen to
move: there sign and unit are checked against what the controller or the user says. Pulses grow on to the ends of the
stated voltages while the readings have to follow. Rounds of ramps with holds, a decaying sine, a small sweep and a
held-out stretch are recorded and identified until the error on that stretch is small enough or the time is over.

Every voltage passes `Mover`: none is outside the stated limits, none changes faster than the stated slew rate. Whatever
ends the work early, the stage goes back by a ramp to the voltage at which it was found.
"""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import DehystError
from adaptive.types import BoolArray, FloatArray
from service.adapters.adapter import StageAdapter, Stated, StatesAxis, Tick, Ticks, asked, check_range
from service.adapters.recording import StageRecording, excitation, write_recording
from service.answers.guard import Limits, limit_voltage
from service.protocol.errors import FieldError
from service.storage.output import atomic_write
from sim.signals.voltages import generalisation_input

#: Names of the files.
RECORDING, MODEL, CONFIGURATION, REPORT = FILES = ("recording.csv", "stage.npz", "serve.toml", "report.json")
#: First pulse, V, and factors by which pulses grow before and after motion is seen.
START_V: Final = 0.005
_GROWTH_UNSEEN, _GROWTH_SEEN = 2.0, 4.0
#: Standard errors that motion is seen by.
_SEEN: Final = 8.0
#: Shortest ramp and hold of a pulse, s; of a round; rest for the noise, s.
_PULSE_S, _STAIR_S, _NOISE_S = 0.25, 0.4, 1.0
#: Levels of the ramps with holds, as shares of the range; lengths of the other drives of a round, s.
_STAIRS: Final = (0.5, 1.0, 0.7, 0.3, 0.6, 0.1, 0.0)
_TRAIN_S, _SWEEP_S, _HELD_S = 20.0, 6.0, 16.0
#: The sweep: half its height as a share of the range, and its highest frequency as a share of the sample rate.
_SWEEP_SHARE, _SWEEP_TOP = 0.025, 0.3
#: Share of that frequency up to which its answer is looked at.
_SWEEP_SEEN: Final = 0.9
#: Bounds of the motion relative to the expected one, on a way of this share of the range that takes this long, s.
_FOLLOWS, _WAY_SHARE, _WAY_S = (0.25, 4.0), 0.1, 0.1
#: Share of the voltage at which the reading stops that is proposed as a limit.
_FREE: Final = 0.9
#: Largest distance from the line of the gain, as a share of the range, in a round; in a pulse, whose gain still grows.
_BAND, _PULSE_BAND = 0.4, 1.0
#: Smallest hysteresis of a piezo stage, as a share of its motion: less is that of a closed loop.
_LEAST_HYSTERESIS: Final = 0.003
#: Another unit is 1000 times smaller or larger: beyond the root of it the reading is nearer to that one.
_UNIT_RATIO: Final = math.sqrt(1000.0)
#: How a controller may spell µm.
_MICROMETRES: Final = ("", "um", "µm", "μm", "micrometer", "micrometre", "micron")
#: Share of late samples that is named, and least coherence and height of a mode's peak.
_LATE_SHARE, _COHERENT, _PEAK = 0.05, 0.8, 2.0


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
        self.watch: Callable[[float, float], None] = lambda u_V, y_um: None
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

    def play(self, u_V: FloatArray) -> Piece:
        """Apply (n,) voltages, one each sample time; times at which the loop is busy are waited for, none is left out.

        Raises StageFault, and AdapterError where the stage is gone.
        """
        begin = len(self.samples)
        for wanted_V in u_V.tolist():
            self._sample(next(self._clock), wanted_V)
        return self.piece(begin)

    def piece(self, begin: int) -> Piece:
        """The samples from the ``begin``-th on."""
        k, u_V, y_um, timely = zip(*self.samples[begin:], strict=True)
        return Piece(np.array(k), np.array(u_V), np.array(y_um), np.array(timely))

    def hold(self, done: Callable[[], bool]) -> None:
        """Keep the voltage and go on reading until ``done``."""
        for tick in self._clock:
            self._sample(tick, self.u_V)
            if done():
                return

    def _sample(self, tick: Tick, wanted_V: float) -> None:
        if reason := self._stopped():
            raise StageFault("stopped", f"stopped by {reason}")
        if time.perf_counter() > self._until_s:
            raise StageFault("time", "the time was over before a model was identified (--duration)")
        y_um = float(asked(self.adapter.read_um))
        self._blind = 0 if math.isfinite(y_um) else self._blind + 1
        if self._blind * self.dt_s > 2.0 * _PULSE_S:
            raise StageFault("no_reading", f"{self._blind} readings in a row are not numbers: look at the sensor")
        self.watch(self.u_V, y_um)
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
        self._band_um = max(band * abs(gain_um_per_V) * span_V, _SEEN * sigma_um)
        self._way_V = _WAY_SHARE * span_V
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
        far = abs(u_V - self._anchor[0]) >= self._way_V and abs(expected_um) > 2.0 * _SEEN * self._sigma_um
        if not far or self._steps * self._dt_s < _WAY_S:
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


class Probed(NamedTuple):
    """What the pulses show: noise of a reading, µm; gain, µm/V; hysteresis, share of the motion; reading at rest, µm.

    ``checked`` says by what sign and unit were checked.
    """

    noise_um: float
    gain_um_per_V: float
    hysteresis: float
    rest_um: float
    checked: str


def ramps(levels_V: list[float], dt_s: float, speed_V_per_s: float, least_s: float) -> tuple[FloatArray, list[slice]]:
    """(n,) voltages from the first level on by ramps and holds, and where the second half of each hold is.

    A ramp and a hold take ``least_s``, a ramp longer where the speed asks for it.
    """
    parts, settled, n = [], [], 0
    hold = max(8, math.ceil(least_s / dt_s))
    for a, b in pairwise(levels_V):
        steps = max(1, math.ceil(max(least_s, abs(b - a) / speed_V_per_s) / dt_s))
        parts += [np.linspace(a, b, steps + 1)[1:], np.full(hold, b)]
        n += steps + hold
        settled.append(slice(n - hold // 2, n))
    return np.concatenate(parts), settled


def _settled(piece: Piece, where: slice) -> FloatArray:
    """The readings of a hold, (m,) µm. Raises StageFault where there are too few."""
    y_um = piece.y_um[where]
    y_um = y_um[np.isfinite(y_um)]
    if y_um.size < 3:
        raise StageFault("no_reading", "too few readings in a hold are numbers: look at the sensor")
    return y_um


def _spread(y_um: FloatArray) -> float:
    t = np.arange(y_um.size)
    return float(np.std(y_um - np.polyval(np.polyfit(t, y_um, 1), t)) * math.sqrt(t.size / (t.size - 2)))


def expected_gain(order: Order, mover: Mover) -> tuple[float, str]:
    """(µm/V or NaN, who says so). Raises StageFault where the controller states a servo or another unit."""
    said = asked(mover.adapter.stated) if isinstance(mover.adapter, StatesAxis) else Stated(False, "", math.nan)
    if said.servo:
        raise StageFault("servo", "the controller says that its servo is on: switch it off, and begin anew")
    if said.unit.lower() not in _MICROMETRES:
        raise StageFault(
            "unit", f"the controller gives positions in {said.unit!r}, expected µm: set its unit, or give an adapter "
            "whose read_um is in µm",
        )  # fmt: skip
    if math.isfinite(order.gain_um_per_V):
        return order.gain_um_per_V, "--gain"
    low_V, high_V = check_range(mover.adapter)
    return said.travel / (high_V - low_V), "the controller's travel"


def _check_gain(gain: float, expected: float, by: str) -> str:
    """By what sign and unit are checked. Raises StageFault where they are others than expected."""
    if not math.isfinite(expected):
        return "nothing: the controller does not say, state --gain"
    ratio = abs(gain / expected)
    if not 1.0 / _UNIT_RATIO < ratio < _UNIT_RATIO:
        raise StageFault(
            "unit", f"the readings move by {gain:.3g} µm/V, expected about {expected:.3g} by {by}: are they in "
            f"{'nm' if ratio > 1.0 else 'mm'} in place of µm, or the voltages in another unit?",
        )  # fmt: skip
    if gain * expected < 0.0:
        raise StageFault(
            "sign", f"the readings move by {gain:.3g} µm/V, expected about {expected:.3g} by {by}: the sensor or the "
            "drive has the other sign; exchange its wires, or state --gain with this sign",
        )  # fmt: skip
    return by


def probe(mover: Mover, order: Order, say: Callable[[str], None]) -> Probed:
    """Pulses that grow to the ends of the limits. Raises StageFault with what is wrong."""
    expected, by = expected_gain(order, mover)
    limits, rest_V, dt_s = order.limits, mover.rest_V, mover.dt_s
    still = np.full(max(16, round(_NOISE_S / dt_s)), rest_V)
    y_um = _settled(mover.play(still), slice(0, still.size))
    sigma_um, rest_um = _spread(y_um), float(np.mean(y_um[y_um.size // 2 :]))
    say(f"at rest: {rest_V:g} V, {rest_um:.4g} µm, noise {1e3 * sigma_um:.3g} nm")
    # Where the stage goes for the first time it goes slowly.
    speed = min(0.5 * limits.slew_V_per_s, (limits.u_max_V - limits.u_min_V) * _WAY_SHARE / _WAY_S / 2.0)
    gain, hysteresis, checked, seen_V, largest_V = math.nan, 0.0, "", START_V, 0.0
    for room_V in sorted((limits.u_max_V - rest_V, limits.u_min_V - rest_V), key=abs, reverse=True):
        size_V = 0.0 if abs(room_V) < START_V else seen_V
        while size_V:
            size_V = min(size_V, abs(room_V))
            signed_V = math.copysign(size_V, room_V)
            if math.isfinite(gain):
                # A stage moves further for its voltage in larger strokes: the band is wide.
                mover.watch = Following(gain, (rest_V, rest_um), size_V, _PULSE_BAND, sigma_um, dt_s)
            levels_V = [rest_V + share * signed_V for share in (0.0, 0.5, 1.0, 0.5, 0.0)]
            wave, holds = ramps(levels_V, dt_s, speed, _PULSE_S)
            piece = mover.play(wave)
            up, top, down, end = (_settled(piece, hold) for hold in holds)
            moved_um = float(np.mean(top) - 0.5 * (rest_um + np.mean(end)))
            error_um = sigma_um * math.sqrt(1.5 / top.size)
            if abs(moved_um) > _SEEN * error_um and size_V > largest_V:
                if not math.isfinite(gain):
                    seen_V = size_V
                    checked = _check_gain(moved_um / signed_V, expected, by)
                    say(f"motion seen at {1e3 * size_V:.3g} mV: {moved_um / signed_V:.3g} µm/V; checked by {checked}")
                gain, largest_V = moved_um / signed_V, size_V
                hysteresis = float(np.mean(down) - np.mean(up)) / moved_um
            rest_um = float(np.mean(end))
            if size_V == abs(room_V):
                break
            size_V *= _GROWTH_SEEN if math.isfinite(gain) else _GROWTH_UNSEEN
    if not math.isfinite(gain):
        raise StageFault(
            "no_motion", f"the reading stays at {rest_um:.4g} µm up to {limits.u_min_V:g} and {limits.u_max_V:g} V: is "
            "the amplifier on, the servo off, and the sensor that of this axis?",
        )  # fmt: skip
    say(f"whole range: {gain:.4g} µm/V, hysteresis {100.0 * hysteresis:.3g} %")
    if abs(hysteresis) < _LEAST_HYSTERESIS:
        raise StageFault(
            "servo", f"hysteresis is {100.0 * hysteresis:.2g} %, less than a piezo stage has in open loop: a servo "
            "behind the voltage seems to be on; switch it off",
        )  # fmt: skip
    return Probed(sigma_um, gain, hysteresis, rest_um, checked)


def drives(rest_V: float, limits: Limits, dt_s: float) -> tuple[FloatArray, slice, int]:
    """(n,) voltages of one round from rest to rest, where its sweep is, and where its held-out stretch begins."""
    low_V, high_V = limits.u_min_V, limits.u_max_V
    span_V, speed = high_V - low_V, 0.5 * limits.slew_V_per_s
    top_hz = _SWEEP_TOP / dt_s
    height_V = min(_SWEEP_SHARE * span_V, speed / (2.0 * math.pi * top_hz))
    t = np.arange(round(_SWEEP_S / dt_s)) * dt_s
    sweep = low_V + 0.5 * span_V + height_V * np.sin(2.0 * np.pi * (0.5 * t + (top_hz - 0.5) / (2.0 * _SWEEP_S) * t**2))
    held = generalisation_input(10.0 / _HELD_S * dt_s, 10.0)[1]
    held = low_V + span_V * (held - held.min()) / np.ptp(held)
    wave = ramps([rest_V, *(low_V + share * span_V for share in _STAIRS)], dt_s, speed, _STAIR_S)[0]
    begins = []
    for part in (sweep, excitation(low_V, high_V, 1.0 / dt_s, _TRAIN_S), held, np.full(1, rest_V)):
        way = ramps([float(wave[-1]), float(part[0])], dt_s, speed, _STAIR_S)[0]
        begins.append(wave.size + way.size)
        wave = np.concatenate([wave, way, part])
    return wave, slice(begins[0], begins[0] + sweep.size), begins[2]


def response(piece: Piece, where: slice, dt_s: float) -> tuple[float | None, float | None]:
    """(lag of a reading behind its voltage, s; first mode, Hz) by the answer to a sweep; None where it is not seen."""
    k, u_V, y_um, timely = (values[where] for values in piece)
    good = timely & np.isfinite(y_um)
    if np.count_nonzero(good) < 0.5 * good.size:
        return None, None
    grid = np.arange(k[0], k[-1] + 1)
    window = np.hanning(grid.size)
    u, y = u_V[np.searchsorted(k, grid, "right") - 1], np.interp(grid, k[good], y_um[good])
    spectra = [np.fft.rfft((x - np.mean(x)) * window) for x in (u, y)]
    smooth = np.ones(9) / 9.0
    uu, yy, yu = (
        np.convolve(a * np.conj(b), smooth, "same")
        for a, b in ((spectra[0], spectra[0]), (spectra[1], spectra[1]), (spectra[1], spectra[0]))
    )
    hz = np.fft.rfftfreq(grid.size, dt_s)
    seen = (hz > 1.0) & (hz < _SWEEP_SEEN * _SWEEP_TOP / dt_s) & (np.abs(yu) ** 2 > _COHERENT * np.abs(uu) * np.abs(yy))
    if np.count_nonzero(seen) < 8:
        return None, None
    transfer, hz = (yu / uu)[seen], hz[seen]
    size = np.abs(transfer)
    peak = int(np.argmax(size))
    mode = size[peak] > _PEAK * float(np.median(size[: max(1, size.size // 4)])) and peak < size.size - 3
    below = slice(0, max(4, int(np.searchsorted(hz, 0.5 * hz[peak])))) if mode else slice(None)
    turn = np.unwrap(np.angle(transfer * np.sign(transfer[0].real)))[below]
    return -float(np.polyfit(hz[below], turn, 1)[0]) / (2.0 * math.pi), float(hz[peak]) if mode else None


class _Identification:
    """``dehyst identify`` in a process of its own, so that the stage is read meanwhile."""

    def __init__(self, recording: Path, model: Path, holdout: float, order: Order) -> None:
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "service.cli", "identify", str(recording), "--out", str(model), "--json",
                "--quiet", "--no-pictures", "--holdout", f"{holdout:.6f}", "--stage", order.stage, "--axis", order.axis,
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip

    def done(self) -> bool:
        return self._process.poll() is not None

    def summary(self) -> dict[str, Any]:
        """What it printed. Raises StageFault with its error."""
        printed, said = self._process.communicate()
        if self._process.returncode:
            raise StageFault("failed", f"identification: {said.strip()}")
        found: dict[str, Any] = json.loads(printed)
        return found

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


def commission(
    open_stage: Callable[[], StageAdapter], order: Order, out: Path, stopped: Callable[[], str] = str,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:  # fmt: skip
    """Commission a stage; returns the report, which is also ``report.json`` in the folder ``out``.

    ``out`` gets ``recording.csv``, and with a model ``stage.npz`` and ``serve.toml``. ``stopped`` : the reason to stop,
    "" for none. ``report["fault"]`` is None, or ``kind``, ``message`` and ``rest``, where the stage is now; without a
    fault ``report["in_the_way"]`` says what keeps the error above the target.

    Raises FieldError on limits that do not fit, before anything moves, and what ``open_stage`` raises.
    """
    begun = time.perf_counter()
    mover = Mover(open_stage, order.limits, stopped, begun + order.duration_s)
    report: dict[str, Any] = {"fault": None, "limits": order.limits.to_json(), "target_pct": order.target_pct}
    report["rest_V"] = mover.rest_V
    try:
        _commission(mover, order, out, begun, report, say)
    except BaseException as error:
        rest = mover.back()
        if not isinstance(error, DehystError | OSError):
            say(f"the stage is {rest}")
            raise
        kind = error.kind if isinstance(error, StageFault) else "failed"
        report["fault"] = {"kind": kind, "message": str(error), "rest": rest}
        if mover.samples and not (out / RECORDING).exists():
            _write(mover, 0, out / RECORDING)
    finally:
        mover.close()
    report["seconds"] = round(time.perf_counter() - begun, 1)
    with atomic_write(out / REPORT) as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())
    return report


def _commission(
    mover: Mover, order: Order, out: Path, begun: float, report: dict[str, Any], say: Callable[[str], None]
) -> None:
    """Fills the report. Raises StageFault, AdapterError and OSError; the stage is then anywhere within the limits."""
    found = probe(mover, order, say)
    report |= {name: getattr(found, name) for name in ("noise_um", "hysteresis", "checked")}
    first, rounds, done = len(mover.samples), 0, False
    while not done:
        round_s = time.perf_counter()
        try:
            report |= _round(mover, found, order, first, out, say)
        except StageFault as fault:
            if fault.kind != "time" or not rounds:
                raise
            say(f"the time is over; the stage is {mover.back()}")
            break
        rounds += 1
        say(f"round {rounds}: {report['error_pct']:.3g} % of the range on the held-out stretch ({report['model']})")
        now = time.perf_counter()
        # Another round brings neither less noise nor more time.
        noisy = report["noise_um"] > target_um(report)
        done = noisy or report["error_um"] <= target_um(report) or now - begun + now - round_s > order.duration_s
    report |= {"rounds": rounds, "in_the_way": in_the_way(report)}
    _write_configuration(out, order)


def _round(
    mover: Mover, found: Probed, order: Order, first: int, out: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Drive one round, identify from all samples from the ``first``-th on; what is known then. The files are renewed.

    Raises StageFault, AdapterError and OSError.
    """
    limits, dt_s = order.limits, mover.dt_s
    wave, sweep, held = drives(mover.rest_V, limits, dt_s)
    say(f"{wave.size * dt_s:.0f} s of ramps with holds, a decaying sine, a small sweep, and a stretch to judge by")
    rest, span_V = (mover.rest_V, found.rest_um), limits.u_max_V - limits.u_min_V
    mover.watch = Following(found.gain_um_per_V, rest, span_V, _BAND, found.noise_um, dt_s)
    piece = mover.play(wave)
    with tempfile.TemporaryDirectory(dir=out) as folder:
        path, model = Path(folder) / RECORDING, Path(folder) / MODEL
        recording = _write(mover, first, path)
        begin, last = mover.samples[first][0], int(piece.k[-1])
        worker = _Identification(path, model, (last - int(piece.k[held])) / (last - begin + 1), order)
        try:
            say("identifying; the stage rests meanwhile")
            mover.hold(worker.done)
            summary = worker.summary()
        finally:
            worker.end()
        for made in (path, model):
            made.replace(out / made.name)
    scores = {name: of["heldout"] for name, of in summary["models"].items() if of["heldout"]}
    best = min(scores, key=lambda name: float(scores[name]["rmse_pct"]))
    lag_s, mode_hz = response(piece, sweep, dt_s)
    return {
        "gain_um_per_V": summary["gain_um_per_V"], "range_um": summary["range_um"],
        "lag_s": lag_s, "mode_Hz": mode_hz, "swept_to_Hz": _SWEEP_SEEN * _SWEEP_TOP / dt_s,
        "model": best, "error_um": scores[best]["rmse_um"], "error_pct": scores[best]["rmse_pct"],
        "samples": recording.t_s.size, "late": recording.late, "drift_um": float(piece.y_um[-1] - found.rest_um),
    }  # fmt: skip


def target_um(report: dict[str, Any]) -> float:
    """The target, µm."""
    return float(0.01 * report["target_pct"] * report["range_um"])


def in_the_way(report: dict[str, Any]) -> list[str]:
    """What keeps the model from its stated target, in words; empty where nothing does."""
    wanted_um, found = target_um(report), []
    if report["noise_um"] > wanted_um:
        found.append(
            f"noise: a reading has {report['noise_um']:.3g} µm rms, more than the target, {wanted_um:.3g} µm: it "
            "cannot show whether the target is met; look at cables, sensor range and bandwidth"
        )
    if report["error_um"] <= wanted_um:
        return found
    if report["late"] > _LATE_SHARE * report["samples"]:
        found.append(f"{report['late']} readings came late: lower rate_Hz of the adapter, or the load of this machine")
    if abs(report["drift_um"]) > wanted_um:
        found.append(f"creep or drift: the reading at rest moved by {report['drift_um']:.3g} µm in a round")
    if report["mode_Hz"]:
        found.append(f"the mode at {report['mode_Hz']:.3g} Hz is excited: state a lower --slew")
    found.append("time: more rounds (--duration), or a larger --target")
    return found


def _write(mover: Mover, first: int, path: Path) -> StageRecording:
    """Write the samples from the ``first``-th on that were in time."""
    k, u_V, y_um, timely = mover.piece(first)
    t_s = (k - k[0]) * mover.dt_s
    late, worst_ms = int(k[-1] - k[0]) + 1 - int(timely.sum()), 1e3 * mover.ticks.worst_late_s
    recording = StageRecording(t_s[timely], u_V[timely], y_um[timely], late, worst_ms)
    write_recording(path, recording)
    return recording


def _write_configuration(out: Path, order: Order) -> None:
    limits = order.limits
    lines = [
        f'stage = "{order.stage}"', 'listen = ["tcp/127.0.0.1:7447"]', "", "[[axis]]", f'name = "{order.axis}"',
        f'model = "{MODEL}"', f"u_min_V = {limits.u_min_V}", f"u_max_V = {limits.u_max_V}",
        f"slew_V_per_s = {limits.slew_V_per_s}", "",
    ]  # fmt: skip
    with atomic_write(out / CONFIGURATION) as file:
        file.write("\n".join(lines).encode())
