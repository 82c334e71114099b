"""Settings of the correction on top of the feedforward: an ``[axis.correction]`` table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from service.config.schema import Setting


@dataclass(frozen=True, slots=True)
class CorrectionConfig:
    """When a follower corrects its voltages by fresh readings, see docs/correction.md."""

    on: Annotated[bool, Setting(help="true: followers correct their voltages by the readings that they are given")] = (
        False
    )
    share: Annotated[
        float, Setting(help="largest correction as a share of the voltage range", low=0, above=True, high=1)
    ] = 0.02
    mode_Hz: Annotated[
        float,
        Setting(
            help="lowest frequency at which the stage rings ('dehyst modes'), with the heaviest payload",
            unit="Hz",
            low=1,
            high=100_000,
        ),
    ] = 100.0
    fade_s: Annotated[
        float, Setting(help="time over which a correction without good readings is let go", unit="s", low=0.01, high=60)
    ] = 0.5
