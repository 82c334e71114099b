"""The ``[fleet]`` table of a configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from dehyst.service.answers.guard import Limits
from dehyst.service.config.limits import LIMITS
from dehyst.service.config.schema import Setting
from dehyst.service.protocol.errors import FieldError

#: Most axes of a fleet: what a message for all may hold.
MOST_AXES = 4096


@dataclass(frozen=True, slots=True)
class FleetSettings:
    """One stage with many axes that are alike. ``limits`` are those of every axis.

    Attributes
    ----------
    axes : number of axes.
    models : model files from 'dehyst identify': one for all axes, or one for each.
    limits : limits of what the service sends to each axis.
    u_min_V : lowest voltage that the service sends.
    u_max_V : highest voltage that the service sends.
    slew_V_per_s : fastest change of the voltage.
    y_min_um : lowest displacement that is answered; default: no limit.
    y_max_um : highest displacement that is answered; default: no limit.
    gains : gain of each axis over the model's, where one model file is for all; [] for 1.
    device : 'cpu', or the device of torch that has the windows, as 'cuda'.
    threads : threads that share the axes of a step.
    snapshot_every : samples between two snapshots, which answer the queries.
    queue_samples : samples of all axes that may wait; more are counted and dropped.
    model_hz : highest rate at which changes of models are published.
    checkpoints : folder for one checkpoint of each axis.
    checkpoint_s : time in which each axis is written once.
    learner : settings of the learner of each axis, see docs/learner.md.
    """

    axes: Annotated[int, Setting(low=1, high=MOST_AXES, shown=True)]
    models: tuple[Path, ...]
    limits: Annotated[Limits, LIMITS]
    gains: tuple[float, ...] = ()
    device: str = "cpu"
    threads: Annotated[int, Setting(low=1, high=256)] = 2
    snapshot_every: Annotated[int, Setting(low=1, high=100_000)] = 20
    queue_samples: Annotated[int, Setting(low=1, high=1_000_000)] = 2000
    model_hz: Annotated[float, Setting(unit="1/s", low=0, above=True)] = 5.0
    checkpoints: Annotated[Path | None, Setting(example="checkpoints/fleet")] = None
    checkpoint_s: Annotated[float, Setting(unit="s", low=0.05, high=86_400)] = 60.0
    learner: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.models) not in (1, self.axes):
            raise FieldError("models", f"{len(self.models)} files", f"1 for all axes, or {self.axes}, one for each")
        if self.gains and (len(self.models) != 1 or len(self.gains) != self.axes):
            raise FieldError("gains", f"{len(self.gains)} gains", f"{self.axes} with one model file, or none")
        for i, gain in enumerate(self.gains):
            if not (math.isfinite(gain) and gain > 0.0):
                raise FieldError(f"gains[{i}]", gain, "a positive finite number")
