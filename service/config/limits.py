"""How the limits of an axis, or of each axis of a fleet, are described in a configuration."""

from __future__ import annotations

from typing import Final

from dehyst.service.config.schema import Setting

#: The setting of a `Limits` whose entries are keys of the table itself.
LIMITS: Final = Setting(
    inline={
        "u_min_V": Setting(unit="V", example=0.0),
        "u_max_V": Setting(unit="V", example=10.0),
        "slew_V_per_s": Setting(unit="V/s", example=2000.0),
        "y_min_um": Setting(unit="µm", example=-5.0),
        "y_max_um": Setting(unit="µm", example=95.0),
    }
)
