"""Saturation: the amplifier limits the voltage to its rails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptive.types import FloatArray
from sim import pictures
from sim.effects.base import Cause, InLibrary, Kind, Parameter, Place, block
from sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from sim.fitting.stage_model import CauseModel, Guess
from sim.readings.sight import Sight

if TYPE_CHECKING:
    from sim.readings.readings import Readings


# Its step in the simulation.


@block
def run_saturation(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: lowest, highest voltage, V."""
    for k in range(n):
        x[k] = min(max(x[k], p[0]), p[1])


# Its form in a diagnosis.


@dataclass(frozen=True)
class Saturation(CauseModel):
    """Saturation of the voltage at an upper and a lower limit."""

    unseen_is_absent: bool = True
    imitates_others: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        """Beyond the limit the readings hardly follow the command. Of a staircase with a single level there, the fit
        alone can tell."""
        beyond = (data.u_V > p[0]) | (data.u_V < p[1])
        if int(beyond.sum()) < 20:
            return False
        slopes = []
        # Of a staircase, a single level may lie beyond the limit: the nearest one below it counts as well.
        near_V = 0.01 * data.swing_V
        for side in (data.u_V > p[0] - near_V, data.u_V < p[1] + near_V):
            u, y = data.u_V[side], data.y_um[side]
            if u.size >= 20 and float(np.ptp(u)) > 0.005 * data.swing_V:
                u = u - u.mean()
                slopes.append(abs(float(u @ y) / float(u @ u)))
        return not slopes or min(slopes) < 0.35 * abs(data.gain_um_per_V)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        low, high, swing = data.u_low_V, data.u_high_V, data.swing_V
        return (
            ModelParameter("u_max_V", "V", high, low + 0.5 * swing, high, 0.02 * swing, ActsOn.DRIVE),
            ModelParameter("u_min_V", "V", low, low, high - 0.5 * swing, 0.02 * swing, ActsOn.DRIVE),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        low, high, swing = data.u_low_V, data.u_high_V, data.swing_V
        tops = [[np.array([high - f * swing, low])] for f in (0.01, 0.03, 0.08, 0.16, 0.3)]
        return tops + [[np.array([high, low + f * swing])] for f in (0.01, 0.03, 0.08, 0.16)]

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return np.clip(u_V, p[1], p[0])


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    low_V = min(v["u_min_V"], 0.0) - 1e-3 * data.swing_V
    return InLibrary((SATURATION.clipped(high_V=v["u_max_V"], low_V=low_V),))


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """Flat tops: the slope of the readings over a voltage that moves, near the ends of its range."""
    data = readings.data
    u, y = readings.felt_V, data.y_um
    du, dy = np.diff(u), np.diff(y)
    slow = (np.abs(du) < 0.02 * data.swing_V) & (np.abs(du) > 1e-7 * data.swing_V) & readings.mask[1:]
    # After a step the felt voltage creeps on, and what the readings do there is the lag's.
    slow &= (data.rate_V_per_s[1:] > 0.0) & (np.abs(np.diff(data.u_V)) < 0.02 * data.swing_V)
    count = 40
    where = np.clip(((u[1:] - data.u_low_V) / max(data.swing_V, 1e-12) * count).astype(int), 0, count - 1)
    power = np.bincount(where[slow], du[slow] ** 2, count)
    travel = np.bincount(where[slow], np.abs(du[slow]), count)
    slope = np.bincount(where[slow], (du * dy)[slow], count) / np.maximum(power, 1e-300)
    visited = travel > 1.0 * data.swing_V / count
    if int(visited.sum()) < 10:
        return Sight(None, "the voltage moves too little")
    usual = float(np.median(slope[visited]))
    ends = []
    shown = 0
    for order, end in ((np.arange(count)[::-1], "top"), (np.arange(count), "bottom")):
        edge = [int(i) for i in order if visited[i]]
        outermost = data.u_high_V if end == "top" else data.u_low_V
        at = data.u_low_V + (edge[0] + 0.5) / count * data.swing_V
        if abs(at - outermost) > 0.1 * data.swing_V:
            continue
        shown += 1
        flat = 0
        while flat < len(edge) and slope[edge[flat]] < 0.3 * usual:
            flat += 1
        # Where the voltage reaches the limit at any speed, the slope falls over several bins.
        if flat and np.max(slope[edge[flat + 1 : flat + 7]], initial=0.0) > 0.5 * usual:
            limit = data.u_low_V + (edge[flat] + (1.0 if end == "top" else 0.0)) / count * data.swing_V
            ends.append(
                f"at the {end}, beyond {limit:.3g} V, the readings move {slope[edge[0]] / usual:.2g} times as usual"
            )
    if ends:
        return Sight(True, "; ".join(ends))
    if not shown:
        return Sight(None, "the voltage does not move near the ends of its range")
    return Sight(False, "up to the ends of the range the readings follow the voltage")


def in_steps(readings: Readings) -> Sight:
    """Steps between rests near an end of the range that hardly move the readings. A loop leaves half of a step and
    more."""
    data, rests = readings.data, readings.rests
    u = np.array([r.level_V for r in rests])
    y = np.array([float(np.mean(data.y_um[r.first : r.last])) for r in rests])
    far = np.abs(np.diff(u)) > 0.03 * data.swing_V
    if int(far.sum()) < 6:
        return Sight(None, "fewer than six steps between rests")
    slope = np.diff(y)[far] / np.diff(u)[far]
    slope /= float(np.median(slope))
    low, high = np.minimum(u[1:], u[:-1])[far], np.maximum(u[1:], u[:-1])[far]
    for at_end, words in (
        (low > data.u_low_V + 0.75 * data.swing_V, "top"),
        (high < data.u_low_V + 0.25 * data.swing_V, "bottom"),
    ):
        flat = at_end & (slope < 0.15)
        if int(flat.sum()) >= 2:
            share = float(np.max(np.abs(slope[flat])))
            return Sight(True, f"{int(flat.sum())} steps near the {words} move the readings {share:.2g} times as usual")
    return Sight(None, "no step near the ends of the range is much smaller than the others")


SATURATION = Kind(
    name="saturation",
    place=Place.RAILS,
    parameters=(
        Parameter("low_V", "V", -1000.0, 0.0, -3.0, "lower rail, at the command's scale"),
        Parameter("high_V", "V", 0.1, 1000.0, 12.0, "upper rail, at the command's scale"),
    ),
    derive=lambda values, context: (values["low_V"], values["high_V"]),
    block=run_saturation,
    signature="flat tops at the same voltage at every rate",
    mistaken_for=("slew_limit",),
    tells_apart="a sensor that ends is told apart by a monitor of the voltage",
    source="-30 to 130 V at the actuator behind a tenfold amplifier (E-503 class data sheet range)",
    cause=Cause(
        sign="flat tops of the readings while the voltage moves; or steps near an end that hardly move them",
        forms=(Saturation(),),
        tests=(seen, in_steps),
        in_library=in_library,
        picture=pictures.over_voltage,
    ),
)
