"""Delivery of messages that are sent only once, and whether a publisher has subscribers."""

from __future__ import annotations

import time
from typing import Any, Final

import zenoh

#: For messages that are sent only once. Zenoh's default drops a message silently if two others wait and the sending
#: thread gets no processor for a millisecond: 0.2 to 7 % of bursts of five small messages on two busy cores.
SURELY: Final = zenoh.CongestionControl.BLOCK
_PAUSE_S: Final = 0.01


def is_followed(publisher: Any) -> bool:
    """Whether ``publisher`` has subscribers, as far as its session knows."""
    status = publisher.matching_status
    # By its type stub a plain truth value; in this release an object that is always true.
    return status if isinstance(status, bool) else bool(status.matching)


def wait_followed(publisher: Any, within_s: float) -> bool:
    """Wait up to ``within_s`` s for a subscriber of ``publisher``; whether there is one."""
    until = time.monotonic() + within_s
    while not is_followed(publisher):
        if time.monotonic() >= until:
            return False
        time.sleep(_PAUSE_S)
    return True
