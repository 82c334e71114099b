"""Saturation: the amplifier limits the voltage to its rails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, FoundInReadings, InLibrary, InReadings, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.masks import samples_since
from dehyst.sim.readings.noise import reading_limits
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


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
        cut_V = (data.u_high_V - float(p[0]), float(p[1]) - data.u_low_V)
        moved_V = np.diff(data.u_V, prepend=data.u_V[0])
        ends = ((data.u_V > p[0] - near_V, moved_V < 0.0), (data.u_V < p[1] + near_V, moved_V > 0.0))
        # A limit that cuts next to nothing off only rounds an end of the range.
        cutting = [end for end, cut in zip(ends, cut_V, strict=True) if cut >= 0.2 * max(cut_V)]
        # On the way towards an end the readings still catch up, so the way back counts alone, too.
        for rows in (rows for side, back in cutting for rows in (side, side & back)):
            u, y = data.u_V[rows], data.y_um[rows]
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
    """Flat tops: the slope of the readings over a voltage that moves away from an end of its range.

    On the way towards the end the readings still catch up with a lag. On the way back they stand still as long as the
    command is beyond the limit; a loop leaves four tenths of the usual slope and more there.
    """
    data = readings.data
    count = 40
    width_V = data.swing_V / count
    u, y = readings.felt_V, data.y_um
    du, dy = np.diff(u), np.diff(y)
    lag_s, moved = max(readings.lag_s, data.dt_s), np.diff(data.u_V)
    fast = data.rate_V_per_s[1:] * lag_s > 0.5 * width_V
    calm = samples_since(fast) * data.dt_s > max(10.0 * readings.lag_s, 0.02)
    slow = calm & (data.rate_V_per_s[1:] > 0.0) & (np.abs(du) > 1e-7 * data.swing_V) & readings.mask[1:]
    where = np.clip(((u[1:] - data.u_low_V) / max(width_V, 1e-12)).astype(int), 0, count - 1)
    ends, shown = list[str](), 0
    for end, toward, order in (("top", 1.0, np.arange(count)[::-1]), ("bottom", -1.0, np.arange(count))):
        # Just after a turn the readings still catch up.
        use = slow & (du * toward < 0.0) & (samples_since(moved * toward > 0.0) * data.dt_s > 5.0 * lag_s)
        travel = np.bincount(where[use], np.abs(du[use]), count)
        power = np.maximum(np.bincount(where[use], du[use] ** 2, count), 1e-300)
        slope = np.bincount(where[use], (du * dy)[use], count) / power
        off = (dy - slope[where] * du) * du
        error = np.sqrt(np.bincount(where[use], off[use] ** 2, count)) / power
        visited = travel > 0.5 * width_V
        usual = float(np.median(slope[visited])) if visited.any() else 0.0
        # Where the stage rings, its slope is not known.
        edge = [int(i) for i in order if visited[i] and error[i] < 0.1 * usual]
        # The voltage must move near this end, and over a good part of the range.
        if len(edge) < 10 or abs(edge[0] - order[0]) > 0.1 * count:
            continue
        # Further inside, a limit that is near the end would not show; and a mode that rings moves a flat top.
        outer = [slope[i] > 0.35 * usual for i in edge if abs(i - order[0]) < count // 4]
        shown += abs(edge[0] - order[0]) <= 1 and all(outer)
        flat = next((i for i, at in enumerate(edge) if abs(slope[at]) > 0.2 * usual), len(edge))
        if flat:
            limit = data.u_low_V + (edge[flat - 1] + (0.0 if end == "top" else 1.0)) * width_V
            ends.append(
                f"at the {end}, beyond about {limit:.3g} V, the readings move {slope[edge[0]] / usual:.2g} times as "
                "usual on the way back"
            )
    if ends:
        return Sight(True, "; ".join(ends))
    if shown < 2:
        # A limit at the other end is not excluded by this one.
        return Sight(None, "the voltage does not move slowly near both ends of its range")
    return Sight(False, "from the ends of the range on the readings follow the voltage")


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


def find_limits(data: FitData, residual_um: FloatArray, mask: BoolArray, sigma_um: float) -> FoundInReadings | None:
    """Readings that end at a limit of the sensor or its converter. They count in no fit."""
    low, high = reading_limits(data)
    found = {name: at for name, at in (("y_max_um", high), ("y_min_um", low)) if np.isfinite(at)}
    if not found:
        return None
    cut = (data.y_um <= low) | (data.y_um >= high)
    error = np.square(residual_um)
    share = float(error[cut].sum() / error[cut | mask].sum())
    words = f"the readings stand at one value at {' and at '.join(f'{at:.4g} µm' for at in found.values())}"
    return FoundInReadings(found, {name: (at, at) for name, at in found.items()}, share, words)


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
        in_readings=InReadings(find_limits, lambda parameters: ((), 0.0)),
    ),
)
