"""What the instances of a service ask each other: for the state of an axis, to take it anew, for a sign of life."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from dehyst.service.protocol.container import fields_of
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.security.authenticator import NO_KEY, Authenticator

#: Answer of a standby that has taken the state since it was asked to.
HELD: Final = b"held"
#: Longest wait for a sign of life, and pause between two queries for one, s.
_LIFE_S, _LIFE_PAUSE_S = 0.5, 0.1


def fetch_state(
    session: zenoh.Session,
    key: str,
    timeout_s: float,
    authenticator: Authenticator = NO_KEY,
    wanted: Callable[[], bool] = lambda: True,
) -> bytes | None:
    """The state that the serving instance sends on ``key`` in one reply; None where none comes within ``timeout_s``.

    It has a low priority and may be dropped, so that nobody waits behind a standby that reads slowly. Ends at once when
    ``wanted`` is false. Raises ServiceError if all that came is from others than the instances of this service.
    """
    unsigned = False
    for reply, signed in authenticator.ask(
        session, key, timeout_s, sign=True, wanted=wanted,
        congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW,
    ):  # fmt: skip
        if signed is not None:
            return signed.payload
        unsigned |= reply.ok is not None  # anybody may refuse
    if unsigned:
        raise ServiceError(f"{key}: a state came from somebody who does not know the key, or is of another release")
    return None


def tell_standbys(session: zenoh.Session, key: str, timeout_s: float, authenticator: Authenticator = NO_KEY) -> int:
    """Have the standbys take the state anew, because an operator has changed it. Count of those that have taken it
    within ``timeout_s``; 0 at once where there is none."""
    replies = authenticator.ask(session, key, timeout_s, sign=True)
    return sum(signed is not None and signed.payload == HELD for _, signed in replies)


def status_of(
    session: zenoh.Session,
    key: str,
    instance: str,
    timeout_s: float,
    authenticator: Authenticator = NO_KEY,
    wanted: Callable[[], bool] = lambda: True,
) -> dict[str, Any] | None:
    """The status on ``key`` of ``instance``, a sign of life; None where it does not answer within ``timeout_s``.

    It is asked as often as fits into that time even if this process stands still meanwhile: it is then not the other
    one that is silent. Ends at once when ``wanted`` is false.
    """
    until = time.monotonic() + timeout_s
    left = math.ceil(timeout_s / _LIFE_S)
    while left > 0 or time.monotonic() < until:
        left -= 1
        for _, signed in authenticator.ask(session, key, _LIFE_S, wanted=wanted):
            if signed is not None and (status := fields_of(signed.payload)).get("instance") == instance:
                return status
        if not wanted():
            return None
        time.sleep(_LIFE_PAUSE_S)
    return None
