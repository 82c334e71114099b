"""The first motion of a stage: pulses that grow, and what sign, unit, servo and limits they show."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.adapters.adapter import Stated, StatesAxis, asked, check_range
from dehyst.service.commissioning.mover import SEEN, WAY_S, WAY_SHARE, Following, Mover, Order, Piece, StageFault

#: First pulse, V, and factors by which pulses grow before and after motion is seen.
START_V: Final = 0.005
_GROWTH_UNSEEN, _GROWTH_SEEN = 2.0, 4.0
#: Shortest ramp and hold of a pulse, s; rest for the noise, s.
_PULSE_S, _NOISE_S = 0.25, 1.0
#: Largest distance from the line of the gain, as a share of the motion: the gain still grows.
_BAND: Final = 1.0
#: Smallest hysteresis of a piezo stage, as a share of its motion: less is that of a closed loop.
_LEAST_HYSTERESIS: Final = 0.003
#: Another unit is 1000 times smaller or larger: beyond the root of it the reading is nearer to that one.
_UNIT_RATIO: Final = math.sqrt(1000.0)
#: How a controller may spell µm.
_MICROMETRES: Final = ("", "um", "µm", "μm", "micrometer", "micrometre", "micron")


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
    speed = min(0.5 * limits.slew_V_per_s, (limits.u_max_V - limits.u_min_V) * WAY_SHARE / WAY_S / 2.0)
    gain, hysteresis, checked, seen_V, largest_V = math.nan, 0.0, "", START_V, 0.0
    for room_V in sorted((limits.u_max_V - rest_V, limits.u_min_V - rest_V), key=abs, reverse=True):
        size_V = 0.0 if abs(room_V) < START_V else seen_V
        while size_V:
            size_V = min(size_V, abs(room_V))
            signed_V = math.copysign(size_V, room_V)
            levels_V = [rest_V + share * signed_V for share in (0.0, 0.5, 1.0, 0.5, 0.0)]
            wave, holds = ramps(levels_V, dt_s, speed, _PULSE_S)
            if math.isfinite(gain):
                # A stage moves further for its voltage in larger strokes: the band is wide.
                piece = mover.play(wave, Following(gain, (rest_V, rest_um), size_V, _BAND, sigma_um, dt_s))
            else:
                piece = mover.play(wave)
            up, top, down, end = (_settled(piece, hold) for hold in holds)
            moved_um = float(np.mean(top) - 0.5 * (rest_um + np.mean(end)))
            error_um = sigma_um * math.sqrt(1.5 / top.size)
            if abs(moved_um) > SEEN * error_um and size_V > largest_V:
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
