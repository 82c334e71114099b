"""Who owns ``command`` of an axis: one controller at a time, by a lease that ends with it.

A controller holds a token while it commands (`service.security.tokens`). Of several the latest counts, by a clock that
is never set. The party that applies the voltages takes those of the owner alone (`CommandGate`); while nobody holds a
token it takes what comes.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import zenoh

from dehyst.service.protocol.errors import CommandHeldError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import LEASE_S, SURELY
from dehyst.service.security.authenticator import SENDER, STAMP, Authenticator, Rising, payload_of
from dehyst.service.security.tokens import Holder, Tokens

_LOGGER: Final = logging.getLogger("dehyst.security")
#: Longest wait for the tokens that are alive, s; on loopback it takes 0.3 ms.
_ASK_S: Final = 1.0
_PAUSE_S: Final = 0.02


class Holders(Tokens[Holder]):
    """The controllers that hold a token of an axis."""

    def __init__(self, session: zenoh.Session, keys: Keys, by: Authenticator) -> None:
        super().__init__(Holder, by, keys)
        self.subscribe(session)

    @property
    def owner(self) -> Holder | None:
        """The one whose commands count; None: nobody's do alone."""
        return max(self.alive, default=None)

    def to_json(self) -> dict[str, Any]:
        """For a status: ``owner``, null where nobody holds ``command``; ``others`` that hold a token; ``refused``."""
        *others, owner = sorted(self.alive) or (None,)
        return {
            "owner": None if owner is None else owner.to_json(),
            "others": [holder.to_json() for holder in others if holder is not None],
            "refused": self.refused,
        }


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
        payload, owner = sample.payload.to_bytes(), self.owner
        with self._one:
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
            self._token = self._session.liveliness().declare_token(self._holder.key(self._by, self._keys))
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
        found = self._session.liveliness().get(self._keys.tokens(Holder.KIND), timeout=_ASK_S)
        holders = {Holder.read(self._by, self._keys, str(reply.ok.key_expr)) for reply in found if reply.ok is not None}
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
