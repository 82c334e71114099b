"""Message authentication: a short tag under a key that a service shares with its standbys, clients and stage.

Everything that is acted upon carries 32 bytes, as zenoh's attachment: a *stamp* of 16 bytes, and a *tag* of 16 bytes,
the keyed BLAKE2b of kind, key, stamp and payload (docs/protocol.md, "Authenticator").

- A query has a random stamp. Its reply is bound to it, to the query's parameters and to its payload: a recorded reply
  answers no other query.
- Replies and publications have the sender and a rising number as their stamp. A publication counts once, in order, and
  only of the sender that the last reply came from (`Heard`).
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import logging
import os
import secrets
import struct
import threading
import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from dehyst.service.protocol.errors import FieldError

_LOGGER: Final = logging.getLogger("dehyst.security")
#: Environment variable with the path of the key; `OPEN`: without one.
VARIABLE: Final = "DEHYST_KEY"
OPEN: Final = "-"
#: Fewest and most bytes of a key.
_LEAST, _MOST = 16, 64
#: Bytes of a stamp, of the sender in it, and of a tag.
STAMP, SENDER, TAG = 16, 8, 16
_LENGTH: Final = struct.Struct("<Q").pack
#: Stamps of the queries on a key, and senders of publications, that are remembered.
_REMEMBERED: Final = 65_536
#: Pause between two looks for a reply, s.
_POLL_S: Final = 0.001
#: Options of `zenoh.Session.get`: the caller gets the replies of all instances, not the first one alone.
EVERYBODY: Final[dict[str, Any]] = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}


class Signed(NamedTuple):
    """A payload whose authenticator is right, and its stamp (empty without a key)."""

    payload: bytes
    stamp: bytes


class Authenticator:
    """Signs and checks, in any thread. Without a key (``key`` empty) nothing is signed, and everything is believed.

    Attributes
    ----------
    path : of the file with the key; None where there is none. sender : the first 8 bytes of its stamps.
    """

    def __init__(self, key: bytes = b"", path: Path | None = None) -> None:
        self.path = path
        self._keyed = hashlib.blake2b(key=key, digest_size=TAG) if key else None
        self.sender = secrets.token_bytes(SENDER)
        self._number = 0
        self._lock = threading.Lock()
        #: By key: many queries of one must not make those of another forgotten.
        self._asked: defaultdict[str, OrderedDict[bytes, None]] = defaultdict(OrderedDict)

    def __bool__(self) -> bool:
        return self._keyed is not None

    def tag(self, *parts: bytes | str) -> bytes:
        """The 16 bytes that only a holder of the key can make for ``parts``; empty without a key."""
        if self._keyed is None:
            return b""
        # As fast as Python can: it takes part in every answer.
        pieces: list[bytes] = []
        for part in parts:
            data = part.encode() if isinstance(part, str) else part
            pieces += (_LENGTH(len(data)), data)
        hashed = self._keyed.copy()
        hashed.update(b"".join(pieces))
        return hashed.digest()

    def proves(self, tag: bytes, *parts: bytes | str) -> bool:
        """Whether ``tag`` is right for ``parts``; always True without a key."""
        return self._keyed is None or hmac.compare_digest(tag, self.tag(*parts))

    # ---- who publishes and answers

    def stamp(self) -> bytes:
        """Of a reply: take it before its payload is made, so that all that was published before is in the payload."""
        return self.sender + self._number.to_bytes(8, "little")

    def published(self, key: str, payload: bytes, named: bool = False) -> bytes | None:
        """The attachment of the next publication on ``key``; without a key None, or the stamp alone if ``named``."""
        if self._keyed is None and not named:
            return None
        with self._lock:
            self._number += 1
            stamp = self.stamp()
        return stamp + self.tag("put", key, stamp, payload)

    def answered(
        self, query: zenoh.Query, key: str, payload: bytes, stamp: bytes = b"", asked: bytes | None = None
    ) -> bytes | None:
        """The attachment of a reply to ``query`` with payload ``asked``; None without a key or a stamp."""
        if self._keyed is None or (attached := query.attachment) is None:
            return None
        stamp = stamp or self.stamp()
        if asked is None:
            asked = payload_of(query.payload)
        of = attached.to_bytes()[:STAMP], str(query.parameters), asked
        return stamp + self.tag("reply", key, stamp, *of, payload)

    def is_asked_by_ours(self, query: zenoh.Query, key: str) -> bool:
        """Whether ``query`` on ``key`` is signed, and comes for the first time; always without a key."""
        if self._keyed is None:
            return True
        attached = payload_of(query.attachment)
        stamp = attached[:STAMP]
        if not self.proves(attached[STAMP:], "query", key, stamp, str(query.parameters), payload_of(query.payload)):
            return False
        with self._lock:
            asked = self._asked[key]
            if stamp in asked:
                return False
            asked[stamp] = None
            if len(asked) > _REMEMBERED:
                asked.popitem(last=False)
        return True

    # ---- who asks and hears

    def question(self, parameters: str = "", payload: bytes = b"", key: str = "") -> Question:
        """What a query carries, and the check of its replies; signed for ``key`` where one is given."""
        return Question(self, parameters, payload, key)

    def ask(
        self,
        session: zenoh.Session,
        key: str,
        timeout_s: float,
        parameters: str = "",
        payload: bytes = b"",
        sign: bool = False,
        wanted: Callable[[], bool] = lambda: True,
        **options: Any,
    ) -> Iterator[tuple[zenoh.Reply, Signed | None]]:
        """Ask all instances; each reply that comes within ``timeout_s``, and what it says if its tag is right.

        ``sign`` : the query too. Ends when ``wanted`` is false. ``options`` : of `zenoh.Session.get`.
        """
        question = self.question(parameters, payload, key if sign else "")
        replies = session.get(
            f"{key}?{parameters}" if parameters else key,
            payload=payload or None,
            attachment=question.attachment,
            timeout=timeout_s,
            **EVERYBODY,
            **options,
        )
        while wanted():
            try:
                reply = replies.try_recv()
            except zenoh.ZError:
                return  # all have answered, or the time is over
            if reply is None:
                time.sleep(_POLL_S)
            else:
                yield reply, None if reply.ok is None else question.answer(reply.ok)

    def heard(self, sample: zenoh.Sample, key: str) -> Signed | None:
        """A publication on ``key``; None without a right tag."""
        payload = sample.payload.to_bytes()
        if self._keyed is None:
            return Signed(payload, b"")
        attached = payload_of(sample.attachment)
        stamp = attached[:STAMP]
        return Signed(payload, stamp) if self.proves(attached[STAMP:], "put", key, stamp, payload) else None


class Question:
    """One query: ``attachment`` is sent with it (None without a key), `answer` checks each reply."""

    def __init__(self, authenticator: Authenticator, parameters: str, payload: bytes, key: str) -> None:
        self._by = authenticator
        self._of = os.urandom(STAMP), parameters, payload
        stamp = self._of[0]
        signed = stamp + authenticator.tag("query", key, *self._of) if key else stamp
        self.attachment = signed if authenticator else None

    def answer(self, reply: zenoh.Sample) -> Signed | None:
        """The reply to this query; None without a right tag."""
        payload = reply.payload.to_bytes()
        if not self._by:
            return Signed(payload, b"")
        attached = payload_of(reply.attachment)
        stamp = attached[:STAMP]
        right = self._by.proves(attached[STAMP:], "reply", str(reply.key_expr), stamp, *self._of, payload)
        return Signed(payload, stamp) if right else None


class Rising:
    """The highest number of each sender: each of their messages counts once, in order."""

    def __init__(self) -> None:
        self._last: OrderedDict[bytes, int] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self._last)

    def take(self, stamp: bytes) -> bool:
        """Whether a message with this stamp is newer than all earlier ones of its sender."""
        sender, number = stamp[:SENDER], int.from_bytes(stamp[SENDER:], "little")
        if number <= self._last.get(sender, -1):
            return False
        self._last[sender] = number
        self._last.move_to_end(sender)
        if len(self._last) > _REMEMBERED:
            self._last.popitem(last=False)
        return True


class Heard:
    """Publications on ``key`` of the sender that answers, each once and in order.

    Attributes
    ----------
    refused : number of messages without a right tag. is_unknown : whether the last message was left out because its
    sender is not that of the last reply; then query, and `meet` who replies.
    """

    def __init__(self, authenticator: Authenticator, key: str) -> None:
        self.refused = 0
        self.is_unknown = False
        self._by, self._key = authenticator, key
        self._sender, self._rising = b"", Rising()

    def meet(self, stamp: bytes) -> None:
        """Believe the sender of a reply from now on, as to what it publishes after it."""
        self._rising.take(stamp)
        self._sender = stamp[:SENDER]

    def take(self, sample: zenoh.Sample) -> bytes | None:
        """The payload of a publication; None where it is refused, or repeated."""
        signed = self._by.heard(sample, self._key)
        self.is_unknown = signed is not None and signed.stamp[:SENDER] != self._sender
        if signed is None:
            if not self.refused:
                _LOGGER.warning("%s: messages without the authenticator of the service are passed over", self._key)
            self.refused += 1
        elif not self._by or (not self.is_unknown and self._rising.take(signed.stamp)):
            return signed.payload
        return None


class HeardSamples:
    """Samples of a stage on ``key``: from the first signed one on, only signed ones, each message once.

    A stage without a key is believed until a signed sample comes. Attributes: refused : messages that were left out.
    """

    def __init__(self, authenticator: Authenticator, key: str) -> None:
        self.refused = 0
        self._by, self._key, self._rising = authenticator, key, Rising()

    def take(self, sample: zenoh.Sample) -> bytes | None:
        """The payload of a message; None where it is refused, or repeated."""
        signed = self._by.heard(sample, self._key)
        if signed is None:
            if not self._rising:
                return sample.payload.to_bytes()
        elif not self._by or self._rising.take(signed.stamp):
            return signed.payload
        self.refused += 1
        return None


def payload_of(data: zenoh.ZBytes | None) -> bytes:
    """The bytes of a payload or an attachment; none of one that is not there."""
    return b"" if data is None else data.to_bytes()


# --- The key.

#: Nothing is signed, and everything is believed.
NO_KEY: Final = Authenticator()
#: Where a key was looked for and not found, which is said once.
_missed: Final[set[Path | None]] = set()


def default_key() -> Path | None:
    """Where the key of this user on this machine lies; None where there is none (`OPEN`, or no home)."""
    named = os.environ.get(VARIABLE, "")
    if named:
        return None if named == OPEN else Path(named)
    try:
        state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return Path(state) / "dehyst" / "key"


def own_authenticator(path: Path | None = None) -> Authenticator:
    """By the key in ``path``, or in that of this user; without one a warning is logged, and everything is believed.

    Raises InputError where the key cannot be used, or ``path`` is missing.
    """
    named = path is not None or os.environ.get(VARIABLE)
    path = path or default_key()
    if path is None or not (named or path.exists()):
        if not named and path not in _missed:
            _missed.add(path)
            _LOGGER.warning("no key at %s: whoever answers is believed; see docs/access.md", path)
        return NO_KEY
    return read_key(path)


def read_key(path: Path, make: bool = False) -> Authenticator:
    """The authenticator by the key in a file; ``make`` it where it is missing.

    Raises InputError if the file is missing, too short, too long or open to other users; OSError if it cannot be made.
    """
    if make and not path.exists():
        _make(path)
    advice = f"write {_LEAST} to {_MOST} random bytes into it, readable by its owner only (mode 600)"
    try:
        key, mode = path.read_bytes().strip(), path.stat().st_mode & 0o077
    except OSError as error:
        raise FieldError("key", f"{path}: {error.strerror or error}", "a file with a key", advice) from error
    if not _LEAST <= len(key) <= _MOST:
        raise FieldError("key", f"{len(key)} bytes in {path}", f"{_LEAST} to {_MOST} bytes", advice)
    if mode:
        raise FieldError("key", f"{path} with mode {mode:03o} for others", "a file of mode 600", advice)
    return Authenticator(key, path)


def _make(path: Path) -> None:
    """Write a new key; of two services that begin together the first one's counts."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_hex(24).encode())
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(part, path)
    finally:
        part.unlink(missing_ok=True)
