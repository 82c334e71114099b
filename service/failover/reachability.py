"""Whether an instance behind routers is on the wire at all.

One that has lost its router hears that everybody has gone, when it is itself that has: nobody could ask it if it took
over, and when the router is there again two would serve, of which the one that never stopped had to stand down.
"""

from __future__ import annotations

import time
from typing import Final

import zenoh

#: So long after the wire has told that somebody has gone it is known whether one's own router has, s; seen: 5 ms.
_KNOWN_S: Final = 0.02
#: So long after a router is there again everybody behind it has been heard of, s; they come with it.
_HEARD_S: Final = 0.5


class Reach:
    """Of one session.

    Parameters
    ----------
    behind_routers : whether others reach it through routers only, as they do a service that listens nowhere.
    """

    def __init__(self, session: zenoh.Session, behind_routers: bool) -> None:
        self._session = session
        self._behind_routers = behind_routers
        self._without_at = -_HEARD_S

    def cut_off(self) -> bool:
        """Whether that nobody is heard of says nothing about them. Takes 20 ms behind routers; in no callback."""
        if not self._behind_routers:
            return False
        time.sleep(_KNOWN_S)
        now = time.monotonic()
        if not self._session.info.routers_zid():
            self._without_at = now
        return now - self._without_at < _HEARD_S
