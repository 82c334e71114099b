"""Branches without point symmetry: a one-sided dead zone (2.8) on the output of a play (2.4).

It is single-valued in the output of the play, but not in the voltage. Above the dead zone both the slope and the loop
of the stage change, below it neither.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.hysteresis_loops import asymmetric
from dehyst.sim.fitting.stage_model import CauseModel
from dehyst.sim.readings.cycles import mirrored_branches

# Its step in the simulation.


@block
def run_asymmetry(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: slope, dead zone, threshold. s: play output, V."""
    for k in range(n):
        z = min(max(s[0], v[k] - p[2]), v[k] + p[2])
        s[0] = z
        x[k] += p[0] * max(z - p[1], 0.0)


# Its form in a diagnosis.

#: Knees of the dead zones of the displacement and of a wide play: distance from the middle over half the stroke.
_NEAR = np.array([-0.6, -0.2, 0.2, 0.6])
_WIDE = np.array([-0.4, 0.0, 0.4])
#: The same of the form "fine", for a bow that is smooth: pieces a third as long leave a tenth of it.
_NEAR_FINE = np.linspace(-0.875, 0.875, 15)
_WIDE_FINE = np.linspace(-0.8, 0.8, 9)


@dataclass(frozen=True)
class Asymmetry(CauseModel):
    """Branches that are not point-symmetric.

    One-sided dead zones (2.8), on the static displacement and on a wide play of the voltage, which between them
    stand for dead zones on plays of any width; and products of loop and displacement (generalised Bouc-Wen).
    ``variant`` "fine": more dead zones.
    """

    test_answers_to_others: bool = True
    unseen_is_absent: bool = True
    model_error: float = 0.12

    @property
    def knees(self) -> tuple[FloatArray, FloatArray]:
        """Knees of the displacement and of the wide play."""
        return (_NEAR_FINE, _WIDE_FINE) if self.variant == "fine" else (_NEAR, _WIDE)

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 1e-5 <= abs(self.reported(p, data)["bend"][0]) + 0.02 * float(np.max(np.abs(p[-2:]))) <= 0.1

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        zones = [f"dead_zone{j + 1}" for j in range(self.knees[0].size)]
        zones += [f"wide_dead_zone{j + 1}" for j in range(self.knees[1].size)]
        own = tuple(ModelParameter(name, "1", 0.0, -0.2, 0.2, 0.01, ActsOn.STATIC, True) for name in zones)
        loop = tuple(
            ModelParameter(name, "1", 0.0, -4.0, 4.0, 0.05, ActsOn.STATIC, True) for name in ("branch", "width")
        )
        return (*own, *loop)

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        if left_floors <= 1.5 or self.variant:
            return None
        fine = replace(self, variant="fine")
        start = np.zeros(len(fine.parameters(data)))
        start[-2:] = p[-2:]
        return fine, [start]

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, data: FitData
    ) -> FloatArray | None:
        low = float(np.min(w_um)) if data.fitted_low_um is None else data.fitted_low_um
        loop = float(np.max(np.abs(h_um))) if data.fitted_loop_um is None else data.fitted_loop_um
        x_scale = np.array([low, 0.5 * data.range_um])
        z_scale = np.array([0.15 * data.swing_V, data.u_low_V, 0.5 * data.swing_V])
        q = np.ascontiguousarray(p)
        return np.asarray(asymmetric(u_V, h_um, w_um, q, *self.knees, x_scale, z_scale, max(loop, 1e-12)))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """The bend over the whole stroke and the weights of both products."""
        near, wide = self.knees
        row = np.concatenate([0.25 * (1.0 - near), 0.25 * (1.0 - wide), [0.0, 0.0]])
        one, two = np.zeros(p.size), np.zeros(p.size)
        one[-2], two[-1] = 1.0, 1.0
        return {"bend": (float(row @ p), row), "branch": (float(p[-2]), one), "width": (float(p[-1]), two)}


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    swing, where = data.swing_V, data.u_low_V
    slope = v["bend"] * data.range_um / swing
    one, two = (
        ASYMMETRY.clipped(label, slope_um_per_V=s, dead_zone_V=where + share * swing, threshold_V=width * swing)
        for label, s, share, width in (("asymmetry", slope, 0.35, 0.02), ("asymmetry_2", 0.1 * slope, 0.65, 0.15))
    )
    return InLibrary((one, two), refit=True)


ASYMMETRY = Kind(
    name="asymmetry",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter("slope_um_per_V", "µm/V", -100.0, 100.0, 0.5, "slope added above the dead zone"),
        Parameter("dead_zone_V", "V", -200.0, 200.0, 4.0, "where the additional slope begins"),
        Parameter("threshold_V", "V", 0.0, 100.0, 1.0, "half-width of the play that the dead zone acts on"),
    ),
    derive=lambda values, context: (values["slope_um_per_V"], values["dead_zone_V"], values["threshold_V"]),
    rest=lambda values, context: (0.0,),
    block=run_asymmetry,
    signature="the two branches are not point-symmetric; even harmonics",
    mistaken_for=("sensor_nonlinearity", "hysteresis_shape"),
    tells_apart="a sensor's polynomial is single-valued and the same in both directions",
    source="0.5 to 3 % of the stroke (common knowledge of the field); form of the MPI model (2.8)-(2.10)",
    cause=Cause(
        sign="the mean of both branches, mirrored, is curved, in cycles of one height",
        forms=(Asymmetry(),),
        tests=(mirrored_branches,),
        in_library=in_library,
        picture=pictures.over_reading,
    ),
)
