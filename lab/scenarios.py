"""Scenarios: adapting and not adapting on twin stages, through the service's own axis with its delays.

Both twins have the same stage, noise and reference, and both models begin as the one that was identified from the
chapter's training signal. The axis answers in blocks, queried ahead, from snapshots of a certain age, as for a
controller in the network.

`run_scenario` runs one scenario, `judge` judges it, `table` shows the verdicts, `draw_course` draws one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.identification import identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray
from dehyst.lab.loop import Asker, Twins, samples, turns
from dehyst.lab.rehearsal.outcome import moving_mean
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.reports import tables
from dehyst.service.reports.plot_style import figure, legend, line, save
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from dehyst.service.viewer.colours import EVENT, LIMIT, REFERENCE, model_colour
from dehyst.sim.scenarios import Scenario
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage

ADAPTIVE: Final = "lssvm_adaptive"
FROZEN: Final = "lssvm_memory"
MODELS: Final = (ADAPTIVE, FROZEN)
#: Points per query, samples that it is asked ahead, and samples that its snapshot is older still.
BLOCK, LEAD, MARGIN = 20, 40, 20
SLEW_V_PER_S: Final = 4000.0
IDENTIFY_S: Final = 10.0
#: Length of the readings at rest that give the noise floor, s.
FLOOR_S: Final = 2.0

#: Called with the simulated time done, s.
Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class ScenarioRecord:
    """One scenario as it went; arrays of (n,) samples, µm.

    Attributes
    ----------
    wanted_um : the reference. error_um : by model, reference minus reading without glitches.
    floor_um : rms noise of a reading at rest, of the stage at that sample.
    verdicts : counts of the learner's verdicts on samples. counters : of the learner, at the end.
    """

    scenario: Scenario
    wanted_um: FloatArray
    error_um: dict[str, FloatArray]
    floor_um: FloatArray
    verdicts: dict[str, int]
    counters: dict[str, int]


@lru_cache(maxsize=64)
def identified(stage: StageConfig) -> LssvmInverse:
    """The model of a stage at rest, from the chapter's training signal (2.37) at the stage's sample time."""
    rested = Stage(stage)
    u_V = training_input(stage.dt_s, IDENTIFY_S)[1]
    y_um, _ = rested.run(rested.initial_state(), u_V)
    return identify_lssvm(u_V, y_um, stage.dt_s, inputs="memory", name=ADAPTIVE)[0]


def noise_floor_um(stage: StageConfig) -> float:
    """Standard deviation, µm, of the readings of a stage at rest, without slow drift."""
    rested = Stage(replace(stage, changes=()))
    n = round(FLOOR_S / stage.dt_s)
    y_um, _ = rested.run(rested.initial_state(), np.zeros(n))
    line = np.polynomial.Polynomial.fit(np.arange(n), y_um, 1)
    return float(np.std(y_um - line(np.arange(n))))


def run_scenario(
    scenario: Scenario, settings: dict[str, Any] | None = None, progress: Progress = lambda _: None
) -> ScenarioRecord:
    """Run a scenario. ``settings``: as in a table ``[axis.learner]``. Raises InputError on wrong settings."""
    model = identified(scenario.stage)
    dt = scenario.stage.dt_s
    limits = Limits(scenario.stage.u_min_V, scenario.stage.u_max_V, SLEW_V_PER_S)
    config = AxisConfig(
        "x", Path("identified"), limits, learn=ADAPTIVE, snapshot_every=BLOCK, learner=dict(settings or {})
    )
    bundle = Bundle({ADAPTIVE: model, FROZEN: replace(model, name=FROZEN)}, BundleMeta("scenario", "x", dt))
    axis = load_axis("scenario", config, bundle=bundle)
    wanted = scenario.reference()
    n = wanted.y_um.size // BLOCK * BLOCK
    twins = Twins(Stage(scenario.changing_stage()), MODELS, n)
    # The axis tracks the adaptive twin's stage; the other twin sends its memory along.
    ask = {name: Asker(axis, name, tracked=name == ADAPTIVE) for name in MODELS}
    for run, asked in turns(n // BLOCK, LEAD // BLOCK):
        if run is not None:
            part = slice(run * BLOCK, (run + 1) * BLOCK)
            twins.run(part)
            read = scenario.glitches.applied(part.start, twins.y_um[ADAPTIVE][part])
            axis.handle(samples(part.start, dt, twins.u_V[ADAPTIVE][part], read))
            if part.stop % 1000 == 0:
                progress(part.stop * dt)
        if asked is not None:
            part = slice(asked * BLOCK, (asked + 1) * BLOCK)
            motion = wanted.y_um[part], wanted.v_um_per_s[part], wanted.a_um_per_s2[part]
            for name in MODELS:
                twins.u_V[name][part] = ask[name](part.start, motion, max(-1, part.start - LEAD - MARGIN)).u_V
    learner = axis.learner
    return ScenarioRecord(
        scenario=scenario,
        wanted_um=wanted.y_um[:n],
        error_um={name: wanted.y_um[:n] - twins.y_um[name] for name in MODELS},
        floor_um=_floor(scenario, n),
        verdicts=axis.gates,
        counters=learner.counters() if learner is not None else {},
    )


def _floor(scenario: Scenario, n: int) -> FloatArray:
    """The noise floor at every sample; a change of the sensor's noise changes it."""
    floor = np.full(n, noise_floor_um(scenario.stage))
    chain = scenario.stage.effects
    for t_s, values in scenario.changes:
        chain = chain.replace(values)
        if any(path.startswith("sensor_noise.") for path in values):
            floor[round(t_s / scenario.stage.dt_s) :] = noise_floor_um(replace(scenario.stage, effects=chain))
    return floor


# --- The verdict: in no half second may adapting be worse than not adapting. Table and JSON.

#: In every window of this length, s, the adaptive mean absolute error may be at most ...
WINDOW_S: Final = 0.5
#: ... this many times the frozen model's ...
FACTOR: Final = 1.1
#: ... plus this many noise floors.
FLOORS: Final = 3.0
#: Length of "settled" at the end of the run, and of "before" just before the change, s.
SETTLED_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a scenario; errors are mean absolute errors in percent of the commanded range.

    Attributes
    ----------
    before_pct, first_second_pct, settled_pct : of the adaptive model, before the change (up to 10 s), in the first
    second, and at the end (10 s); ``frozen_*`` of the model that does not adapt.
    worst_ratio : largest error of a window over what that window allows; held if at most 1.
    worst_s : middle of that window, s. worst_pct, worst_frozen_pct : the two errors in it.
    broken_share : share of all windows above what they allow.
    floor_pct : noise floor at the end.
    """

    name: str
    kind: str
    seed: int
    text: str
    before_pct: float
    first_second_pct: float
    settled_pct: float
    frozen_before_pct: float
    frozen_first_second_pct: float
    frozen_settled_pct: float
    worst_ratio: float
    worst_s: float
    worst_pct: float
    worst_frozen_pct: float
    broken_share: float
    floor_pct: float
    held: bool
    verdicts: dict[str, int]
    counters: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {key: round(value, 6) if isinstance(value, float) else value for key, value in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class Windows:
    """Mean absolute errors of every window, µm; ``t_s`` is the middle of a window."""

    t_s: FloatArray
    adaptive_um: FloatArray
    frozen_um: FloatArray
    allowed_um: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Adaptive error over what is allowed."""
        return self.adaptive_um / self.allowed_um


def windows(course: ScenarioRecord) -> Windows:
    """All windows: one begins at each sample."""
    dt = course.scenario.stage.dt_s
    span = max(1, round(WINDOW_S / dt))

    adaptive, frozen = (moving_mean(np.abs(course.error_um[name]), span) for name in (ADAPTIVE, FROZEN))
    t_s: FloatArray = ((np.arange(adaptive.size) + 0.5 * span) * dt).astype(np.float64)
    return Windows(t_s, adaptive, frozen, FACTOR * frozen + FLOORS * moving_mean(course.floor_um, span))


def judge(course: ScenarioRecord) -> Verdict:
    """The verdict on a scenario."""
    s = course.scenario
    dt, percent = s.stage.dt_s, 100.0 / s.range_um
    w = windows(course)
    worst = int(np.argmax(w.ratio))
    # A dwell is judged by its strokes: "before" is the motion before the rest.
    change = round((s.quiet_s[0] if s.quiet_s else s.change_s) / dt)
    begin = round(s.change_s / dt)
    settled = round(SETTLED_S / dt)
    parts = {
        "before": slice(max(0, change - settled), change),
        "first_second": slice(begin, begin + round(1.0 / dt)),
        "settled": slice(-settled, None),
    }
    errors = {
        f"{prefix}{part}_pct": float(np.mean(np.abs(course.error_um[name][where]))) * percent
        for prefix, name in (("", ADAPTIVE), ("frozen_", FROZEN))
        for part, where in parts.items()
    }
    ratio = float(w.ratio[worst])
    return Verdict(
        s.name,
        s.kind,
        s.seed,
        s.text,
        **errors,
        worst_ratio=ratio,
        worst_s=float(w.t_s[worst]),
        worst_pct=float(w.adaptive_um[worst]) * percent,
        worst_frozen_pct=float(w.frozen_um[worst]) * percent,
        broken_share=float(np.mean(w.ratio > 1.0)),
        floor_pct=float(course.floor_um[-1]) * percent,
        held=ratio <= 1.0,
        verdicts=dict(sorted(course.verdicts.items())),
        counters=course.counters,
    )


def table(verdicts: list[Verdict], markdown: bool = False) -> str:
    """One row per scenario; ``markdown`` for a page."""
    head = (
        "scenario", "what happens", "before", "first 1 s", "settled", "frozen settled", "worst / allowed", "at", "held",
    )  # fmt: skip
    rows = [
        (
            v.name, v.text, f"{v.before_pct:.3f}", f"{v.first_second_pct:.3f}", f"{v.settled_pct:.3f}",
            f"{v.frozen_settled_pct:.3f}", f"{v.worst_ratio:.2f}", f"{v.worst_s:.1f} s", "yes" if v.held else "NO",
        )
        for v in verdicts
    ]  # fmt: skip
    if markdown:
        return tables.markdown(head, rows)
    cells = tables.aligned(head, rows, left=(0, 1))
    held = sum(v.held for v in verdicts)
    cells.append(
        f"errors: mean absolute, % of the commanded range; allowed in every {WINDOW_S:g} s: {FACTOR:g} x the frozen "
        f"model's + {FLOORS:g} noise floors"
    )
    cells.append(f"held in {held} of {len(verdicts)} scenarios")
    return "\n".join(cells)


def draw_course(path: Path, course: ScenarioRecord, verdict: Verdict) -> None:
    """Reference, errors, and mean error and allowed error of every window."""
    s = course.scenario
    dt, percent = s.stage.dt_s, 100.0 / s.range_um
    t_s = np.arange(course.wanted_um.size) * dt
    title = f"{s.name}: {s.text}; {'held' if verdict.held else 'NOT held'}"
    drawn, axes = figure(3, 1, (11.0, 8.5), title, sharex=True, height_ratios=(0.8, 1.2, 1.4))
    top, middle, bottom = axes[:, 0]
    line(top, t_s, course.wanted_um, color=REFERENCE, lw=0.6)
    top.set_ylabel("reference, µm")
    for name, front in ((FROZEN, 2), (ADAPTIVE, 3)):
        line(middle, t_s, course.error_um[name] * percent, color=model_colour(name), lw=0.6, zorder=front)
    middle.set_ylabel("error, % of range")
    w = windows(course)
    lines = (
        (w.frozen_um, model_colour(FROZEN), "-", "not adapting"),
        (w.allowed_um, LIMIT, "--", f"allowed: {FACTOR:g} x that + {FLOORS:g} noise floors"),
        (w.adaptive_um, model_colour(ADAPTIVE), "-", "adapting"),
    )
    for values, colour, style, text in lines:
        line(bottom, w.t_s, np.maximum(values * percent, 1e-4), color=colour, ls=style, lw=1.2, label=text)
    bottom.set_yscale("log")
    bottom.plot(verdict.worst_s, verdict.worst_pct, "v", color=EVENT, ms=6, label="closest to the limit")
    bottom.set_ylabel(f"mean |error| over {WINDOW_S:g} s,\n% of range")
    legend(bottom, ncols=2)
    bottom.set_xlabel("time, s")
    for axis in (top, middle, bottom):
        axis.axvline(s.change_s, color=EVENT, lw=1.0, ls=":")
        axis.margins(x=0)
    save(drawn, path)
