"""Cross-talk: a share of the other axis's displacement and velocity appears on this one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.dynamics import Dynamics
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.modes import MOST, Mode, Modes, modal_response, peaks
from dehyst.sim.fitting.stage_model import CauseModel, ModelFit
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


@block
def run_cross_talk(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: static share, weight of a change. s: the other axis so far, µm, and whether it is known."""
    for k in range(n):
        if s[1] == 0.0:
            s[0], s[1] = w[k], 1.0
        x[k] += p[0] * w[k] + p[1] * (w[k] - s[0])
        s[0] = w[k]


# Its form in a diagnosis.


@dataclass(frozen=True)
class CrossTalk(CauseModel):
    """A share of the other axis' displacement and of its velocity."""

    unseen_is_absent: bool = True
    of_other_axis: bool = True

    def missing(self, data: FitData) -> str:
        return "" if data.other_um is not None else "the other axis driven and recorded (u2_V or y2_um)"

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (
            ModelParameter("static", "1", 0.0, -2.0, 2.0, 0.002, ActsOn.MOTION),
            ModelParameter("rate_s", "s", 0.0, -1e-3, 1e-3, 1e-5, ActsOn.MOTION),
        )

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if data.other_um is None or data.other_um_per_s is None:
            return x_um
        return np.asarray(x_um + p[0] * data.other_um + p[1] * data.other_um_per_s)


@dataclass(frozen=True)
class CrossModes(Modes):
    """Cross-talk from the voltages of other axes, through modes of its own."""

    unseen_is_absent: bool = True
    of_other_axis: bool = True
    #: For each mode the index of the voltage that drives it.
    driven_by: tuple[int, ...] = ()

    def at(self) -> ActsOn:
        return ActsOn.MOTION

    def size(self, data: FitData) -> float:
        swings = [float(np.ptp(u)) for u in _others(data)]
        return 0.2 * data.range_um / max(*swings, 1e-9) if swings else 1.0

    def found_again(self, fit: ModelFit, mask: BoolArray) -> Modes:
        data = fit.model.data
        if not data.input_is_linear:
            return replace(self, found=(), driven_by=())
        found: list[Mode] = []
        driven_by: list[int] = []
        for which, u in enumerate(_others(data)):
            more = peaks(u, fit.residual_um, data.dt_s, MOST)
            found += more
            driven_by += [which] * len(more)
        return replace(self, found=tuple(found), driven_by=tuple(driven_by))

    def added_motion(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, data: FitData, system: Dynamics
    ) -> FloatArray | None:
        return None

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        out, rows = x_um, p.reshape(-1, 4)
        for which, u in enumerate(_others(data)):
            mine = np.flatnonzero(np.array(self.driven_by) == which)
            if mine.size:
                out = out + modal_response(u, np.ascontiguousarray(rows[mine]), data, Dynamics())
        return out

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        """Static cross-talk relative to this axis' gain, then the modes."""
        row = np.zeros(p.size)
        row[2::4] = np.where(np.array(self.driven_by) == 0, 1.0 / data.gain_um_per_V, 0.0)
        return {"static": (float(row @ p), row)} | super().reported(p, data)


def _others(data: FitData) -> list[FloatArray]:
    """Recorded voltages of the other axes."""
    return [u for u in (data.u2_V, data.u3_V) if u is not None]


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    if isinstance(form, CrossModes):
        return None
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    return InLibrary((CROSS_TALK.clipped(static=v["static"], rate_s=v["rate_s"]),))


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """Motion with the other axis' voltage while this axis' voltage stands still."""
    data = readings.data
    other = data.u2_V
    if other is None or float(np.ptp(other)) == 0.0:
        return Sight(None, "no other axis is driven")
    up = down = 0.0
    left: list[FloatArray] = []
    for a, b in readings.parked:
        if b - a < 50 or float(np.ptp(other[a:b])) < 0.05 * float(np.ptp(other)):
            continue
        t = np.linspace(-1.0, 1.0, b - a)
        lines = np.stack([np.ones_like(t), t, t * t])
        x = other[a:b] - np.linalg.lstsq(lines.T, other[a:b], rcond=None)[0] @ lines
        y = data.y_um[a:b] - np.linalg.lstsq(lines.T, data.y_um[a:b], rcond=None)[0] @ lines
        up += float(x @ y)
        down += float(x @ x)
        left.append(y - x * (x @ y) / max(float(x @ x), 1e-300))
    if down <= 0.0:
        return Sight(None, "the other axis never moves while this one stands still")
    share = up / down
    spread = float(np.std(np.concatenate(left)))
    error = spread / np.sqrt(down)
    gain = max(abs(data.gain_um_per_V), 1e-12)
    words = f"at rest the readings follow the other axis by {100 * share / gain:.3g} ± {196 * error / gain:.1g} %"
    return Sight(bool(abs(share) > 6.0 * error and abs(share) > 2e-5 * gain), words)


CROSS_TALK = Kind(
    name="cross_talk",
    place=Place.CROSS_TALK,
    parameters=(
        Parameter("static", "1", -0.2, 0.2, 0.0117, "share of the other axis's displacement"),
        Parameter("rate_s", "s", -0.01, 0.01, 0.0, "share of the other axis's velocity"),
    ),
    derive=lambda values, context: (values["static"], values["rate_s"] / context.dt_s),
    rest=lambda values, context: (0.0, 0.0),
    block=run_cross_talk,
    signature="correlates with the other axis",
    tells_apart="drive the axes separately",
    source="1.17 % in the chapter (Fig. 2.2); 0.01 to 1 % in the field",
    cause=Cause(
        sign="the readings move with the other axis while this one stands still",
        forms=(CrossTalk(), CrossModes()),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.over_other_axis,
    ),
)
