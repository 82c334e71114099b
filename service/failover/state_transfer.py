"""The state of an axis on its way to a standby: megabytes that must not make anybody wait.

A router passes the messages of a sender on in their order, and what it sends to one receiver at one priority too. One
message of five megabytes keeps all that come behind it waiting, answers and samples of others included, until a standby
that has no processor just then has read it. So it goes in parts of less than a packet of the network's, with pauses,
behind everything else, and is given up, to be asked for again, rather than waited for.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterable, Iterator
from typing import Any, Final

import zenoh

#: Of one part; a packet holds 64 KiB.
_PART_BYTES: Final = 56 * 1024
#: So many make no state of ours any more, 256 MB; whoever sends them is not to fill this end's memory.
_MOST_PARTS: Final = 4681
#: With each part: its index, and how many there are.
_PLACE: Final = struct.Struct("<II")
#: Pauses between two parts, s: the first time that it is asked for, and at most.
PAUSE_S, MOST_PAUSE_S = 0.001, 0.016
#: Silence after which a part, the end, or the question is taken for lost, s, and pauses on top of it: who asks again
#: asks for longer ones, and is patient with a machine that is busy.
_SILENT_S, _SILENT_PAUSES = 0.5, 100
_LOOK_S: Final = 0.002


def send_state(query: zenoh.Query, key: str, buffers: Iterable[Any]) -> None:
    """Answer ``query`` with the bytes of ``buffers``; at the pace that its parameter ``pause_s`` asks for."""
    try:
        pause_s = float(query.parameters.get("pause_s") or PAUSE_S)
    except ValueError:
        pause_s = PAUSE_S
    pause_s = min(MOST_PAUSE_S, max(0.0, pause_s)) if pause_s == pause_s else PAUSE_S
    whole = memoryview(b"".join(buffers))
    starts = range(0, len(whole), _PART_BYTES)
    for i, start in enumerate(starts):
        part = bytes(whole[start : start + _PART_BYTES])
        query.reply(key, part, attachment=_PLACE.pack(i, len(starts)))
        time.sleep(pause_s)


def ask_for_state(session: zenoh.Session, key: str, timeout_s: float, pause_s: float = PAUSE_S) -> bytes | None:
    """The bytes that `send_state` answers with, or None where nobody does, or not all came: this end was too slow."""
    # Replies are of the kind of their query.
    replies = session.get(
        f"{key}?pause_s={pause_s:g}",
        timeout=timeout_s,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_LOW,
    )
    return join(_parts(replies, _SILENT_S + _SILENT_PAUSES * pause_s))


def join(parts: Iterable[tuple[bytes, bytes]]) -> bytes | None:
    """The whole of its parts, each after its place, as soon as it is whole; None at the first that is not the next."""
    whole, taken, of = bytearray(), 0, 0
    for place, part in parts:
        if len(place) != _PLACE.size:
            return None
        i, n = _PLACE.unpack(place)
        if i != taken or not taken < n <= _MOST_PARTS or (taken and n != of) or len(part) > _PART_BYTES:
            return None
        whole += part
        taken, of = taken + 1, n
        if taken == of:
            return bytes(whole)
    return None


def _parts(replies: zenoh.Handler[zenoh.Reply], silent_s: float) -> Iterator[tuple[bytes, bytes]]:
    """Places and parts as they come, until there are no more: the end may be lost like any part of them."""
    heard = time.monotonic()
    while time.monotonic() < heard + silent_s:
        try:
            reply = replies.try_recv()
        except zenoh.ZError:
            return  # that was all, or the question's time is over
        if reply is None:
            time.sleep(_LOOK_S)
            continue
        heard = time.monotonic()
        place = reply.ok.attachment if reply.ok is not None else None
        yield (b"", b"") if reply.ok is None or place is None else (place.to_bytes(), reply.ok.payload.to_bytes())
