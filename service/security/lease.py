"""Who owns ``command`` of an axis: one controller at a time, by a lease that ends with it.

A controller holds a liveliness token while it commands. The key of the token says who it is, and carries the
authenticator where there is a key (docs/protocol.md, "Who commands"). Of several tokens the latest counts, by the clock
that no leap moves. The party that applies the voltages takes those of the owner alone (`CommandGate`); while nobody
holds a token it takes what comes.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import zenoh

from service.protocol.errors import CommandHeldError
from service.protocol.keys import Keys
from service.runtime.session import LEASE_S, SURELY
from service.security.authenticator import SENDER, STAMP, Authenticator, Rising, payload_of

_LOGGER: Final = logging.getLogger("dehyst.security")
_KEY: Final = re.compile(
    r"/owner/([0-9]{1,13})/([0-9a-f]{16})/([0-9]{1,10})/([A-Za-z0-9._-]{1,64})/([0-9]{1,13})(?:/([0-9a-f]{1,64}))?$"
)
#: Longest wait for the tokens that are alive, s; on loopback it takes 0.3 ms.
_ASK_S: Final = 1.0
_PAUSE_S: Final = 0.02


@dataclass(frozen=True, slots=True, order=True)
class Holder:
    """A controller that holds a token; the greatest one is the owner.

    Attributes
    ----------
    order : ms that its host had run when it took the token, and above that of all tokens that it knew.
    sender : of its commands, 16 hexadecimal digits (`service.security.authenticator`). process, host : where it runs.
    since_unix_ms : when it took the token by the clock on the wall, for people alone.
    """

    order: int
    sender: str
    process: int
    host: str
    since_unix_ms: int

    @property
    def name(self) -> str:
        """The part of the token's key that says who it is."""
        return f"{self.order}/{self.sender}/{self.process}/{self.host}/{self.since_unix_ms}"

    def __str__(self) -> str:
        since = datetime.fromtimestamp(self.since_unix_ms / 1e3, UTC)
        return f"process {self.process} on {self.host} since {since:%Y-%m-%d %H:%M:%S} UTC"

    def to_json(self) -> dict[str, Any]:
        """For a status."""
        return {"process": self.process, "host": self.host, "since_unix_s": self.since_unix_ms / 1e3}


def tag_of(by: Authenticator, keys: Keys, holder: Holder) -> str:
    """The tag in the key of a token, in hexadecimal digits; "" without a key."""
    return by.tag("owner", keys.owner(holder.name)).hex()


def read_token(by: Authenticator, keys: Keys, key: str) -> Holder | None:
    """Who holds the token ``key``; None where it is malformed, or its tag is wrong."""
    found = _KEY.search(key)
    if found is None:
        return None
    holder = Holder(int(found[1]), found[2], int(found[3]), found[4], int(found[5]))
    return None if by and found[6] != tag_of(by, keys, holder) else holder


class Holders:
    """The tokens of an axis that are alive; zenoh's thread keeps them.

    Attributes
    ----------
    alive : who holds one. owner : the greatest of them; None: nobody. refused : count of tokens without a right tag.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, by: Authenticator) -> None:
        self.alive: frozenset[Holder] = frozenset()
        self.owner: Holder | None = None
        self.refused = 0
        self._keys, self._by = keys, by
        self._subscriber: Any = session.liveliness().declare_subscriber(keys.owner_any, self._on_token, history=True)

    def _on_token(self, sample: zenoh.Sample) -> None:
        appeared = sample.kind == zenoh.SampleKind.PUT
        holder = read_token(self._by, self._keys, str(sample.key_expr))
        if holder is None:
            self.refused += appeared
            return
        self.alive = self.alive | {holder} if appeared else self.alive - {holder}
        self.owner = max(self.alive, default=None)

    def to_json(self) -> dict[str, Any]:
        """For a status: ``owner``, null where nobody holds ``command``; ``others`` that hold a token; ``refused``."""
        owner, alive = self.owner, self.alive
        return {
            "owner": None if owner is None else owner.to_json(),
            "others": [holder.to_json() for holder in sorted(alive) if holder != owner],
            "refused": self.refused,
        }

    def undeclare(self) -> None:
        """End."""
        self._subscriber.undeclare()


class CommandGate(Holders):
    """Hands the commands of the owner to ``receive``, in a thread of zenoh; while nobody owns, those of everybody.

    Attributes
    ----------
    foreign : count of commands of others, which are left out. stranger : who sent the last one of them.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, by: Authenticator, receive: Callable[[bytes], None]) -> None:
        super().__init__(session, keys, by)
        self.foreign = 0
        self.stranger = ""
        self._receive = receive
        self._rising = Rising()
        self._warned: Holder | None = None
        #: Each link of the session has a thread of its own.
        self._one = threading.Lock()
        self._commands: Any = session.declare_subscriber(keys.command, self._on_command)

    def _on_command(self, sample: zenoh.Sample) -> None:
        with self._one:
            self._take(sample)

    def _take(self, sample: zenoh.Sample) -> None:
        payload, owner = sample.payload.to_bytes(), self.owner
        # Without an owner too: what is sent while the token is on its way counts as sent.
        stranger = self._stranger(sample, payload, owner)
        if owner is None or not stranger:
            self._receive(payload)
            return
        if owner != self._warned:
            self._warned = owner
            detail = "voltages of %s are left out, because %s owns it; later ones are only counted"
            _LOGGER.warning(f"%s: {detail}", self._keys.command, stranger, owner)
        self.foreign, self.stranger = self.foreign + 1, stranger

    def _stranger(self, sample: zenoh.Sample, payload: bytes, owner: Holder | None) -> str:
        """Who sent a command, where that is not the owner; else ""."""
        attached = payload_of(sample.attachment)
        stamp = attached[:STAMP]
        if len(stamp) < STAMP:
            return "a controller without a token"
        if not self._by.proves(attached[STAMP:], "put", self._keys.command, stamp, payload):
            return "a controller without the key"
        sender = stamp[:SENDER].hex()
        if owner is not None and sender != owner.sender:
            known = (str(holder) for holder in self.alive if holder.sender == sender)
            return next(known, f"controller {sender}, which holds no token")
        return "" if self._rising.take(stamp) else "somebody who repeats the owner's"

    def to_json(self) -> dict[str, Any]:
        """Of the tokens, and ``foreign`` and ``stranger``."""
        return {**Holders.to_json(self), "foreign": self.foreign, "stranger": self.stranger}

    def undeclare(self) -> None:
        """Take no more commands."""
        self._commands.undeclare()
        super().undeclare()


class CommandLease:
    """``command`` of an axis for one controller, in one thread: `put` takes the lease, `undeclare` gives it back."""

    def __init__(self, session: zenoh.Session, keys: Keys, by: Authenticator) -> None:
        # Without a key the sender is of this lease all the same: it tells the controllers of one process apart.
        self._session, self._keys, self._by = session, keys, by or Authenticator()
        self.publisher = session.declare_publisher(keys.command, congestion_control=SURELY, express=True)
        self._holders: Holders | None = None
        self._holder: Holder | None = None
        self._token: Any = None

    def take(self, wait_s: float = 0.0, force: bool = False) -> None:
        """Become the owner, if this controller is not yet; waits up to ``wait_s`` s until another one has ended.

        ``force`` : although another one owns it. That one's commands are left out from then on, and it is told so.

        Raises CommandHeldError if another controller owns it, or has taken it over.
        """
        until = time.monotonic() + wait_s
        while True:
            try:
                return self._take(force)
            except CommandHeldError:
                if time.monotonic() >= until:
                    raise
                time.sleep(_PAUSE_S)

    def _take(self, force: bool) -> None:
        if self._holder is None:
            others = self._others()
            if others and not force:
                raise self._held(max(others))
            order = max([round(1e3 * time.monotonic()), *(holder.order + 1 for holder in others)])
            since_unix_ms = round(1e3 * time.time())
            self._holder = Holder(order, self._by.sender.hex(), os.getpid(), _host(), since_unix_ms)
            tag = tag_of(self._by, self._keys, self._holder)
            self._token = self._session.liveliness().declare_token(self._keys.owner(self._holder.name, tag))
            self._holders = Holders(self._session, self._keys, self._by)
            rivals: Iterable[Holder] = self._others()  # two may have begun at once
        else:
            assert self._holders is not None
            rivals = self._holders.alive
        owner = max([self._holder, *rivals])
        if owner != self._holder:
            self._give_up()
            raise self._held(owner)

    def _others(self) -> set[Holder]:
        """Who else holds a token now, as the other end of the session knows."""
        found = self._session.liveliness().get(self._keys.owner_any, timeout=_ASK_S)
        holders = {read_token(self._by, self._keys, str(reply.ok.key_expr)) for reply in found if reply.ok is not None}
        return {holder for holder in holders if holder is not None and holder.sender != self._by.sender.hex()}

    def _held(self, owner: Holder) -> CommandHeldError:
        return CommandHeldError(
            f"{self._keys.command}: got a second controller, expected one: {owner} commands this axis. End that one (a "
            f"killed process is gone within 0.2 s, one that hangs within {LEASE_S + 0.5:g} s), or take it over with "
            "Client.take_command(force=True)",
            str(owner),
        )

    def put(self, payload: bytes) -> None:
        """Publish a command as the owner. Raises as `take`."""
        self._take(force=False)
        attached = self._by.published(self._keys.command, payload, named=True)
        self.publisher.put(payload, attachment=attached)

    def _give_up(self) -> None:
        for entity in (self._token, self._holders):
            if entity is not None:
                entity.undeclare()
        self._token = self._holders = self._holder = None

    def undeclare(self) -> None:
        """Give the lease back."""
        self._give_up()
        self.publisher.undeclare()  # type: ignore[no-untyped-call]


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())[:64] or "unknown"
