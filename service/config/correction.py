"""Settings of the corrections on top of the feedforward: tables ``[axis.correction]`` and ``[axis.repetition]``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from dehyst.service.config.schema import Setting

_MODE = Setting(unit="Hz", low=1, high=100_000)
_FADE = Setting(unit="s", low=0.01, high=60)


@dataclass(frozen=True, slots=True)
class CorrectionConfig:
    """When voltages are corrected by fresh readings, see docs/correction.md.

    Attributes
    ----------
    on : true: followers correct by the readings that they are given, answers to queries by the samples.
    share : largest correction as a share of the voltage range.
    mode_Hz : lowest frequency at which the stage rings ('dehyst modes'), with the heaviest payload.
    fade_s : time over which a correction without good readings is let go.
    """

    on: bool = False
    share: Annotated[float, Setting(low=0, above=True, high=1)] = 0.02
    mode_Hz: Annotated[float, _MODE] = 100.0
    fade_s: Annotated[float, _FADE] = 0.5


@dataclass(frozen=True, slots=True)
class RepetitionConfig:
    """When a follower corrects motion that repeats by the pass before, see docs/correction.md.

    Attributes
    ----------
    on : true: followers correct motion that repeats by the readings of the pass before.
    share : largest correction, and largest residual not in doubt, as a share of the voltage range.
    mode_Hz : lowest frequency at which the stage rings ('dehyst modes'), with the heaviest payload.
    fade_s : time over which a correction without good readings is let go.
    """

    on: bool = False
    share: Annotated[float, Setting(low=0, above=True, high=1)] = 0.1
    mode_Hz: Annotated[float, _MODE] = 100.0
    fade_s: Annotated[float, _FADE] = 0.5
