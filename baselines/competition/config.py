"""Configuration of a competition. Imports no numerics, because the service configuration imports it."""

from __future__ import annotations

from dataclasses import dataclass, fields

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import StateDict


@dataclass(frozen=True, slots=True)
class CompetitionConfig:
    """How contestants are scored and how the champion is replaced.

    Attributes
    ----------
    block : samples between two judgements.
    serving_age_s : age of the snapshots that are scored: that of the models that callers have.
    horizon_s : time constant of the mean square error, of scored motion.
    margin : factor by which the champion's rms error must exceed a challenger's.
    floor : difference of the two errors beyond that, share of the voltage span.
    patience_s : scored motion for which both must hold; the favourite returns at once, without margin and floor.
    blend_s : duration of a change of champion.

    Raises InputError on a value out of range.
    """

    block: int = 20
    serving_age_s: float = 0.08
    horizon_s: float = 0.25
    margin: float = 1.25
    floor: float = 0.0005
    patience_s: float = 0.5
    blend_s: float = 0.05

    def __post_init__(self) -> None:
        if self.block < 1:
            raise InputError(f"block: got {self.block}, expected at least 1 sample")
        if not (self.margin >= 1.0 and 0.0 <= self.floor < 1.0):
            raise InputError(f"margin, floor: got {self.margin}, {self.floor}, expected at least 1, and 0 to 1")
        if not self.horizon_s > 0.0:
            raise InputError(f"horizon_s: got {self.horizon_s}, expected a positive number")
        for name in ("serving_age_s", "patience_s", "blend_s"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise InputError(f"{name}: got {getattr(self, name)}, expected 0 to 100 s")

    def state_dict(self) -> StateDict:
        """Values by field name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}
