"""What the processes of a soak have in common: the names on the wire, and the task of its controller."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

STAGE, AXIS = "soak", "x"
SERVED = "lssvm_adaptive"


@dataclass(frozen=True, slots=True)
class Control:
    """What the controller does.

    Attributes
    ----------
    dt_s : sample time, s. low_um, high_um : range of the reference, µm. seed : of the reference.
    block, lead : ticks a query, and ticks that it is asked ahead.
    u_min_V, u_max_V, slew_V_per_s : the limits that every voltage is checked against.
    """

    dt_s: float
    low_um: float
    high_um: float
    seed: int
    u_min_V: float
    u_max_V: float
    slew_V_per_s: float
    block: int = 20
    lead: int = 60

    @property
    def range_um(self) -> float:
        """Commanded range, to which all percentages refer."""
        return self.high_um - self.low_um

    def write(self, path: Path) -> None:
        """For the controller's process."""
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")
