"""Additional hysteresis: plays on the voltage, with nonlocal memory, or a loop in the restoring force of a mode.

In the simulation ten plays (2.4) have thresholds up to ``largest_V`` with decreasing density. Their linear part is
subtracted, so the effect is the loop alone and cannot be confused with a gain. A loop in the restoring force is
`sim.effects.mechanics.MECHANICAL_HYSTERESIS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, Effect, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.effects.mechanics import MECHANICAL_HYSTERESIS
from dehyst.sim.effects.resonance import RESONANCE
from dehyst.sim.fitting.dynamics import ForceLoop, ForceStops, RestoringForce
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.hysteresis_loops import path_lag, plays_nested
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.cycles import loop_widths
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


SHAPE_PLAYS = 10
#: Number of odd powers of the voltage in `path_lag`. Even ones would take over an asymmetry.
PATH_POWERS = 3


@block
def run_hysteresis_shape(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: thresholds, weights. s: play outputs."""
    for k in range(n):
        u = v[k]
        for j in range(SHAPE_PLAYS):
            z = min(max(s[j], u - p[j]), u + p[j])
            s[j] = z
            x[k] += p[SHAPE_PLAYS + j] * (z - u)


def derive_hysteresis_shape(values: Mapping[str, float], context: Context) -> Sequence[float]:
    r = values["largest_V"] * (np.arange(SHAPE_PLAYS) + 0.5) / SHAPE_PLAYS
    raw = np.exp(-r / values["largest_V"] * values["fading"])
    # a stroke of four times the largest threshold and more opens a loop of height 2 sum(weight r)
    weight = values["width_um"] * raw / (2.0 * float(raw @ r))
    return [*r, *weight]


# Its form in a diagnosis.


@dataclass(frozen=True)
class HysteresisShape(CauseModel):
    """A sum of plays (2.7) beside the nominal hysteresis: any loop shape with nonlocal memory and minor loops.

    ``variant`` "restoring", for a nominal stage that is linear: stops of the displacement in the restoring force.
    Thresholds lie twice as dense as the chapter's (2.38) up to half the swing, beyond which only the first rise
    from rest could tell them apart. ``variant`` "fine": denser still; "slanted": with weights that go with the
    voltage as well; "local": beside plays, an operator that remembers the travelled path alone (`path_lag`).
    """

    test_answers_to_others: bool = True
    approximates: bool = True
    shared: tuple[str, ...] = ("weight_um_per_V",)
    #: Voltage (V) that the stage had been driven to and back before the recording; 0 where it was relaxed.
    before_V: float = 0.0

    def radii_V(self, data: FitData) -> FloatArray:
        top = max(abs(data.u_high_V), abs(data.u_low_V), data.swing_V)
        steps = np.concatenate([np.arange(1, 14), np.arange(15, 26, 2)])
        if self.variant in ("fine", "slanted", "local"):
            steps = np.concatenate([[0.5], np.arange(1.0, 13.1, 0.5), np.arange(15, 26, 2)])
        return np.asarray(steps / 26.0 * top)

    def missing(self, data: FitData) -> str:
        # A nominal stage with hysteresis explains a loop already: one in the mechanics would be the same cause.
        return "" if self.variant != "restoring" or data.input_is_linear else "a nominal stage without hysteresis"

    def restoring(self, p: FloatArray, data: FitData) -> RestoringForce | None:
        if self.variant != "restoring" or not np.any(p):
            return None
        return ForceStops(self.radii_um(data), np.ascontiguousarray(p))

    def radii_um(self, data: FitData) -> FloatArray:
        """Radii (µm) of the plays of the displacement, for the variant "restoring"."""
        return np.asarray(np.array([0.01, 0.02, 0.04, 0.08, 0.14, 0.22, 0.32, 0.45]) * data.range_um)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        if self.variant == "restoring":
            return tuple(
                ModelParameter(f"stop{j + 1}", "1", 0.0, -1.0, 4.0, 0.02, ActsOn.DYNAMICS)
                for j in range(self.radii_um(data).size)
            )
        g = data.range_um / max(data.swing_V, 1e-9)
        names = [f"w{j + 1}_um_per_V" for j in range(self.radii_V(data).size)]
        names += [f"x{j + 1}_um_per_V" for j in range(self.slanted_V(data).size)]
        plays = tuple(
            ModelParameter(name, "µm/V", 0.0, -0.5 * g, 0.5 * g, 0.02 * g, ActsOn.STATIC, True) for name in names
        )
        return plays + (self._path_parameters(data.range_um) if self.variant == "local" else ())

    def _path_parameters(self, r: float) -> tuple[ModelParameter, ...]:
        """The rate of `path_lag` per half swing, its start, and its weights, which all act through the rate."""
        low, usual, high = (math.log(rate) for rate in (0.3, 2.5, 20.0))
        return (
            ModelParameter("log_path_rate", "1", usual, low, high, 0.1, ActsOn.STATIC),
            ModelParameter("path_start_um", "µm", 0.0, -0.3 * r, 0.3 * r, 0.01 * r, ActsOn.STATIC),
            *(
                ModelParameter(f"path{2 * j + 1}_um", "µm", 0.0, -r, r, 0.01 * r, ActsOn.STATIC)
                for j in range(PATH_POWERS)
            ),
        )

    def slanted_V(self, data: FitData) -> FloatArray:
        """Radii (V) of the plays whose weight goes with the voltage: a density of relays need not be even (2.3)."""
        if self.variant != "slanted":
            return np.zeros(0)
        return np.asarray(np.array([0.0, 0.02, 0.05, 0.09, 0.15, 0.22, 0.3, 0.4]) * data.swing_V)

    def histories(self, data: FitData) -> list[CauseModel]:
        # Plays remember what happened before the recording: half of the range, or all of it.
        if self.variant:
            return []
        return [replace(self, before_V=share * data.u_high_V) for share in (0.5, 1.0)]

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        if left_floors <= 1.5 or self.variant not in ("", "fine"):
            return None
        finer = replace(self, variant="fine" if not self.variant else "local")
        start = np.array([s.neutral for s in finer.parameters(data)])
        if self.variant == "fine":
            start[: p.size] = p
        return finer, [start]

    def freer(self) -> CauseModel | None:
        return replace(self, variant="slanted") if self.variant in ("", "fine") else None

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        if self.variant == "restoring":
            return None
        radii_V = self.radii_V(data)
        u = u_V if self.before_V == 0.0 else np.concatenate([[self.before_V], u_V])
        out = plays_nested(u, radii_V, np.ascontiguousarray(p[: radii_V.size]))
        further = np.ascontiguousarray(p[radii_V.size :])
        if self.variant in ("slanted", "local") and np.any(further[self.variant == "local" :]):
            x = (u - 0.5 * (data.u_low_V + data.u_high_V)) / max(0.5 * data.swing_V, 1e-12)
            if self.variant == "slanted":
                out = out + x * plays_nested(u, self.slanted_V(data), further)
            else:
                out = out + path_lag(x, math.exp(float(further[0])), float(further[1]), further[2:])
        return np.asarray(out[-u_V.size :])

    def loop_um(self, u_V: FloatArray, added_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        """Each play lags behind its weight times the voltage, and the travelled path behind its goal."""
        count = self.radii_V(data).size
        x = (u_V - 0.5 * (data.u_low_V + data.u_high_V)) / max(0.5 * data.swing_V, 1e-12)
        goal_um = float(p[:count].sum()) * u_V
        if self.variant == "slanted":
            goal_um = goal_um + x * u_V * float(p[count:].sum())
        elif self.variant == "local":
            goal_um = goal_um + x * np.polynomial.polynomial.polyval(x * x, p[count + 2 :])
        return np.asarray(goal_um - added_um)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Height of the additional loop at mid-swing, and the sum of the play weights.

        Both branches of a play of radius r are 2 r apart there, but no further than what it moves by.
        """
        if self.variant == "restoring":
            stops = self.radii_um(data) / data.range_um
            return {"force_share": (float(stops @ p), stops), "stiffness_share": (float(p.sum()), np.ones(p.size))}
        row, whole = np.zeros(p.size), np.zeros(p.size)
        radii_V = self.radii_V(data)
        row[: radii_V.size] = 2.0 * np.clip(0.5 * data.swing_V - radii_V, 0.0, radii_V)
        whole[: radii_V.size] = 1.0
        return {"width_um": (float(row @ p), row), "weight_um_per_V": (float(whole @ p), whole)}


@dataclass(frozen=True)
class RestoringForceLoop(CauseModel):
    """(2.2) with the displacement in place of the voltage, as a force parallel to the spring of the nominal mode.

    It only applies to a nominal stage without hysteresis.
    """

    test_answers_to_others: bool = True
    takes_over: bool = True
    iterations: int = 40
    variant: str = "restoring_loop"

    def missing(self, data: FitData) -> str:
        return "" if data.input_is_linear else "a nominal stage without hysteresis"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        # A loop that never saturates is a spring; one that saturates at once is friction.
        return float(p[0]) > 0.02 and 0.1 < math.exp(float(p[1])) * data.range_um < 250.0

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        return (
            ModelParameter("share", "1", 0.0, 0.0, 30.0, 0.05, ActsOn.DYNAMICS),
            ModelParameter(
                "log_beta", "1", math.log(4.0 / r), math.log(0.05 / r), math.log(300.0 / r), 0.1, ActsOn.DYNAMICS
            ),
            ModelParameter("gamma_by_beta", "1", 0.0, -4.0, 0.95, 0.1, ActsOn.DYNAMICS),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return [[np.array([0.1, math.log(reach / data.range_um), 0.0])] for reach in (1.0, 4.0, 16.0, 60.0)]

    def joint_starts(self, nominal: FloatArray, names: tuple[str, ...], data: FitData) -> list[FloatArray]:
        """Joint start values: a linear calibration found the stiffness of spring and loop together."""
        if "log_f0" not in names:
            return []
        gain, f0 = names.index("gain_um_per_V"), names.index("log_f0")
        out = []
        for share in (0.3, 1.0, 3.0):
            for reach in (1.0, 4.0, 16.0, 60.0):
                # The wider the motion, the smaller the stiffness of the loop.
                felt = 1.0 + share * (0.9 if reach < 2.0 else 0.6)
                p = nominal.copy()
                p[gain] *= felt
                p[f0] -= 0.5 * math.log(felt)
                out.append(np.concatenate([p, [share, math.log(reach / data.range_um), 0.0]]))
        return out

    def restoring(self, p: FloatArray, data: FitData) -> RestoringForce | None:
        if p[0] == 0.0:
            return None
        beta = math.exp(float(p[1]))
        return ForceLoop(float(p[0]), beta * (1.0 + float(p[2])), beta * (1.0 - float(p[2])))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Stiffness relative to the spring, and both rates of the loop; gamma with the sign of (2.2)."""
        beta = math.exp(float(p[1]))
        share, own, gamma = np.zeros(3), np.zeros(3), np.zeros(3)
        share[0] = 1.0
        own[1] = beta
        gamma[1:] = beta * float(p[2]), beta
        return {
            "stiffness_share": (float(p[0]), share),
            "beta_per_um": (beta, own),
            "gamma_per_um": (beta * float(p[2]), gamma),
        }


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    if isinstance(form, RestoringForceLoop):
        numbers = {name: value for name, (value, _) in form.reported(p, data).items()}
        return InLibrary(changed=lambda e: _with_loop(e, numbers))
    width, swing = 0.05 * data.range_um, data.swing_V
    wide = HYSTERESIS_SHAPE.clipped("hysteresis_shape", width_um=width, largest_V=0.5 * swing, fading=1.0)
    narrow = HYSTERESIS_SHAPE.clipped("hysteresis_shape_2", width_um=0.2 * width, largest_V=0.15 * swing, fading=1.0)
    return InLibrary((wide, narrow), refit=True)


def _with_loop(e: Effect, numbers: dict[str, float]) -> Effect:
    """A mode of the nominal stage with this loop in its restoring force; any other effect unchanged."""
    if e.kind is not RESONANCE:
        return e
    mode = {name: e.values[name] for name in ("frequency_Hz", "damping_ratio")}
    return MECHANICAL_HYSTERESIS.clipped(e.label, **mode, **numbers)


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """Whether loops of several heights open at all: the shape of a loop can only be wrong where there is one."""
    found = readings.once(loop_widths)
    kinds: dict[int, list[tuple[float, float, float, float]]] = {}
    for one in found:
        kinds.setdefault(round(math.log(one[0]) / 0.3), []).append(one)
    if not kinds:
        return Sight(None, "no closed cycle")
    table = [
        (float(np.median([k[0] for k in same])), float(np.median([k[2] for k in same])), max(k[3] for k in same))
        for _, same in sorted(kinds.items())
    ]
    words = ", ".join(f"{100 * w:.3g} % at {h:.3g} V" for h, w, _ in table[-4:])
    open_ = any(abs(w) > 5.0 * e for _, w, e in table)
    if len(table) < 2:
        return Sight(None, f"loops of one height only: {words} wide")
    return Sight(open_, f"loops are {words} wide")


HYSTERESIS_SHAPE = Kind(
    name="hysteresis_shape",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter(
            "width_um",
            "µm",
            -100.0,
            100.0,
            3.0,
            "height of the additional loop for strokes of four times the largest threshold and more",
        ),
        Parameter("largest_V", "V", 0.05, 200.0, 2.0, "largest threshold"),
        Parameter("fading", "1", -2.0, 6.0, 1.0, "how much rarer large thresholds are than small ones"),
    ),
    derive=derive_hysteresis_shape,
    rest=lambda values, context: [0.0] * SHAPE_PLAYS,
    block=run_hysteresis_shape,
    signature="a loop that persists as the frequency goes to zero; odd harmonics; the residual repeats with the loop",
    mistaken_for=("asymmetry", "rate_dependence", "delay", "stick_slip"),
    tells_apart="the loop of a delay vanishes as the frequency goes to zero",
    source="loop height 2 % (small signal) to 10-15 % (full stroke) of the stroke, piezo actuator tutorials",
    cause=Cause(
        sign="loops of at least two heights open",
        forms=(HysteresisShape(), HysteresisShape(variant="restoring", iterations=40), RestoringForceLoop()),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.over_motion,
    ),
)
