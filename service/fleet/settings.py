"""The ``[fleet]`` table of a configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from dehyst.service.answers.guard import Limits
from dehyst.service.config.limits import limits_setting
from dehyst.service.config.schema import Setting
from dehyst.service.protocol.errors import FieldError

#: Most axes of a fleet: what a message for all may hold.
MOST_AXES = 4096


@dataclass(frozen=True, slots=True)
class FleetSettings:
    """One stage with many axes that are alike. ``limits`` are those of every axis."""

    axes: Annotated[int, Setting(help="number of axes", low=1, high=MOST_AXES, shown=True)]
    models: Annotated[
        tuple[Path, ...],
        Setting(help="model files from 'dehyst identify': one for all axes, or one for each"),
    ]
    limits: Annotated[
        Limits,
        limits_setting(
            "limits of what the service sends to each axis",
            "lowest displacement that is answered; default: no limit",
            "highest displacement that is answered; default: no limit",
        ),
    ]
    gains: Annotated[
        tuple[float, ...],
        Setting(help="gain of each axis over the model's, where one model file is for all; [] for 1"),
    ] = ()
    device: Annotated[str, Setting(help="'cpu', or the device of torch that has the windows, as 'cuda'")] = "cpu"
    threads: Annotated[int, Setting(help="threads that share the axes of a step", low=1, high=256)] = 2
    snapshot_every: Annotated[
        int, Setting(help="samples between two snapshots, which answer the queries", low=1, high=100_000)
    ] = 20
    queue_samples: Annotated[
        int, Setting(help="samples of all axes that may wait; more are counted and dropped", low=1, high=1_000_000)
    ] = 2000
    model_hz: Annotated[
        float, Setting(help="highest rate at which changes of models are published", unit="1/s", low=0, above=True)
    ] = 5.0
    checkpoints: Annotated[
        Path | None,
        Setting(help="folder for one checkpoint of each axis", example="checkpoints/fleet"),
    ] = None
    checkpoint_s: Annotated[
        float, Setting(help="time in which each axis is written once", unit="s", low=0.05, high=86400)
    ] = 60.0
    learner: Annotated[dict[str, Any], Setting(help="settings of the learner of each axis, see docs/learner.md")] = (
        field(default_factory=dict)
    )

    def __post_init__(self) -> None:
        if len(self.models) not in (1, self.axes):
            raise FieldError("models", f"{len(self.models)} files", f"1 for all axes, or {self.axes}, one for each")
        if self.gains and (len(self.models) != 1 or len(self.gains) != self.axes):
            raise FieldError("gains", f"{len(self.gains)} gains", f"{self.axes} with one model file, or none")
        for i, gain in enumerate(self.gains):
            if not (math.isfinite(gain) and gain > 0.0):
                raise FieldError(f"gains[{i}]", gain, "a positive finite number")
