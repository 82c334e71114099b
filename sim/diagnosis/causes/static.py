"""Causes in the loop itself: hysteresis_shape, asymmetry, rate_dependence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.forms import Form, Trial
from sim.diagnosis.model.loops import asymmetric, bouc_wen_paced, felt_rate, grown_plays, plays_nested
from sim.diagnosis.model.measured import At, Setting, Slot
from sim.diagnosis.model.nominal import loop_numbers
from sim.diagnosis.model.restoring_force import Restoring, Stops

#: Knees of the dead zones: of the displacement, and of a wide play, over half the stroke from its middle.
_NEAR = np.array([-0.6, -0.2, 0.2, 0.6])
_WIDE = np.array([-0.4, 0.0, 0.4])


@dataclass(frozen=True)
class HysteresisShape(Form):
    """A sum of plays (2.7) beside the nominal loop: any loop shape with nonlocal memory and minor loops.

    ``variant`` "restoring", for a nominal stage that is linear: stops of the displacement in the restoring force.
    Thresholds lie twice as dense as the chapter's (2.38) up to half the swing, beyond which only the first rise
    from rest could tell them apart.
    """

    name: str = "hysteresis_shape"

    def radii_V(self, setting: Setting) -> FloatArray:
        top = max(abs(setting.u_high_V), abs(setting.u_low_V), setting.swing_V)
        steps = np.concatenate([np.arange(1, 14), np.arange(15, 26, 2)])
        if self.variant == "fine":
            steps = np.concatenate([[0.5], np.arange(1.0, 13.1, 0.5), np.arange(15, 26, 2)])
        return np.asarray(steps / 26.0 * top)

    def applies(self, setting: Setting) -> str:
        # Beside a loop at the input, one more in the force of the mechanics would be no other cause.
        return "" if self.variant != "restoring" or setting.input_is_linear else "a nominal stage without hysteresis"

    def restoring(self, p: FloatArray, setting: Setting) -> Restoring | None:
        if self.variant != "restoring" or not np.any(p):
            return None
        return Stops(self.radii_um(setting), np.ascontiguousarray(p))

    def radii_um(self, setting: Setting) -> FloatArray:
        """Radii of the plays of the displacement itself, of the variant ``restoring``."""
        return np.asarray(np.array([0.01, 0.02, 0.04, 0.08, 0.14, 0.22, 0.32, 0.45]) * setting.range_um)

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        if self.variant == "restoring":
            return tuple(
                Slot(f"stop{j + 1}", "1", 0.0, -1.0, 4.0, 0.02, At.DYNAMICS) for j in range(self.radii_um(setting).size)
            )
        g = setting.range_um / max(setting.swing_V, 1e-9)
        return tuple(
            Slot(f"w{j + 1}_um_per_V", "µm/V", 0.0, -0.5 * g, 0.5 * g, 0.02 * g, At.STATIC, True)
            for j in range(self.radii_V(setting).size)
        )

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, setting: Setting
    ) -> FloatArray | None:
        if self.variant == "restoring":
            return None
        return np.asarray(plays_nested(u_V, self.radii_V(setting), np.ascontiguousarray(p)))

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        """Height of the additional loop over the full swing, and the sum of the plays' weights."""
        if self.variant == "restoring":
            stops = self.radii_um(setting) / setting.range_um
            return {"force_share": (float(stops @ p), stops), "stiffness_share": (float(p.sum()), np.ones(p.size))}
        row = 2.0 * np.minimum(self.radii_V(setting), 0.5 * setting.swing_V)
        return {"width_um": (float(row @ p), row), "weight_um_per_V": (float(p.sum()), np.ones(p.size))}


@dataclass(frozen=True)
class Asymmetry(Form):
    """Branches that are not point-symmetric.

    One-sided dead zones (2.8), on the static displacement and on a wide play of the voltage, which between them
    stand for dead zones on plays of any width; and products of loop and displacement (generalised Bouc-Wen).
    """

    name: str = "asymmetry"
    form_error: float = 0.12

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return 1e-5 <= abs(self.physical(p, setting)["bend"][0]) + 0.02 * float(np.max(np.abs(p[7:]))) <= 0.1

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        near = tuple(Slot(f"dead_zone{j}", "1", 0.0, -0.2, 0.2, 0.01, At.STATIC, True) for j in (1, 2, 3, 4))
        wide = tuple(Slot(f"wide_dead_zone{j}", "1", 0.0, -0.2, 0.2, 0.01, At.STATIC, True) for j in (1, 2, 3))
        loop = tuple(Slot(name, "1", 0.0, -4.0, 4.0, 0.05, At.STATIC, True) for name in ("branch", "width"))
        return (*near, *wide, *loop)

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, setting: Setting
    ) -> FloatArray | None:
        low = float(np.min(w_um)) if setting.fitted_low_um is None else setting.fitted_low_um
        loop = float(np.max(np.abs(h_um))) if setting.fitted_loop_um is None else setting.fitted_loop_um
        x_scale = np.array([low, 0.5 * setting.range_um])
        z_scale = np.array([0.15 * setting.swing_V, setting.u_low_V, 0.5 * setting.swing_V])
        q = np.ascontiguousarray(p)
        return np.asarray(asymmetric(u_V, h_um, w_um, q, _NEAR, _WIDE, x_scale, z_scale, max(loop, 1e-12)))

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        """The bend over the whole stroke, and the two products."""
        row = np.zeros(p.size)
        row[:4] = 0.5 * (1.0 - _NEAR) / 2.0
        row[4:7] = 0.5 * (1.0 - _WIDE) / 2.0
        one, two = np.zeros(p.size), np.zeros(p.size)
        one[7], two[8] = 1.0, 1.0
        return {"bend": (float(row @ p), row), "branch": (float(p[7]), one), "width": (float(p[8]), two)}


@dataclass(frozen=True)
class RateDependence(Form):
    """A loop that widens with log10(1 + rate/v0).

    ``variant`` "width": the loop's width follows the rate at once, and its driving term does; "thresholds" and
    "added": plays whose thresholds grow by a share, or by as many volts, less the same plays at rest.
    """

    name: str = "rate_dependence"
    form_error: float = 0.3
    variant: str = "width"
    #: Time over which the rate is felt, s; ``felt_free``: only where its fit begins.
    felt_s: float = 0.004
    felt_free: bool = False

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return 0.003 <= self.physical(p, setting)["growth_per_decade"][0] <= 0.6

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        v = setting.swing_V
        pace = Slot("log_v0", "1", float(np.log(v)), float(np.log(0.05 * v)), float(np.log(300.0 * v)), 0.5, At.STATIC)
        if self.variant != "width":
            g = setting.range_um / max(v, 1e-9)
            w = tuple(Slot(f"weight{j}_um_per_V", "µm/V", 0.0, -g, g, 0.1 * g, At.STATIC) for j in (1, 2, 3))
            return (*w, pace)
        own = (
            Slot("width_per_decade", "1", 0.0, -1.0, 1.0, 0.02, At.STATIC),
            Slot("slope_per_decade", "1", 0.0, -1.0, 1.0, 0.02, At.STATIC),
            pace,
        )
        felt = Slot("log_felt_s", "1", float(np.log(self.felt_s)), float(np.log(2e-4)), 0.0, 0.2, At.STATIC)
        return (*own, felt) if self.felt_free else own

    def _paced(self, p: FloatArray) -> tuple[float, float]:
        """Rate above which the loop grows (V/s), and the time over which it is felt (s)."""
        if self.felt_free:
            return float(np.exp(p[-2])), float(np.exp(p[-1]))
        return float(np.exp(p[-1])), self.felt_s

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        slots = self.slots(setting)
        out = []
        for f in (0.2, 2.0, 20.0, 200.0):
            rows = []
            for i in range(len(slots) - 1):
                row = np.zeros(len(slots))
                row[-1] = np.log(f * setting.swing_V)
                row[i] = slots[i].step
                rows.append(row)
            out.append(rows)
        return out

    def _growth(self, setting: Setting) -> tuple[FloatArray, float, float]:
        """Thresholds at rest (V), their growth per decade as a factor and in V."""
        if self.variant == "added":
            return np.array([0.0, 0.1, 0.3]) * setting.swing_V, 0.0, 0.01 * setting.swing_V
        return np.array([0.06, 0.18, 0.36]) * setting.swing_V, 0.05, 0.0

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, setting: Setting
    ) -> FloatArray | None:
        if not np.any(p[: 2 if self.variant == "width" else 3]):
            return None
        corner_V_per_s, felt_s = self._paced(p)
        rate = felt_rate(u_V, float(np.exp(-setting.dt_s / felt_s)) if felt_s > 0.0 else 0.0, setting.dt_s)
        pace = np.log10(1.0 + rate / corner_V_per_s)
        if self.variant != "width":
            radii, factor, added = self._growth(setting)
            return np.asarray(grown_plays(u_V, radii, np.ascontiguousarray(p[:3]), 1.0 + factor * pace, added * pace))
        out = -p[0] * h_um * pace
        if p[1] != 0.0 and setting.nominal_kind == "bouc_wen":
            slope, beta, gamma = loop_numbers(nominal)
            # The driving term must not change its sign, or the loop would run away.
            pace = np.maximum(pace, -0.9 / p[1]) if p[1] > 0.0 else np.minimum(pace, -0.9 / p[1])
            out -= bouc_wen_paced(u_V, slope, beta, gamma, float(h_um[0]), pace, float(p[1])) - h_um
        return np.asarray(out)

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        v0, _ = self._paced(p)
        row, corner = np.zeros(p.size), np.zeros(p.size)
        corner[-2 if self.felt_free else -1] = v0
        if self.variant != "width":
            # Growth of the loop's height, relative to the stroke.
            radii, factor, added = self._growth(setting)
            row[:3] = 2.0 * (factor * radii + added) / setting.range_um
        else:
            row[:2] = 1.0
        return {"growth_per_decade": (float(row @ p), row), "corner_V_per_s": (v0, corner)}
