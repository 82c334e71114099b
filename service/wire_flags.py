"""What was done to a voltage, told with it: a byte of flags for each point of a reply."""

from __future__ import annotations

from typing import Final

#: What was done to a voltage, one bit each, as documented in docs/protocol.md.
LIMITED_VOLTAGE: Final = 1
LIMITED_SLEW: Final = 2
OUTSIDE_DOMAIN: Final = 4
NOT_FINITE_REPLACED: Final = 8
BLENDED: Final = 16
STAND_IN: Final = 32
STALE: Final = 64
FLAG_NAMES: Final = {
    LIMITED_VOLTAGE: "limited_voltage",
    LIMITED_SLEW: "limited_slew",
    OUTSIDE_DOMAIN: "outside_domain",
    NOT_FINITE_REPLACED: "not_finite_replaced",
    BLENDED: "blended",
    STAND_IN: "stand_in",
    STALE: "stale",
}


def flag_names(bits: int) -> list[str]:
    """The names of the bits set in a point's flags."""
    return [name for bit, name in FLAG_NAMES.items() if bits & bit]
