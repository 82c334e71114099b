"""What the instances of a service ask each other: for the state of an axis, for a sign of life, to hold a switch.

A standby fetches the state part by part, each with a query of its own, with low priority. A part is smaller than a
network packet: one message of megabytes would make all others of its sender wait, or be dropped whole, where the
standby is too busy to read it. A slow standby gets no more than it reads, and asks again for a part that is lost.
"""

from __future__ import annotations

import math
import secrets
import struct
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from dehyst.service.protocol.container import fields_of
from dehyst.service.protocol.errors import FieldError, ServiceError
from dehyst.service.security.authenticator import NO_KEY, Authenticator

#: Size of a part, bytes; a packet holds 64 KiB.
_PART_BYTES: Final = 56 * 1024
#: Most parts that are accepted, 256 MB together: a sender must not use up the memory of the receiver.
_MAX_PARTS: Final = 4681
#: Begin of each part: the number of parts.
_COUNT: Final = struct.Struct("<I")
#: How often a part is asked for that gets no reply, and the pause before the next time, s.
_TRIES, _PAUSE_S = 4, 0.02
#: Longest wait for a sign of life, and pause between two queries for one, s.
_LIFE_S, _LIFE_PAUSE_S = 0.5, 0.1


def part_of(state: bytes, number: int) -> tuple[bytes, int]:
    """Part ``number`` of a state, from 0 on, as it is sent, and how many there are. InputError where it is none."""
    count = max(1, math.ceil(len(state) / _PART_BYTES))
    if not 0 <= number < count:
        raise FieldError("part", number, f"0 to {count - 1}")
    return _COUNT.pack(count) + state[number * _PART_BYTES : (number + 1) * _PART_BYTES], count


def fetch_state(
    session: zenoh.Session,
    key: str,
    timeout_s: float,
    authenticator: Authenticator = NO_KEY,
    wanted: Callable[[], bool] = lambda: True,
) -> bytes | None:
    """The state that the serving instance sends on ``key``; None where a part does not come within ``timeout_s``.

    Ends at once when ``wanted`` is false. Raises ServiceError if all that came is from others than the instances
    of this service.
    """
    transfer, parts, count, tries = secrets.token_hex(8), list[bytes](), 1, 0
    while len(parts) < count:
        unsigned = False
        for reply, signed in authenticator.ask(
            session, key, timeout_s, f"transfer={transfer};part={len(parts)}", sign=True, wanted=wanted,
            congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW,
        ):  # fmt: skip
            if signed is None:  # anybody may refuse, or send anything
                unsigned |= reply.ok is not None
                continue
            part = signed.payload
            n = _COUNT.unpack_from(part)[0] if _COUNT.size <= len(part) <= _COUNT.size + _PART_BYTES else 0
            if not len(parts) < n <= _MAX_PARTS or (parts and n != count):
                return None
            parts.append(part[_COUNT.size :])
            count, tries = n, 0
            break
        else:
            if unsigned:
                detail = "a state came from somebody who does not know the key, or is of another release"
                raise ServiceError(f"{key}: {detail}")
            tries += 1
            if tries == _TRIES or not wanted():
                return None
            time.sleep(_PAUSE_S)
    return b"".join(parts)


def tell_standbys(
    session: zenoh.Session, key: str, switch: bytes, timeout_s: float, authenticator: Authenticator = NO_KEY
) -> int:
    """Tell the standbys of an operator's verb (JSON). Count of those that say within ``timeout_s`` that they hold it; 0
    at once where there is none."""
    replies = authenticator.ask(session, key, timeout_s, payload=switch, sign=True)
    return sum(signed is not None for _, signed in replies)


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
