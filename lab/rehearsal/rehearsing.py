"""A rehearsal: identify a plant, close the loop over it through the real axis, and let something happen.

One process, no wire, no clock; the same plant, configuration and seed give the same numbers on the same machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.rehearsal.config import RehearsalConfig
from lab.rehearsal.disturbance import Line, Sensor, Stand, World
from lab.rehearsal.events import REFERENCE, STANDARD, Event, draw
from lab.rehearsal.identification import Identified, approach, excited, identify
from lab.rehearsal.loop import Course, idle_samples, run_adaptive, run_frozen, times
from lab.rehearsal.outcome import Outcome, outcome
from lab.rehearsal.plant import PlantFactory
from lab.rehearsal.reference import Excursion, Motion, RandomReference, Reference, Wish
from service.config.config import LEARN, AxisConfig
from service.protocol.errors import FieldError
from service.server.models import load_axis
from service.storage.model_file import Bundle, BundleMeta

#: Names on the wire that a rehearsal's axis has, and what its model bundle belongs to.
STAGE, AXIS = "rehearsal", "x"
#: Called with what is done now and the share of it that is done, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Run:
    """One event: the courses of the learning and of the frozen model, and what they came to."""

    event: Event
    range_um: float
    adaptive: Course
    frozen: Course
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What was identified, and the runs in the order of their events."""

    identified: Identified
    runs: tuple[Run, ...]
    seed: int

    def as_dict(self) -> dict[str, Any]:
        """JSON form, without the courses."""
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
    """One event of each class named (keys of ``CLASSES``), within a second after ``settle_s``, drawn by ``seed``.

    Raises FieldError on a name that is not known.
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
    plant_factory : makes the plant, at rest and always the same; see :mod:`lab.rehearsal.plant`.
    events : what happens, one a run; None: one of each standard class, drawn by ``seed``.
    seed : of the reference and, where ``events`` is None, of the events.

    Raises FieldError where the plant answers what is no motion, InputError where no model can be identified from it.
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
    known: Identified,
    config: RehearsalConfig,
    event: Event,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
) -> Run:
    """The closed loop with one event. Raises as :func:`rehearse`."""
    dt_s, block = known.dt_s, config.block
    stage_span = known.high_um - known.low_um
    # With numbers from 1 on a snapshot falls on the last sample of a block, and knows all that the axis has been told.
    first_number = idle_samples(dt_s, block) + 1
    axis = load_axis(STAGE, _axis_config(known, config), bundle=_bundle(known))
    duration_s = event.end_s + config.after_s
    n = math.ceil(duration_s / dt_s / block) * block
    wish = Wish(
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
    world = World(range_um, float(0.5 * (wish.low_um + wish.high_um)), known.rest_um)
    low_V, _ = excited(plant_factory(), config)

    def stand() -> Stand:
        plant = plant_factory()
        approach(plant, low_V)
        return Stand(plant, event, world)

    learning = stand()
    adaptive = run_adaptive(
        axis, learning, Sensor(event, world, dt_s, n), Line(event, dt_s, first_number), wanted, low_V, block,
        first_number, lambda done: progress(done / n) if done % (100 * block) == 0 else None,
    )  # fmt: skip
    frozen = run_frozen(known.models[LEARN], stand(), wanted, low_V, axis.limits, block)
    progress(1.0)
    result = outcome(event, adaptive, frozen, range_um, axis.limits, dt_s, learning.left_out)
    return Run(event, range_um, adaptive, frozen, result)


def _axis_config(known: Identified, config: RehearsalConfig) -> AxisConfig:
    return AxisConfig(
        AXIS, Path("rehearsal"), known.limits, compete=config.compete, snapshot_every=config.snapshot_every,
        learner=dict(config.learner),
    )  # fmt: skip


def _bundle(known: Identified) -> Bundle:
    meta = BundleMeta(
        STAGE, AXIS, known.dt_s, y_min_um=known.low_um, y_max_um=known.high_um,
        u_min_V=float(known.u_V.min()), u_max_V=float(known.u_V.max()),
    )  # fmt: skip
    return Bundle(dict(known.models), meta)
