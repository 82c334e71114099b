"""Slew limit: the actuator is a capacitor, so the amplifier's current limit I limits the voltage rate to I/C."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Kind, Parameter, Place, block, same_numbers
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess, single_guesses
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


@block
def run_slew_limit(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: largest change per sample, V. s: output, V."""
    for k in range(n):
        s[0] += min(max(x[k] - s[0], -p[0]), p[0])
        x[k] = s[0]


# Its form in a diagnosis.


@compiled
def slew_ends(u: FloatArray, step: float, straight: bool) -> FloatArray:
    """(n,) output of a rate limit of ``step`` volts per sample at the beginning of each sample; see `lag_ends`."""
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    for k in range(n):
        out[k] = s
        gap = u[min(k + 1, n - 1) if straight else k] - s
        s += min(max(gap, -step), step)
    return out


@dataclass(frozen=True)
class SlewLimit(CauseModel):
    """Rate limit of the voltage, V/s at the command."""

    unseen_is_absent: bool = True
    fast: bool = True
    substeps: int = 4
    continuous: bool = True

    def _fastest(self, data: FitData) -> float:
        return float(np.max(data.rate_V_per_s))

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        top = self._fastest(data)
        # An amplifier takes less than 0.2 s for the full swing.
        low = min(5.0 * data.swing_V, 0.5 * top)
        return (
            ModelParameter("slew_V_per_s", "V/s", 2.0 * top, low, 2.0 * top, 0.05 * data.swing_V / 1e-3, ActsOn.DRIVE),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        top = self._fastest(data)
        low = self.parameters(data)[0].low
        grid = data.swing_V / np.array([0.7e-3, 1.5e-3, 3e-3, 6e-3, 12e-3, 25e-3, 50e-3, 0.1])
        return single_guesses([float(v) for v in grid if low < v < top])

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return slew_ends(u_V, max(float(p[0]) * data.dt_s, 1e-12), data.straight)


# Its signature in the readings.

#: Exponent from which on the speed goes with the size: 0.76 and more without a limit, 0.9 and more in nine of ten.
_PROPORTIONAL = 0.9


def seen(readings: Readings) -> Sight:
    """The greatest speed of the readings over the size of a step, or over the speed that a motion asks for.

    Without a limit the two are proportional (exponent 1); behind a limit the speed stays at one value (exponent 0).
    """
    from scipy import stats  # a simulated stage does not wait for it

    data = readings.data
    sizes, speeds = _steps(readings)
    words = []
    judged: list[str] = []
    open_ = False
    for x, v, what in ((sizes, speeds, "steps"), (*_motions(readings), "motions")):
        if x.size < 3 or float(np.max(x)) < 1.6 * float(np.min(x)):
            continue
        judged.append(what)
        # The largest ones decide: small steps may stay below the limit.
        upper = x > 0.4 * float(np.max(x))
        if int(upper.sum()) < 3 or float(np.ptp(np.log(x[upper]))) < 0.3:
            upper = np.ones(x.size, dtype=np.bool_)
        lx, lv = np.log(x[upper]), np.log(v[upper])
        # The median of the slopes between pairs: a lost sample beside one step must not decide.
        slope = float(stats.theilslopes(lv, lx).slope)
        top = float(np.max(v)) / max(abs(data.gain_um_per_V), 1e-12)
        words.append(f"the greatest speed of {x.size} {what} ({top:.3g} V/s) goes with their size to the {slope:.2g}")
        if slope < 0.7:
            return Sight(True, words[-1])
        open_ = open_ or slope < _PROPORTIONAL
    if not words:
        return Sight(None, "no steps or fast motions of several sizes")
    if open_:
        # The largest steps may just have reached a limit.
        return Sight(None, "; ".join(words))
    if sizes.size and "steps" not in judged:
        # Steps ask for the greatest speed: what is slower says nothing about a limit above it.
        return Sight(None, f"{words[0]}; {sizes.size} faster steps do not differ enough in size")
    return Sight(False, "; ".join(words))


def _steps(readings: Readings) -> tuple[FloatArray, FloatArray]:
    """Sizes (V) of single steps between rests and the greatest speed (µm/s) after each."""
    data = readings.data
    moved = np.abs(np.diff(data.u_V, prepend=data.u_V[0]))
    near = max(2, round(0.005 / data.dt_s))
    after = max(8, round(0.02 / data.dt_s))
    width = max(1, round(1e-3 / data.dt_s))
    sizes, speeds = [], []
    for k in np.flatnonzero(moved > 0.05 * data.swing_V):
        if k < near or k + after >= data.n or not readings.mask[k - near : k + after].all():
            continue
        if float(moved[k - near : k].sum() + moved[k + 1 : k + after].sum()) > 1e-3 * data.swing_V:
            continue
        # A reading may come before its step by the recorder's clock.
        y = data.y_um[k - near : k + after]
        speed = np.abs(y[width:] - y[:-width]) / (width * data.dt_s)
        sizes.append(float(moved[k]))
        speeds.append(float(np.max(speed)))
    return np.array(sizes), np.array(speeds)


def _motions(readings: Readings) -> tuple[FloatArray, FloatArray]:
    """Speeds that the felt voltage asks for (V/s), in classes, and the typical greatest speeds (µm/s) reached there."""
    data = readings.data
    jumps = np.abs(np.diff(data.u_V, prepend=data.u_V[0])) > 0.02 * data.swing_V
    width = max(2, round(2e-3 / data.dt_s))
    # Around a jump the speed is that of the lag, whatever its size.
    away = np.convolve(jumps.astype(np.float64), np.ones(2 * round(0.05 / data.dt_s) + 1), "same") < 0.5
    asked = np.abs(readings.felt_V[width:] - readings.felt_V[:-width]) / (width * data.dt_s)
    got = np.abs(data.y_um[width:] - data.y_um[:-width]) / (width * data.dt_s)
    use = away[width:] & readings.mask[width:]
    asked, got = asked[use], got[use]
    if asked.size < 100:
        return np.empty(0), np.empty(0)
    top = float(np.quantile(asked, 0.999))
    slow = asked < 0.3 * top
    if int(slow.sum()) < 100 or min(float(np.ptp(asked[slow])), float(np.ptp(got[slow]))) == 0.0:
        # Nothing moves between the steps.
        return np.empty(0), np.empty(0)
    if float(np.corrcoef(asked[slow], got[slow])[0, 1]) < 0.97:
        # Where slow motions do not follow either, a mode moves the stage.
        return np.empty(0), np.empty(0)
    if top < 10.0 * data.swing_V:
        # Slower than a tenth of a second for the whole swing: no amplifier limits that.
        return np.empty(0), np.empty(0)
    edges = np.geomspace(0.15 * top, top, 7)
    x, v = [], []
    for a, b in itertools.pairwise(edges):
        inside = (asked >= a) & (asked < b)
        if int(inside.sum()) >= 20:
            x.append(float(np.sqrt(a * b)))
            v.append(float(np.median(got[inside])))
    return np.array(x), np.array(v)


SLEW_LIMIT = Kind(
    name="slew_limit",
    place=Place.SLEW,
    parameters=(Parameter("rate_V_per_s", "V/s", 10.0, 1e6, 2000.0, "largest rate, at the command's scale"),),
    derive=lambda values, context: (values["rate_V_per_s"] * context.dt_s,),
    rest=lambda values, context: (0.0,),
    block=run_slew_limit,
    signature="triangle-like output, only above a rate; straight ramps after steps",
    mistaken_for=("saturation", "amplifier_lag"),
    tells_apart="saturation depends on the level, a lag does not depend on the amplitude",
    source="about 20 V/ms at the actuator, that is 2 V/ms at the command of a tenfold amplifier (field knowledge)",
    cause=Cause(
        sign="the greatest speed does not grow with the step, or with the speed that is asked for",
        forms=(SlewLimit(),),
        tests=(seen,),
        in_library=same_numbers("slew_limit", rate_V_per_s="slew_V_per_s"),
        picture=pictures.after_steps,
    ),
)
