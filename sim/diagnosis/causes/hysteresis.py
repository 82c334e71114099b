"""Causes in the hysteresis: hysteresis_shape, asymmetry, rate_dependence."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import ForceLoop, ForceStops, RestoringForce
from sim.diagnosis.model.fit_data import ActsOn, FitData, ModelParameter
from sim.diagnosis.model.hysteresis_loops import asymmetric, bouc_wen_paced, filtered_rate, grown_plays, plays_nested
from sim.diagnosis.model.nominal import loop_numbers
from sim.diagnosis.model.stage_model import CauseModel, Guess

#: Knees of the dead zones of the displacement and of a wide play: distance from the middle over half the stroke.
_NEAR = np.array([-0.6, -0.2, 0.2, 0.6])
_WIDE = np.array([-0.4, 0.0, 0.4])


@dataclass(frozen=True)
class HysteresisShape(CauseModel):
    """A sum of plays (2.7) beside the nominal hysteresis: any loop shape with nonlocal memory and minor loops.

    ``variant`` "restoring", for a nominal stage that is linear: stops of the displacement in the restoring force.
    Thresholds lie twice as dense as the chapter's (2.38) up to half the swing, beyond which only the first rise
    from rest could tell them apart. ``variant`` "fine": denser still; "slanted": with weights that go with the
    voltage as well.
    """

    name: str = "hysteresis_shape"
    test_answers_to_others: bool = True
    #: Voltage (V) that the stage had been driven to and back before the recording; 0 where it was relaxed.
    before_V: float = 0.0

    def radii_V(self, data: FitData) -> FloatArray:
        top = max(abs(data.u_high_V), abs(data.u_low_V), data.swing_V)
        steps = np.concatenate([np.arange(1, 14), np.arange(15, 26, 2)])
        if self.variant in ("fine", "slanted"):
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
        return tuple(
            ModelParameter(name, "µm/V", 0.0, -0.5 * g, 0.5 * g, 0.02 * g, ActsOn.STATIC, True) for name in names
        )

    def slanted_V(self, data: FitData) -> FloatArray:
        """Radii (V) of the plays whose weight goes with the voltage: a density of relays need not be even (2.3)."""
        if self.variant != "slanted":
            return np.zeros(0)
        return np.asarray(np.array([0.0, 0.02, 0.05, 0.09, 0.15, 0.22, 0.3, 0.4]) * data.swing_V)

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        if self.variant == "restoring":
            return None
        radii_V = self.radii_V(data)
        u = u_V if self.before_V == 0.0 else np.concatenate([[self.before_V], u_V])
        out = plays_nested(u, radii_V, np.ascontiguousarray(p[: radii_V.size]))
        if np.any(p[radii_V.size :]):
            x = (u - 0.5 * (data.u_low_V + data.u_high_V)) / max(0.5 * data.swing_V, 1e-12)
            out = out + x * plays_nested(u, self.slanted_V(data), np.ascontiguousarray(p[radii_V.size :]))
        return np.asarray(out[-u_V.size :])

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
class Asymmetry(CauseModel):
    """Branches that are not point-symmetric.

    One-sided dead zones (2.8), on the static displacement and on a wide play of the voltage, which between them
    stand for dead zones on plays of any width; and products of loop and displacement (generalised Bouc-Wen).
    """

    name: str = "asymmetry"
    test_answers_to_others: bool = True
    unseen_is_absent: bool = True
    model_error: float = 0.12

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 1e-5 <= abs(self.reported(p, data)["bend"][0]) + 0.02 * float(np.max(np.abs(p[7:]))) <= 0.1

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        near = tuple(
            ModelParameter(f"dead_zone{j}", "1", 0.0, -0.2, 0.2, 0.01, ActsOn.STATIC, True) for j in (1, 2, 3, 4)
        )
        wide = tuple(
            ModelParameter(f"wide_dead_zone{j}", "1", 0.0, -0.2, 0.2, 0.01, ActsOn.STATIC, True) for j in (1, 2, 3)
        )
        loop = tuple(
            ModelParameter(name, "1", 0.0, -4.0, 4.0, 0.05, ActsOn.STATIC, True) for name in ("branch", "width")
        )
        return (*near, *wide, *loop)

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        low = float(np.min(w_um)) if data.fitted_low_um is None else data.fitted_low_um
        loop = float(np.max(np.abs(h_um))) if data.fitted_loop_um is None else data.fitted_loop_um
        x_scale = np.array([low, 0.5 * data.range_um])
        z_scale = np.array([0.15 * data.swing_V, data.u_low_V, 0.5 * data.swing_V])
        q = np.ascontiguousarray(p)
        return np.asarray(asymmetric(u_V, h_um, w_um, q, _NEAR, _WIDE, x_scale, z_scale, max(loop, 1e-12)))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """The bend over the whole stroke and the weights of both products."""
        row = np.zeros(p.size)
        row[:4] = 0.5 * (1.0 - _NEAR) / 2.0
        row[4:7] = 0.5 * (1.0 - _WIDE) / 2.0
        one, two = np.zeros(p.size), np.zeros(p.size)
        one[7], two[8] = 1.0, 1.0
        return {"bend": (float(row @ p), row), "branch": (float(p[7]), one), "width": (float(p[8]), two)}


@dataclass(frozen=True)
class RateDependence(CauseModel):
    """A loop that widens with log10(1 + rate/v0).

    ``variant`` "width": the loop's width follows the rate at once, and its driving term does; "thresholds" and
    "added": plays whose thresholds grow by a share, or by as many volts, less the same plays at rest.
    """

    name: str = "rate_dependence"
    test_answers_to_others: bool = True
    model_error: float = 0.3
    variant: str = "width"
    #: Time constant of the lag that filters the rate, s; with ``free_rate_lag`` the start value of its fit.
    rate_lag_s: float = 0.004
    free_rate_lag: bool = False

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 0.003 <= self.reported(p, data)["growth_per_decade"][0] <= 0.6

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        v = data.swing_V
        pace = ModelParameter(
            "log_v0", "1", float(np.log(v)), float(np.log(0.05 * v)), float(np.log(300.0 * v)), 0.5, ActsOn.STATIC
        )
        if self.variant != "width":
            g = data.range_um / max(v, 1e-9)
            w = tuple(
                ModelParameter(f"weight{j}_um_per_V", "µm/V", 0.0, -g, g, 0.1 * g, ActsOn.STATIC) for j in (1, 2, 3)
            )
            return (*w, pace)
        own = (
            ModelParameter("width_per_decade", "1", 0.0, -1.0, 1.0, 0.02, ActsOn.STATIC),
            ModelParameter("slope_per_decade", "1", 0.0, -1.0, 1.0, 0.02, ActsOn.STATIC),
            pace,
        )
        felt = ModelParameter(
            "log_felt_s", "1", float(np.log(self.rate_lag_s)), float(np.log(2e-4)), 0.0, 0.2, ActsOn.STATIC
        )
        return (*own, felt) if self.free_rate_lag else own

    def _paced(self, p: FloatArray) -> tuple[float, float]:
        """Rate above which the loop grows (V/s), and the time constant of the rate filter (s)."""
        if self.free_rate_lag:
            return float(np.exp(p[-2])), float(np.exp(p[-1]))
        return float(np.exp(p[-1])), self.rate_lag_s

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        parameters = self.parameters(data)
        out = []
        for f in (0.2, 2.0, 20.0, 200.0):
            rows = []
            for i in range(len(parameters) - 1):
                row = np.zeros(len(parameters))
                row[-1] = np.log(f * data.swing_V)
                row[i] = parameters[i].step
                rows.append(row)
            out.append(rows)
        return out

    def _growth(self, data: FitData) -> tuple[FloatArray, float, float]:
        """Thresholds at rest (V), and their growth per decade as a factor and in V."""
        if self.variant == "added":
            return np.array([0.0, 0.1, 0.3]) * data.swing_V, 0.0, 0.01 * data.swing_V
        return np.array([0.06, 0.18, 0.36]) * data.swing_V, 0.05, 0.0

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        if not np.any(p[: 2 if self.variant == "width" else 3]):
            return None
        corner_V_per_s, rate_lag_s = self._paced(p)
        rate = filtered_rate(u_V, float(np.exp(-data.dt_s / rate_lag_s)) if rate_lag_s > 0.0 else 0.0, data.dt_s)
        pace = np.log10(1.0 + rate / corner_V_per_s)
        if self.variant != "width":
            radii, factor, added = self._growth(data)
            return np.asarray(grown_plays(u_V, radii, np.ascontiguousarray(p[:3]), 1.0 + factor * pace, added * pace))
        out = -p[0] * h_um * pace
        if p[1] != 0.0 and data.nominal_kind == "bouc_wen":
            slope, beta, gamma = loop_numbers(nominal)
            # The loop diverges if the driving term changes its sign.
            pace = np.maximum(pace, -0.9 / p[1]) if p[1] > 0.0 else np.minimum(pace, -0.9 / p[1])
            out -= bouc_wen_paced(u_V, slope, beta, gamma, float(h_um[0]), pace, float(p[1])) - h_um
        return np.asarray(out)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        v0, _ = self._paced(p)
        row, corner = np.zeros(p.size), np.zeros(p.size)
        corner[-2 if self.free_rate_lag else -1] = v0
        if self.variant != "width":
            # Growth of the loop height relative to the stroke.
            radii, factor, added = self._growth(data)
            row[:3] = 2.0 * (factor * radii + added) / data.range_um
        else:
            row[:2] = 1.0
        return {"growth_per_decade": (float(row @ p), row), "corner_V_per_s": (v0, corner)}


@dataclass(frozen=True)
class RestoringForceLoop(CauseModel):
    """(2.2) with the displacement in place of the voltage, as a force parallel to the spring of the nominal mode.

    It only applies to a nominal stage without hysteresis.
    """

    name: str = "hysteresis_shape"
    test_answers_to_others: bool = True
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


#: Remaining error, in noise floors, above which a finer model is fitted.
_LEFT = {"hysteresis_shape": 1.5, "rate_dependence": 1.2}


def refined_model(
    cause: CauseModel, p: FloatArray, left_floors: float, data: FitData
) -> tuple[CauseModel, list[FloatArray]] | None:
    """A model of the same cause with more parameters and its start values; None if there is none or none is needed.

    An error that a coarse model leaves must not be taken for another cause. ``p`` are the fitted parameters of
    ``cause``; ``left_floors`` is the remaining error in noise floors.
    """
    if left_floors <= _LEFT.get(cause.name, np.inf):
        return None
    if isinstance(cause, HysteresisShape) and not cause.variant:
        fine = replace(cause, variant="fine")
        return fine, [np.zeros(len(fine.parameters(data)))]
    if isinstance(cause, RateDependence) and not cause.free_rate_lag:
        free = replace(cause, variant="width", free_rate_lag=True)
        width, slope, pace = p if cause.variant == "width" else (0.02, 0.0, float(np.log(2.0 * data.swing_V)))
        return free, [np.array([width, slope, pace, np.log(rate_lag_s)]) for rate_lag_s in (0.004, 0.02)]
    return None
