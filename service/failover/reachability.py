"""Whether an instance behind routers is connected to one of them.

An instance that loses its router sees the claims of all others disappear. It must not take over then: nobody could
query it, and after the reconnection two instances would serve, of which the one that never failed would stand down.
"""

from __future__ import annotations

import time
from typing import Final

import zenoh

#: Time from the loss of a claim until the loss of the router is known too, s; 5 ms were measured.
_ROUTER_LOSS_KNOWN_S: Final = 0.02
#: Time from a reconnection until the claims behind the router are known, s.
_CLAIMS_KNOWN_S: Final = 0.5


class Reachability:
    """Reachability of one session.

    Parameters
    ----------
    behind_routers : True if others reach this instance through routers only: it listens at no endpoint.
    """

    def __init__(self, session: zenoh.Session, behind_routers: bool) -> None:
        self._session = session
        self._behind_routers = behind_routers
        self._unconnected_at = -_CLAIMS_KNOWN_S

    def is_cut_off(self) -> bool:
        """True if missing claims do not show that the others have failed. Takes 20 ms; do not call it in a callback."""
        if not self._behind_routers:
            return False
        time.sleep(_ROUTER_LOSS_KNOWN_S)
        now = time.monotonic()
        if not self._session.info.routers_zid():
            self._unconnected_at = now
        return now - self._unconnected_at < _CLAIMS_KNOWN_S
