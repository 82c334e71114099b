"""Transfer of the state of an axis to a standby, in small parts and with low priority.

A router forwards the messages of one priority to one receiver in order. One message of five megabytes would delay all
messages behind it, answers and samples included, until a busy standby has read it. The state is therefore sent in parts
that are smaller than a network packet, with pauses, at low priority. A lost part ends the transfer; the standby then
asks again with longer pauses.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import zenoh

from service.protocol.container import fields_of
from service.protocol.errors import ServiceError
from service.security.authenticator import EVERYBODY, NO_KEY, Authenticator

#: Size of a part, bytes; a packet holds 64 KiB.
_PART_BYTES: Final = 56 * 1024
#: Most parts that are accepted, 256 MB together: a sender must not use up the memory of the receiver.
_MAX_PARTS: Final = 4681
#: Senders whose parts are joined at a time, at most.
_MOST_SENDERS: Final = 4
#: Time from the first part until those of other senders must have begun, s.
_OTHERS_S: Final = 0.2
#: Begin of each part: its index and the number of parts.
_PLACE: Final = struct.Struct("<II")
#: Pause between two parts, s: in the first transfer, and at most.
PAUSE_S, MAX_PAUSE_S = 0.001, 0.016
#: Longest silence before a part counts as lost: these seconds and that many pauses.
_SILENCE_S, _SILENCE_PAUSES = 0.5, 100
_POLL_S: Final = 0.002
#: Longest wait for a sign of life, and pause between two queries for one, s.
_LIFE_S, _LIFE_PAUSE_S = 0.5, 0.1


def send_state(query: zenoh.Query, key: str, buffers: Iterable[Any], authenticator: Authenticator = NO_KEY) -> None:
    """Answer ``query`` with the bytes of ``buffers`` in parts; its parameter ``pause_s`` sets the pause, s.

    Whether it may have them: `Authenticator.is_asked_by_ours`.
    """
    try:
        pause_s = float(query.parameters.get("pause_s") or PAUSE_S)
    except ValueError:
        pause_s = PAUSE_S
    pause_s = min(MAX_PAUSE_S, max(0.0, pause_s)) if pause_s == pause_s else PAUSE_S
    whole = memoryview(b"".join(buffers))
    starts = range(0, len(whole), _PART_BYTES)
    for i, start in enumerate(starts):
        part = _PLACE.pack(i, len(starts)) + whole[start : start + _PART_BYTES]
        query.reply(key, part, attachment=authenticator.answered(query, key, part))
        time.sleep(pause_s)


def fetch_state(
    session: zenoh.Session, key: str, timeout_s: float, pause_s: float = PAUSE_S, authenticator: Authenticator = NO_KEY
) -> bytes | None:
    """The bytes that `send_state` answers with; None if there is no reply or a part is lost.

    Raises ServiceError if all that came is from others than the instances of this service.
    """
    question = authenticator.question(f"pause_s={pause_s:g}", key=key)
    # Replies inherit priority and congestion control from their query.
    replies = session.get(
        f"{key}?pause_s={pause_s:g}",
        attachment=question.attachment,
        timeout=timeout_s,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_LOW,
        **EVERYBODY,
    )
    signed = unsigned = 0

    def parts() -> Iterator[tuple[str, bytes]]:
        """Whoever else answers must not even be waited for."""
        nonlocal signed, unsigned
        for reply in _until_silent(replies, _SILENCE_S + _SILENCE_PAUSES * pause_s):
            right = None if reply.ok is None else question.answer(reply.ok)
            signed += right is not None
            unsigned += right is None and reply.ok is not None
            if right is not None or reply.ok is None:  # an error reply is a part that fits nowhere
                yield str(reply.replier_id), b"" if right is None else right.payload

    for data in joined(parts()):
        return data
    if unsigned and not signed:
        raise ServiceError(f"{key}: a state came from somebody who does not know the key, or is of another release")
    return None


def joined(parts: Iterable[tuple[str, bytes]]) -> Iterator[bytes]:
    """What each sender has sent, as soon as it is whole, from (sender, part with its place) in any mixture.

    Ends `_OTHERS_S` after the first part where no sender is left whose parts fit together.
    """
    came: dict[str, list[bytes]] = {}
    counts: dict[str, int] = {}
    until_s = math.inf
    for sender, part in parts:
        until_s = min(until_s, time.monotonic() + _OTHERS_S)
        if came and not any(counts.values()) and time.monotonic() > until_s:
            return
        if sender in came or len(came) < _MOST_SENDERS:
            had = came.setdefault(sender, [])
            i, n = _PLACE.unpack_from(part) if len(part) >= _PLACE.size else (-1, 0)
            fits = i == len(had) < n <= _MAX_PARTS and counts.setdefault(sender, n) == n
            if not fits or len(part) > _PLACE.size + _PART_BYTES:
                counts[sender] = 0  # none of its parts fits any more
                had.clear()
                continue
            had.append(part[_PLACE.size :])
            if len(had) == n:
                yield b"".join(had)
                counts[sender] = 0


def tell_standbys(
    session: zenoh.Session, key: str, switch: bytes, timeout_s: float, authenticator: Authenticator = NO_KEY
) -> int:
    """Tell the standbys of a freeze or thaw (JSON). Count of those that hold it within ``timeout_s``; 0 at once where
    there is none."""
    question = authenticator.question(payload=switch, key=key)
    replies = session.get(key, payload=switch, attachment=question.attachment, timeout=timeout_s, **EVERYBODY)
    return sum(reply.ok is not None and question.answer(reply.ok) is not None for reply in replies)


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
        question = authenticator.question()
        replies = session.get(key, attachment=question.attachment, timeout=_LIFE_S, **EVERYBODY)
        for reply in _until_silent(replies, math.inf, wanted):
            signed = None if reply.ok is None else question.answer(reply.ok)
            if signed is not None and (status := fields_of(signed.payload)).get("instance") == instance:
                return status
        if not wanted():
            return None
        time.sleep(_LIFE_PAUSE_S)
    return None


def _until_silent(
    replies: zenoh.Handler[zenoh.Reply], silence_s: float, wanted: Callable[[], bool] = lambda: True
) -> Iterator[zenoh.Reply]:
    """Each reply, until the query ends, nothing arrives for ``silence_s``, or ``wanted`` is false."""
    last_s = time.monotonic()
    while time.monotonic() < last_s + silence_s and wanted():
        try:
            reply = replies.try_recv()
        except zenoh.ZError:
            return  # no more replies, or the query has timed out
        if reply is None:
            time.sleep(_POLL_S)
            continue
        last_s = time.monotonic()
        yield reply
