"""How the limits of an axis, or of each axis of a fleet, are described in a configuration."""

from __future__ import annotations

from dehyst.service.config.schema import Setting


def limits_setting(help_text: str, lowest: str, highest: str) -> Setting:
    """The setting of a `Limits` whose entries are keys of the table itself; the texts say what they are for."""
    return Setting(
        help=help_text,
        inline={
            "u_min_V": Setting(help="lowest voltage that the service sends", unit="V", example=0.0),
            "u_max_V": Setting(help="highest voltage that the service sends", unit="V", example=10.0),
            "slew_V_per_s": Setting(help="fastest change of the voltage", unit="V/s", example=2000.0),
            "y_min_um": Setting(help=lowest, unit="µm", example=-5.0),
            "y_max_um": Setting(help=highest, unit="µm", example=95.0),
        },
    )
