"""A rehearsal: identify a plant, close the loop over it through the real axis, let events happen, and tabulate them.

One process, no network, no clock: the same plant, configuration and seed give the same numbers on the same machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.lab.rehearsal.config import RehearsalConfig
from dehyst.lab.rehearsal.disturbance import (
    REFERENCE,
    SENSOR,
    STANDARD,
    DisturbedPlant,
    DisturbedSensor,
    Event,
    EventScale,
    MessageLine,
    draw,
)
from dehyst.lab.rehearsal.outcome import (
    LARGE_PCT,
    SENSOR_FACTOR,
    SENSOR_PCT,
    Outcome,
    outcome,
)
from dehyst.lab.rehearsal.plant import IdentifiedPlant, PlantFactory, excitation_range, go_to_lowest, identify
from dehyst.lab.rehearsal.reference import Excursion, Motion, RandomReference, Reference, ReferenceRequest
from dehyst.lab.rehearsal.runs import LoopRecord, idle_samples, run_adaptive, run_frozen, times
from dehyst.service.answers.answering import Served
from dehyst.service.config.settings import LEARN, AxisConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.reports import tables
from dehyst.service.reports.plot_style import figure, legend, line, save
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from dehyst.service.viewer.colours import ADAPTIVE, EVENT, FROZEN, TROUBLE

#: Stage and axis name of the rehearsed axis.
STAGE, AXIS = "rehearsal", "x"
#: Called with the present step and its progress, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class EventRun:
    """One event: the records of the learning and of the frozen model, and their outcome.

    last : of a sensor fault, the record in which the model that answered just before it answers to the end.
    """

    event: Event
    range_um: float
    adaptive: LoopRecord
    frozen: LoopRecord
    last: LoopRecord | None
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What was identified, and the runs in the order of their events."""

    identified: IdentifiedPlant
    runs: tuple[EventRun, ...]
    seed: int

    def as_dict(self) -> dict[str, Any]:
        """JSON form, without the records."""
        known = self.identified
        return {
            "schema": 1,
            "seed": self.seed,
            "dt_s": known.dt_s,
            "u_min_V": known.limits.u_min_V,
            "u_max_V": known.limits.u_max_V,
            "identified_low_um": known.low_um,
            "identified_high_um": known.high_um,
            "heldout_mae_pct": known.heldout_mae_pct,
            "runs": [run.outcome.as_dict() | {"range_um": run.range_um} for run in self.runs],
        }


def standard_events(seed: int, settle_s: float, names: Sequence[str] = STANDARD) -> tuple[Event, ...]:
    """One event of each class named (keys of ``CLASSES``), within a second after ``settle_s``, drawn with ``seed``.

    Raises FieldError on an unknown name.
    """
    rng = np.random.default_rng([seed, 1])
    return tuple(draw(name, seed, settle_s + float(rng.uniform(0.0, 1.0))) for name in names)


def rehearse(
    plant_factory: PlantFactory,
    *,
    config: RehearsalConfig | None = None,
    events: Sequence[Event] | None = None,
    seed: int = 0,
    progress: Progress = lambda _what, _share: None,
) -> Rehearsal:
    """Identify a plant, then run the closed loop once for each event, learning and frozen, each on a new plant.

    Parameters
    ----------
    plant_factory : makes the plant, at rest and always the same; see `lab.rehearsal.plant`.
    events : what happens, one per run; None: one of each standard class, drawn with ``seed``.
    seed : of the reference and, if ``events`` is None, of the events.

    Raises FieldError if the answer of the plant is no motion, InputError if no model can be identified from it.
    """
    config = config or RehearsalConfig()
    events = standard_events(seed, config.settle_s) if events is None else tuple(events)
    known = identify(plant_factory, config, lambda share: progress("identifying", share))
    runs = []
    for event in events:

        def say(share: float, event: Event = event) -> None:
            progress(event.text, share)

        runs.append(run_event(plant_factory, known, config, event, seed, say))
    return Rehearsal(known, tuple(runs), seed)


def run_event(
    plant_factory: PlantFactory,
    known: IdentifiedPlant,
    config: RehearsalConfig,
    event: Event,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
) -> EventRun:
    """The closed loop with one event, learning and frozen. Raises as `rehearse` does."""
    course = _Course.prepared(plant_factory, known, config, event, event.end_s + config.after_s, seed)
    learning = course.new_plant()
    adaptive, before = course.run_adaptive(learning, progress)
    identified = known.models[LEARN]
    frozen = course.run_frozen(identified, identified.rest_memory(float(course.wanted.y_um[0])), np.empty(0))
    last = None
    if event.category == SENSOR:
        led = max(0, before.seq - course.first_number + 1)
        last = course.run_frozen(before.models[before.default], before.memories[before.default], adaptive.u_V[:led])
    progress(1.0)
    limits, range_um = course.axis.limits, course.range_um
    result = outcome(event, adaptive, frozen, last, range_um, limits, known.dt_s, learning.left_out)
    return EventRun(event, range_um, adaptive, frozen, last, result)


@dataclass(frozen=True, slots=True)
class _Course:
    """An axis and the motion that it is to make, ready to run.

    Attributes
    ----------
    wanted : the motion. range_um : what errors refer to. scale : what the size of the event refers to. first_number :
    of sample 0 in the stage's count. low_V : voltage at rest before the first command.
    """

    axis: Axis
    plant_factory: PlantFactory
    event: Event
    wanted: Motion
    range_um: float
    scale: EventScale
    block: int
    first_number: int
    low_V: float

    @classmethod
    def prepared(
        cls, plant_factory: PlantFactory, known: IdentifiedPlant, config: RehearsalConfig, event: Event,
        duration_s: float, seed: int,
    ) -> _Course:  # fmt: skip
        """A new axis and its motion for ``duration_s``. Raises FieldError if the reference does not move."""
        dt_s, block = known.dt_s, config.block
        stage_span = known.high_um - known.low_um
        # With numbers from 1 on, a snapshot falls on the last sample of a block and knows all samples so far.
        first_number = idle_samples(dt_s, block) + 1
        axis = load_axis(STAGE, _axis_config(known, config), bundle=bundle_of(known))
        n = math.ceil(duration_s / dt_s / block) * block
        wish = ReferenceRequest(
            known.rest_um, known.low_um + config.band[0] * stage_span, known.low_um + config.band[1] * stage_span,
            n * dt_s, seed,
        )  # fmt: skip
        reference: Reference = (config.reference or RandomReference)(wish)
        t_s = times(n, dt_s)
        base = reference(t_s)
        range_um = float(np.ptp(base.y_um[round(2.0 / dt_s) :]))
        if not range_um > 0.0:
            raise FieldError("reference", "a constant", "a motion: errors are measured by its range")
        wanted = base
        if event.where == REFERENCE:
            level_um = axis.limits.y_max_um if event.seed % 2 else axis.limits.y_min_um
            wanted = Excursion(reference, level_um, event.at_s, event.end_s)(t_s)
        wanted = Motion(np.clip(wanted.y_um, axis.limits.y_min_um, axis.limits.y_max_um), wanted[1], wanted[2])
        scale = EventScale(range_um, float(0.5 * (wish.low_um + wish.high_um)), known.rest_um)
        low_V, _ = excitation_range(plant_factory(), config)
        return cls(axis, plant_factory, event, wanted, range_um, scale, block, first_number, low_V)

    def new_plant(self) -> DisturbedPlant:
        """A plant at the lowest voltage of the excitation."""
        plant = self.plant_factory()
        go_to_lowest(plant, self.low_V)
        return DisturbedPlant(plant, self.event, self.scale)

    def run_adaptive(
        self, plant: DisturbedPlant, progress: Callable[[float], None] = lambda _: None
    ) -> tuple[LoopRecord, Served]:
        """Close the loop over ``plant``; once only, for the axis learns. Also the last snapshot before the event."""
        n, dt_s, event = self.wanted.y_um.size, self.axis.dt_s, self.event
        before = self.axis.newest

        def note(done: int) -> None:
            nonlocal before
            if done <= round(event.at_s / dt_s):
                before = self.axis.newest
            if done % (100 * self.block) == 0:
                progress(done / n)

        record = run_adaptive(
            self.axis, plant, DisturbedSensor(event, self.scale, dt_s, n), MessageLine(event, dt_s, self.first_number),
            self.wanted, self.low_V, self.block, self.first_number, note,
        )  # fmt: skip
        return record, before

    def run_frozen(self, model: InverseModel, memory: FloatArray, led_V: FloatArray) -> LoopRecord:
        """A new plant and one model that does not learn; see `runs.run_frozen`."""
        return run_frozen(model, memory, self.new_plant(), self.wanted, self.low_V, led_V, self.axis.limits, self.block)


def _axis_config(known: IdentifiedPlant, config: RehearsalConfig) -> AxisConfig:
    return AxisConfig(
        AXIS, Path("rehearsal"), known.limits, compete=config.compete, snapshot_every=config.snapshot_every,
        learner=dict(config.learner),
    )  # fmt: skip


def bundle_of(known: IdentifiedPlant) -> Bundle:
    meta = BundleMeta(
        STAGE, AXIS, known.dt_s, y_min_um=known.low_um, y_max_um=known.high_um,
        u_min_V=float(known.u_V.min()), u_max_V=float(known.u_V.max()),
    )  # fmt: skip
    return Bundle(dict(known.models), meta)


# --- The table

#: Time above 5 % of the range that is remarked, s.
LARGE_S = 0.1

HEAD = (
    "what happens", "before", "first 1 s", "1 to 4 s", "settled", "frozen settled", "worst 0.5 s / frozen",
    "named after", "remarks",
)  # fmt: skip


def row(result: Outcome) -> tuple[str, ...]:
    """The cells of a run."""
    one, other = result.adaptive, result.frozen
    text = f"{result.text} (left out)" if result.left_out else result.text
    named = f"{result.named_s:.2f} s" if math.isfinite(result.named_s) else "not" if result.category == SENSOR else "-"
    errors = (one.before_pct, one.first_second_pct, one.then_pct, one.settled_pct, other.settled_pct)
    return (
        text, *(f"{value:.3f}" for value in errors), f"{result.worst_ratio:.2f}", named, ", ".join(remarks(result))
    )  # fmt: skip


def remarks(result: Outcome) -> list[str]:
    """What is wrong in a run, and what the axis reported, in words."""
    one = result.adaptive
    found = []
    if one.ends_at_rail:
        found.append("ENDS AT A RAIL")
    if one.large_s > LARGE_S:
        found.append(f"above {LARGE_PCT:g} % for {one.large_s:.2f} s")
    if result.category == SENSOR and result.sensor_excess > 1.0:
        found.append(f"steered by a wrong sensor: {result.sensor_excess:.2g} times what is in order")
    names = [trouble.name for trouble in result.troubles]
    return [*found, *(f"said: {name}" for name in dict.fromkeys(names))]


def table(rehearsal: Rehearsal, markdown: bool = False) -> str:
    """All runs as a table; ``markdown`` for a page."""
    rows = [row(run.outcome) for run in rehearsal.runs]
    if markdown:
        return tables.markdown(HEAD, rows)
    lines = tables.aligned(HEAD, rows, left=(0, len(HEAD) - 1))
    known = rehearsal.identified
    lines += [
        "errors: mean absolute, % of the commanded range; identified: "
        f"{known.low_um:.4g} to {known.high_um:.4g} µm, off by {known.heldout_mae_pct:.3f} % of the voltage span",
        "named after: motion, s, until the axis said that the sensor is wrong; in order is then an error up to "
        f"{SENSOR_PCT:g} % or {SENSOR_FACTOR:g} times that of the better of frozen model and last estimate before it",
    ]
    return "\n".join(lines)


# --- The picture: for each event the error of the learning and of the frozen model over time.


#: Time over which the errors are averaged, s.
MEAN_S = 0.02
#: Lower limit of the logarithmic error axis, percent of the range.
LEAST_PCT = 1e-3


def draw_rehearsal(path: Path, rehearsal: Rehearsal) -> None:
    """Write one PNG with one plot per event. Raises OSError from the disk."""
    runs = rehearsal.runs
    drawn, axes = figure(len(runs), 1, (11.0, 1.0 + 1.9 * len(runs)))
    for plot, run in zip(axes[:, 0], runs, strict=True):
        for course, colour, name in ((run.frozen, FROZEN, "frozen"), (run.adaptive, ADAPTIVE, "learning")):
            line(plot, course.t_s, _error_pct(course, run), color=colour, lw=0.9, label=name)
        plot.set_yscale("log")
        plot.axvline(run.event.at_s, color=EVENT, lw=1.0, ls=":")
        if run.event.over_s:
            plot.axvspan(run.event.at_s, run.event.end_s, color=EVENT, alpha=0.08, lw=0)
        said = run.adaptive.trouble > 0
        if said.any():
            plot.plot(run.adaptive.t_s[said], np.full(int(said.sum()), LEAST_PCT), "|", color=TROUBLE, ms=8)
        marks = remarks(run.outcome)
        plot.set_title(run.outcome.text + (f"; {', '.join(marks)}" if marks else ""), fontsize=9, loc="left")
        plot.set_ylabel("|error|, % of range", fontsize=8)
        plot.set_ylim(LEAST_PCT, None)
        plot.margins(x=0)
    legend(axes[0, 0], ncols=2, loc="upper right")
    axes[-1, 0].set_xlabel("time, s; dotted: the event begins; marks at the bottom: the axis reported trouble")
    save(drawn, path)


def _error_pct(course: LoopRecord, run: EventRun) -> FloatArray:
    """(n,) mean absolute error, percent of the range, about each sample."""
    error = 100.0 / run.range_um * np.abs(course.wanted_um - course.true_um)
    window = max(1, round(MEAN_S / (course.t_s[1] - course.t_s[0])))
    return np.maximum(np.convolve(error, np.ones(window) / window, mode="same"), LEAST_PCT)
