"""Signed liveliness tokens: which instance serves an axis (`Claim`), and which controllers command it (`Holder`).

The key of a token says who holds it, and ends with the authenticator's tag over the rest of the key (docs/protocol.md).
A token can be repeated by whoever has seen its key: it was said once, by a holder of the service's key.
"""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from typing import Any, ClassVar, Generic, Self, TypeVar

import zenoh

from dehyst.service.protocol.keys import Keys
from dehyst.service.security.authenticator import Authenticator


@dataclass(frozen=True, slots=True, order=True)
class Token:
    """What a token says. Its fields, joined by ``/``, are its name in the key. Of several the greatest one counts."""

    KIND: ClassVar[str]
    FORM: ClassVar[str]

    @property
    def name(self) -> str:
        """The part of the key between kind and tag."""
        return "/".join(str(getattr(self, field.name)) for field in fields(self))

    def key(self, by: Authenticator, keys: Keys) -> str:
        """The key of the token; its tag is missing without a key of the service."""
        return keys.token(self.KIND, self.name, by.tag(self.KIND, keys.token(self.KIND, self.name)).hex())

    @classmethod
    def read(cls, by: Authenticator, keys: Keys, key: str) -> Self | None:
        """What the token with this ``key`` says; None where it is malformed, or its tag is wrong."""
        found = re.search(rf"/{cls.KIND}/{cls.FORM}(?:/[0-9a-f]{{1,64}})?$", key)
        if found is None:
            return None
        values = zip(fields(cls), found.groups(), strict=True)
        token = cls(*(int(text) if field.type == "int" else text for field, text in values))
        return None if by and key != token.key(by, keys) else token


@dataclass(frozen=True, slots=True, order=True)
class Claim(Token):
    """``instance`` serves since take-over number ``epoch``, at most 10^9: one every second for thirty years."""

    KIND: ClassVar[str] = "claim"
    FORM: ClassVar[str] = "([0-9]{1,9}|10{9})/([a-z][a-z0-9_-]{0,63})"

    epoch: int
    instance: str


@dataclass(frozen=True, slots=True, order=True)
class Holder(Token):
    """A controller; the greatest one owns ``command``.

    Attributes
    ----------
    order : ms that its host had run when it took the token, and above that of all tokens that it knew.
    sender : of its commands, 16 hexadecimal digits (`service.security.authenticator`). process, host : where it runs.
    since_unix_ms : when it took the token by the clock on the wall, for people alone.
    """

    KIND: ClassVar[str] = "owner"
    FORM: ClassVar[str] = "([0-9]{1,13})/([0-9a-f]{16})/([0-9]{1,10})/([A-Za-z0-9._-]{1,64})/([0-9]{1,13})"

    order: int
    sender: str
    process: int
    host: str
    since_unix_ms: int

    def __str__(self) -> str:
        since = datetime.fromtimestamp(self.since_unix_ms / 1e3, UTC)
        return f"process {self.process} on {self.host} since {since:%Y-%m-%d %H:%M:%S} UTC"

    def to_json(self) -> dict[str, Any]:
        """For a status."""
        return {"process": self.process, "host": self.host, "since_unix_s": self.since_unix_ms / 1e3}


T = TypeVar("T", bound=Token)


class Tokens(Generic[T]):
    """The tokens of one kind that are alive. Zenoh's threads tell of them; any thread reads.

    Attributes
    ----------
    alive : what they say. refused : count of tokens that were passed over, malformed or without a right tag.
    """

    def __init__(self, kind: type[T], by: Authenticator, keys: Keys) -> None:
        self.alive: frozenset[T] = frozenset()
        self.refused = 0
        self._kind, self._by, self._keys = kind, by, keys
        self._updating = threading.Lock()
        self._subscriber: Any = None

    def subscribe(self, session: zenoh.Session) -> None:
        """Begin, with those that are alive already."""

        def on_token(sample: zenoh.Sample) -> None:
            self.update(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        at = self._keys.tokens(self._kind.KIND)
        self._subscriber = session.liveliness().declare_subscriber(at, on_token, history=True)

    def undeclare(self) -> None:
        """End."""
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None

    def update(self, key: str, appeared: bool) -> None:
        """A token has appeared, or disappeared."""
        token = self._kind.read(self._by, self._keys, key)
        with self._updating:
            if token is None:
                self.refused += appeared
            else:
                self.take(token, appeared)

    def take(self, token: T, appeared: bool) -> None:
        """Note a right one."""
        self.alive = self.alive | {token} if appeared else self.alive - {token}
