"""Creep: after a step the displacement continues to grow with the logarithm of time.

In the simulation it is a sum of first-order lags, two per decade from 0.1 to 1000 s, each with half the gain per
decade. Within that span it equals ``y0 (1 + g log10(t/t0))`` with a ripple below 3 % of the creep. Each lag is stepped
in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, Kind, Parameter, Place, block, same_numbers
from dehyst.sim.effects.holds import first_order
from dehyst.sim.fitting.fit_data import ActsOn, FitData, LastResultCache, ModelParameter
from dehyst.sim.fitting.lags import slow_poles
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.sight import Sight
from dehyst.sim.readings.slow_motion import cycles_over_time, rests_over_time

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.

#: Time constants relative to the shortest: two per decade over four decades.
CREEP_RATIOS = 10.0 ** (np.arange(9) / 2.0)
CREEP_POLES = len(CREEP_RATIOS)


@block
def run_creep(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain of a pole, then (a, b0, b1) of each. s: slow parts, input so far, µm."""
    for k in range(n):
        now, total = x[k], 0.0
        for j in range(CREEP_POLES):
            s[j] = p[1 + 3 * j] * s[j] + p[2 + 3 * j] * s[CREEP_POLES] + p[3 + 3 * j] * now
            total += s[j]
        s[CREEP_POLES] = now
        x[k] = now + p[0] * total


def derive_creep(values: Mapping[str, float], context: Context) -> Sequence[float]:
    p = [values["gain_per_decade"] / 2.0]
    for ratio in CREEP_RATIOS:
        p.extend(first_order(values["t0_s"] * float(ratio), context.dt_s, context.hold_per_s))
    return p


# Its form in a diagnosis.

_POLES = LastResultCache()


@dataclass(frozen=True)
class Creep(CauseModel):
    """A sum of slow first-order lags, 0.05 s to beyond the record, 0.6 decades apart.

    Equal weights give log t; a line of weights over log tau is close to a power of t. With a weight of its own a fast
    lag would stand for a lag of the stage or for a part of the loop.
    """

    unseen_is_absent: bool = True
    imitates_others: bool = True
    model_error: float = 0.04
    spacing: float = 0.6  # decades between the poles

    def weights(self, p: FloatArray, data: FitData) -> FloatArray:
        """(m,) weight of each lag."""
        return np.asarray(p[0] + p[1] * np.linspace(-1.0, 1.0, self.taus_s(data).size))

    def taus_s(self, data: FitData) -> FloatArray:
        top = data.slowest_s
        count = max(2, int(np.floor(np.log10(top / 0.05) / self.spacing)) + 1)
        return np.asarray(0.05 * 10.0 ** (self.spacing * np.arange(count)), dtype=np.float64)

    def missing(self, data: FitData) -> str:
        return "" if data.duration_s > 1.0 else "a record longer than a second"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        all_rise = float(np.min(self.weights(p, data))) >= -1e-3 * float(p[0])
        return all_rise and 5e-4 <= self.reported(p, data)["gain_per_decade"][0] <= 0.08

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        # Creep goes on from a step just before the recording, and from motion long before it.
        long_um = 0.0 if data.begins_at_rest else r
        return (
            ModelParameter("weight", "1", 0.0, 0.0, 0.1, 0.005, ActsOn.MOTION, True),
            ModelParameter("weight_tilt", "1", 0.0, -0.1, 0.1, 0.005, ActsOn.MOTION, True),
            ModelParameter("start_um", "µm", 0.0, -r, r, 0.05 * r, ActsOn.MOTION),
            ModelParameter("before_um", "µm", 0.0, -long_um, long_um, 0.05 * r, ActsOn.MOTION),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return [trial[:2] for trial in super().guesses(data, residual_um)]

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        taus = self.taus_s(data)
        weights, starts = self.weights(p, data), p[2:]
        if not np.any(weights):
            return x_um
        rates = data.dt_s / taus
        poles = _POLES.get(x_um, rates.tobytes(), lambda: np.asarray(slow_poles(x_um, rates)))
        out = x_um + weights @ poles
        if np.any(starts):
            # A step a third of the record's length before it has left only its slow part.
            ages_s = np.array([0.0, data.duration_s / 3.0])
            out += (weights * (starts @ np.exp(-ages_s[:, None] / taus))) @ _steps(data, taus)
        return np.asarray(out)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        # Slope of the step response over log10 t, from 0.1 s to half the record.
        taus = self.taus_s(data)
        t = np.logspace(-1.0, np.log10(max(data.slowest_s / 6.0, 0.3)), 60)
        rise = 1.0 - np.exp(-t[None, :] / taus[:, None])
        x = np.log10(t) - np.log10(t).mean()
        each = rise @ x / float(x @ x)
        row = np.array([each.sum(), each @ np.linspace(-1.0, 1.0, taus.size), *np.zeros(p.size - 2)])
        return {"gain_per_decade": (float(row @ p), row)}


def _steps(data: FitData, taus_s: FloatArray) -> FloatArray:
    """(m, n) response of each slow lag to a unit step at the first sample."""
    return data.derived(("step responses", taus_s.size), lambda: 1.0 - np.exp(-data.t_s[None, :] / taus_s[:, None]))


# Its signature in the readings.


def in_rests(readings: Readings) -> Sight:
    """Motion after each step in proportion to it and with the logarithm of time."""
    found = readings.once(rests_over_time)
    if found.missing:
        return Sight(None, found.missing)
    if found.creep is None:
        return Sight(None, "no rest follows a move of a tenth of the swing")
    g, e = found.creep.value, found.creep.error
    words = f"the rests rise by {100 * g:.2g} ± {196 * e:.1g} % of the step before them per decade of time"
    return Sight(found.creep.seen(g, 4e-4, 4e-3), words)


def in_cycles(readings: Readings) -> Sight:
    """The mean of equal cycles goes with the logarithm of time. Where a drift may do the same, both are one set."""
    found = readings.once(cycles_over_time)
    if found.missing:
        return Sight(None, found.missing)
    either = found.moved is True and not (found.creeps or found.goes_on)
    return Sight(True if found.creeps or either else None, found.mean_words, ("thermal_drift",) if either else ())


CREEP = Kind(
    name="creep",
    place=Place.CREEP,
    parameters=(
        Parameter("gain_per_decade", "1", -0.02, 0.1, 0.015, "growth per decade of time, relative to the step"),
        Parameter("t0_s", "s", 0.005, 1.0, 0.1, "shortest time constant; the longest is ten thousand times that"),
    ),
    derive=derive_creep,
    rest=lambda values, context: [0.0] * (CREEP_POLES + 1),
    block=run_creep,
    signature="holds rise linearly in log t, in proportion to the last step and with its sign",
    mistaken_for=("thermal_drift", "gain_drift"),
    tells_apart="thermal drift does not follow the steps",
    source="0.01 to 0.02 per decade, t0 = 0.1 s (piezo manufacturers' tutorials)",
    cause=Cause(
        sign="after each step the rests go on, in proportion to the step and with the logarithm of time; or the mean "
        "of equal cycles does",
        forms=(Creep(),),
        tests=(in_rests, in_cycles),
        in_library=same_numbers("creep", refit=True, gain_per_decade="gain_per_decade"),
        picture=pictures.over_log_time,
    ),
)
