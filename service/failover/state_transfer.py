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

from service.protocol.container import JSON
from service.protocol.errors import FieldError, ServiceError, error_to_json
from service.security.peers import Nonces, PeerSecret, new_nonce

#: Size of a part, bytes; a packet holds 64 KiB.
_PART_BYTES: Final = 56 * 1024
#: Most parts that are accepted, 256 MB together: a sender must not use up the memory of the receiver.
_MAX_PARTS: Final = 4681
#: Senders whose parts are joined at a time, at most.
_MOST_SENDERS: Final = 4
#: Time from the first part until those of other senders must have begun, s.
_OTHERS_S: Final = 0.2
#: Attachment of each part: its index and the number of parts, and then its signature.
_PLACE: Final = struct.Struct("<II")
#: Pause between two parts, s: in the first transfer, and at most.
PAUSE_S, MAX_PAUSE_S = 0.001, 0.016
#: Longest silence before a part counts as lost: these seconds and that many pauses.
_SILENCE_S, _SILENCE_PAUSES = 0.5, 100
_POLL_S: Final = 0.002
#: Longest wait for a sign of life, and pause between two queries for one, s.
_LIFE_S, _LIFE_PAUSE_S = 0.5, 0.1
NO_SECRET: Final = PeerSecret()


class UnprovenError(ServiceError):
    """A message does not prove that its sender is an instance of this service."""


def check_asker(query: zenoh.Query, key: str, secret: PeerSecret, taken: Nonces) -> None:
    """Raise UnprovenError if ``query`` does not prove that an instance of the same service asks, and for the first
    time.

    It takes microseconds: do it before anything that costs more. ``taken`` : the numbers of all proofs on this key.
    """
    nonce = str(query.parameters.get("nonce") or "")
    if not secret.proves(str(query.parameters.get("proof") or ""), "ask", key, nonce):
        raise UnprovenError("the state is for instances of this service only; see peer_secret in docs/operating.md")
    if secret and not taken.is_new(nonce):
        raise UnprovenError("this proof was used before: ask with a new nonce")


def send_state(query: zenoh.Query, key: str, buffers: Iterable[Any], secret: PeerSecret = NO_SECRET) -> None:
    """Answer ``query`` with the bytes of ``buffers`` in parts; its parameter ``pause_s`` sets the pause, s.

    Whether it may have them: `check_asker`.
    """
    nonce = str(query.parameters.get("nonce") or "")
    try:
        pause_s = float(query.parameters.get("pause_s") or PAUSE_S)
    except ValueError:
        pause_s = PAUSE_S
    pause_s = min(MAX_PAUSE_S, max(0.0, pause_s)) if pause_s == pause_s else PAUSE_S
    whole = memoryview(b"".join(buffers))
    starts = range(0, len(whole), _PART_BYTES)
    for i, start in enumerate(starts):
        part = bytes(whole[start : start + _PART_BYTES])
        place = _PLACE.pack(i, len(starts))
        query.reply(key, part, attachment=place + _signed(secret, key, nonce, place, part))
        time.sleep(pause_s)


def _signed(secret: PeerSecret, key: str, nonce: str, place: bytes, part: bytes) -> bytes:
    """The signature of a part at its place; empty without a secret."""
    return secret.sign("part", key, nonce, place, part).encode()


def fetch_state(
    session: zenoh.Session, key: str, timeout_s: float, pause_s: float = PAUSE_S, secret: PeerSecret = NO_SECRET
) -> bytes | None:
    """The bytes that `send_state` answers with; None if there is no reply or a part is lost.

    Raises UnprovenError if nobody but such as do not prove that they are an instance of the same service has sent
    anything.
    """
    nonce = new_nonce()
    proof = f";nonce={nonce};proof={secret.sign('ask', key, nonce)}" if secret else ""
    # Replies inherit priority and congestion control from their query.
    replies = session.get(
        f"{key}?pause_s={pause_s:g}{proof}",
        timeout=timeout_s,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_LOW,
    )
    proven = unproven = 0

    def signed_parts() -> Iterator[tuple[str, bytes, bytes]]:
        """The parts that an instance of this service signed: whoever else answers must not even be waited for."""
        nonlocal proven, unproven
        for sender, attached, part in _parts(replies, _SILENCE_S + _SILENCE_PAUSES * pause_s):
            place = attached[: _PLACE.size] if secret else attached
            if secret and attached[_PLACE.size :] != _signed(secret, key, nonce, place, part):
                unproven += bool(attached)  # else it is an error reply
                continue
            proven += 1
            yield sender, place, part

    for data in joined_by_sender(signed_parts()):
        return data
    if unproven and not proven:
        raise UnprovenError(
            f"{key}: a state came from somebody who does not know the secret of this service's instances, or is of "
            "another release"
        )
    return None


# --- A freeze or thaw, which each standby must hold before it is answered.


def tell_standbys(
    session: zenoh.Session, key: str, switch: bytes, timeout_s: float, secret: PeerSecret = NO_SECRET
) -> int:
    """Count of the standbys that hold ``switch`` (JSON) within ``timeout_s``; 0 at once where there is none."""
    nonce = new_nonce()
    replies = session.get(
        f"{key}?nonce={nonce};proof={secret.sign('switch', key, nonce, switch)}",
        payload=switch,
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    said = (reply.ok.payload.to_bytes().decode("ascii", "replace") for reply in replies if reply.ok is not None)
    return sum(secret.proves(text, "held", key, nonce) for text in said)


def told_switch(query: zenoh.Query, key: str, secret: PeerSecret, taken: Nonces) -> bytes | None:
    """The switch in a query of `tell_standbys`; None if it does not prove that an instance of this service asks, or
    if its proof is among those that were ``taken`` before."""
    payload = b"" if query.payload is None else query.payload.to_bytes()
    nonce, proof = (str(query.parameters.get(name) or "") for name in ("nonce", "proof"))
    if not secret.proves(proof, "switch", key, nonce, payload) or (secret and not taken.is_new(nonce)):
        return None
    return payload


def confirm_switch(query: zenoh.Query, key: str, secret: PeerSecret = NO_SECRET) -> None:
    """Answer a query of `tell_standbys`: this standby holds the switch."""
    query.reply(key, secret.sign("held", key, str(query.parameters.get("nonce") or "")).encode())


# --- Whether an instance answers.


def send_sign_of_life(query: zenoh.Query, key: str, instance: str, secret: PeerSecret = NO_SECRET) -> bool:
    """Answer ``query`` if it asks for a sign of life; whether it does. Of another instance than this: an error."""
    wanted = query.parameters.get("alive")
    if wanted is None:
        return False
    nonce = str(query.parameters.get("nonce") or "")
    with query:
        if str(wanted) == instance:
            query.reply(key, (secret.sign("alive", key, instance, nonce) or instance).encode())
        else:
            refusal = FieldError("alive", repr(str(wanted))[:80], f"{instance!r}, the instance that answers here")
            query.reply_err(error_to_json(refusal), encoding=JSON)
    return True


def gives_sign_of_life(
    session: zenoh.Session,
    key: str,
    instance: str,
    timeout_s: float,
    secret: PeerSecret = NO_SECRET,
    wanted: Callable[[], bool] = lambda: True,
) -> bool:
    """Whether ``instance`` answers queries, and proves that it knows ``secret``, within ``timeout_s``.

    It is asked as often as fits into that time even if this process stands still meanwhile: it is then not the other
    one that is silent. Ends at once when ``wanted`` is false.
    """
    until = time.monotonic() + timeout_s
    left = math.ceil(timeout_s / _LIFE_S)
    while left > 0 or time.monotonic() < until:
        left -= 1
        nonce = new_nonce()
        replies = session.get(
            f"{key}?alive={instance};nonce={nonce}",
            timeout=_LIFE_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for said in _said(replies, wanted):
            if secret.proves(said, "alive", key, instance, nonce) if secret else said == instance:
                return True
        if not wanted():
            return False
        time.sleep(_LIFE_PAUSE_S)
    return False


def _said(replies: zenoh.Handler[zenoh.Reply], wanted: Callable[[], bool]) -> Iterator[str]:
    """The text of each reply, until the query ends or ``wanted`` is false."""
    while wanted():
        try:
            reply = replies.try_recv()
        except zenoh.ZError:
            return
        if reply is None:
            time.sleep(_POLL_S)
        elif reply.ok is not None:
            yield reply.ok.payload.to_bytes().decode("ascii", "replace")


class PartJoiner:
    """Joins the parts of one sender.

    Attributes
    ----------
    spoilt : whether a part is missing or malformed. done : whether the whole has come.
    """

    def __init__(self) -> None:
        self.spoilt = self.done = False
        self._joined, self._taken, self._total = bytearray(), 0, 0

    def take(self, place: bytes, part: bytes) -> bytes | None:
        """The whole after its last part, given with its attachment; else None."""
        if self.spoilt or self.done:
            return None
        i, n = _PLACE.unpack(place) if len(place) == _PLACE.size else (-1, 0)
        taken = self._taken
        if i != taken or not taken < n <= _MAX_PARTS or (taken and n != self._total) or len(part) > _PART_BYTES:
            self.spoilt = True
            self._joined.clear()
            return None
        self._joined += part
        self._taken, self._total = taken + 1, n
        self.done = self._taken == n
        return bytes(self._joined) if self.done else None


def join_parts(parts: Iterable[tuple[bytes, bytes]]) -> bytes | None:
    """The joined parts of one sender, given as (attachment, part); None if one is missing or malformed."""
    joiner = PartJoiner()
    for place, part in parts:
        whole = joiner.take(place, part)
        if joiner.done or joiner.spoilt:
            return whole
    return None


def joined_by_sender(parts: Iterable[tuple[str, bytes, bytes]]) -> Iterator[bytes]:
    """What each sender has sent, as soon as it is whole, from parts (sender, attachment, part) in any mixture.

    Ends `_OTHERS_S` after the first part where no sender is left whose parts fit together.
    """
    joiners: dict[str, PartJoiner] = {}
    others_until_s = math.inf
    for sender, place, part in parts:
        others_until_s = min(others_until_s, time.monotonic() + _OTHERS_S)
        if joiners and all(joiner.spoilt for joiner in joiners.values()) and time.monotonic() > others_until_s:
            return
        if sender not in joiners and len(joiners) >= _MOST_SENDERS:
            continue
        whole = joiners.setdefault(sender, PartJoiner()).take(place, part)
        if whole is not None:
            yield whole


def _parts(replies: zenoh.Handler[zenoh.Reply], silence_s: float) -> Iterator[tuple[str, bytes, bytes]]:
    """(sender, attachment, part) of each reply, until the query ends or nothing arrives for ``silence_s``."""
    last_s = time.monotonic()
    while time.monotonic() < last_s + silence_s:
        try:
            reply = replies.try_recv()
        except zenoh.ZError:
            return  # no more replies, or the query has timed out
        if reply is None:
            time.sleep(_POLL_S)
            continue
        last_s = time.monotonic()
        sender, ok = str(reply.replier_id), reply.ok
        place = None if ok is None else ok.attachment
        yield (sender, b"", b"") if ok is None or place is None else (sender, place.to_bytes(), ok.payload.to_bytes())
