"""The second half of a demonstration: a raster on the same stage, each line corrected by what the last one showed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.lab.demo.plan import Plan
from dehyst.lab.loop import samples, stepped
from dehyst.lab.rehearsal.controllers import Following, line_errors_pct, raster_times, repeating, triangles
from dehyst.lab.rehearsal.reference import BEGIN_S, Motion, ReferenceRequest
from dehyst.lab.rehearsal.runs import IDLE_S
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.service.server.axis import Axis
from dehyst.service.viewer.colours import ADAPTIVE, FROZEN
from dehyst.sim.stage.stage import Stage

#: Lines a second.
LINES_PER_S: Final = 20.0
#: Lines of the picture.
SHOWN: Final = (1, 5, 20)
#: Age of the readings, samples.
_AGE: Final = 1
ALONE, REPETITION = "learning model", "with repetition"


@dataclass(frozen=True, slots=True)
class RasterRun:
    """A raster by two controllers.

    Attributes
    ----------
    wanted : the motion. true_um : (n,) displacement by controller, µm. lines_pct : mean absolute error of each line by
    controller, percent of the range. frequency_Hz : lines a second.
    """

    wanted: Motion
    true_um: dict[str, FloatArray]
    lines_pct: dict[str, FloatArray]
    frequency_Hz: float

    def summary(self) -> dict[str, Any]:
        """The part ``raster`` of ``summary.json``."""
        return {"lines_per_s": self.frequency_Hz, "mae_pct": {way: e.tolist() for way, e in self.lines_pct.items()}}


def run_raster(plan: Plan, axes: dict[str, Axis]) -> RasterRun:
    """The raster on new stages, unchanged and at rest, each with one of the new ``axes``, by controller."""
    dt_s, config, hertz = plan.dt_s, plan.stage(changing=False), LINES_PER_S
    t_s = raster_times(hertz, dt_s)
    rest_V = np.zeros(round(IDLE_S / dt_s))
    mode_Hz = config.effects["resonance"].values["frequency_Hz"]
    true_um: dict[str, FloatArray] = {}
    for way, axis in axes.items():
        stage = Stage(config)
        state = stage.initial_state()
        at_rest_um = stage.run(state, rest_V)[0]
        axis.handle(samples(0, dt_s, rest_V, at_rest_um))
        wish = ReferenceRequest(at_rest_um.item(-1), plan.low_um, plan.high_um, t_s.item(-1), plan.seed)
        wanted = triangles(hertz)(wish)(t_s)
        correcting = repeating(axis, mode_Hz) if way == REPETITION else None
        controller = Following(axis, wanted, rest_V.size, correcting, learns=True)

        def driven(_: int, u_V: FloatArray, stage: Stage = stage, state: Any = state) -> tuple[float, float]:
            read_um = stage.run(state, u_V)[0].item()
            return read_um, read_um

        true_um[way] = stepped(controller, t_s.size, _AGE, driven).true_um
    lines_pct = {way: line_errors_pct(wanted.y_um, y_um, hertz, dt_s) for way, y_um in true_um.items()}
    return RasterRun(wanted, true_um, lines_pct, hertz)


def told(raster: dict[str, Any]) -> str:
    """The errors in one line, from the part ``raster`` of the summary."""
    parts = (
        f"{way} {', '.join(f'{errors[k - 1]:.3f}' for k in SHOWN)}" for way, errors in raster["mae_pct"].items()
    )  # fmt: skip
    return (
        f"raster of {raster['lines_per_s']:g} lines/s, mean |error| of line {', '.join(map(str, SHOWN))}, % of range: "
        + "; ".join(parts)
    )


def draw_raster(path: Path, plan: Plan, run: RasterRun) -> None:
    """Write the error of the lines `SHOWN` along each line."""
    drawn, grid = figure(
        1, len(SHOWN), (11.0, 3.6), f"A raster of {run.frequency_Hz:g} lines/s, each forth and back", sharey=True
    )
    size = 1.0 / run.frequency_Hz / plan.dt_s
    for axis, k in zip(grid[0], SHOWN, strict=True):
        begin = BEGIN_S / plan.dt_s + (k - 1) * size
        part = slice(round(begin), round(begin + size))
        time_ms = 1e3 * plan.dt_s * np.arange(part.stop - part.start)
        for way, colour in ((ALONE, FROZEN), (REPETITION, ADAPTIVE)):
            error_pct = 100.0 / plan.range_um * (run.wanted.y_um[part] - run.true_um[way][part])
            line(axis, time_ms, error_pct, color=colour, lw=1.2, label=f"{way}: {run.lines_pct[way][k - 1]:.3f}")
        label(axis, "time in the line, ms", "error, % of range" if k == SHOWN[0] else "", f"line {k}")
        legend(axis, title="mean |error|, %", title_fontsize=8)
    save(drawn, path)
