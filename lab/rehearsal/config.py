"""The configuration of a rehearsal."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dehyst.lab.rehearsal.reference import ReferenceMaker
from dehyst.service.config.settings import COMPETE
from dehyst.service.protocol.errors import FieldError


@dataclass(frozen=True, slots=True)
class RehearsalConfig:
    """The configuration of a rehearsal; defaults are those of the service.

    Attributes
    ----------
    identify_s : length of the excitation, s. support : number of support vectors of the model.
    excite_low_V, excite_high_V : range of the excitation, V; None: the limits of the drive.
    settle_s : closed loop before the event, s. after_s : closed loop after the event has come completely or ended, s.
    block : samples per query. snapshot_every : samples between two snapshots, as in the axis' configuration.
    band : range of the reference, as shares of the identified displacement range.
    slew_V_per_s : slew limit of the axis, V/s; None: 500 spans of the drive per second.
    compete : models that are identified beside the one that learns; they compete with it and replace it if needed. Of
    "linear", "mpi", "bouc_wen"; empty for none.
    learner : settings of the learner, as in the table ``[axis.learner]`` of a configuration.
    reference : makes the motion of a run; None: ramps, holds and tones at random speeds.

    Raises FieldError on values out of range.
    """

    identify_s: float = 10.0
    support: int = 500
    excite_low_V: float | None = None
    excite_high_V: float | None = None
    settle_s: float = 4.0
    after_s: float = 5.0
    block: int = 5
    snapshot_every: int = 5
    band: tuple[float, float] = (0.1, 0.9)
    slew_V_per_s: float | None = None
    compete: tuple[str, ...] = ("linear",)
    learner: dict[str, Any] = field(default_factory=dict)
    reference: ReferenceMaker | None = None

    def __post_init__(self) -> None:
        if not 1.0 <= self.identify_s <= 1000.0:
            raise FieldError("identify_s", f"{self.identify_s:g} s", "1 to 1000 s")
        if not (2.0 <= self.settle_s <= 1e4 and 4.0 <= self.after_s <= 1e4):
            raise FieldError(
                "settle_s, after_s", f"{self.settle_s:g} s, {self.after_s:g} s", "at least 2 s before and 4 s after"
            )
        if not (1 <= self.block <= 512 and 1 <= self.snapshot_every <= 100_000):
            raise FieldError("block, snapshot_every", f"{self.block}, {self.snapshot_every}", "1 to 512, 1 to 100000")
        if not 0.0 <= self.band[0] < self.band[1] <= 1.0:
            raise FieldError("band", f"{self.band}", "two shares of the identified range, the first one lower")
        if unknown := [name for name in self.compete if name not in COMPETE]:
            raise FieldError("compete", repr(unknown[0]), f"some of {', '.join(COMPETE)}")
