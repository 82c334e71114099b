"""Decides whether one axis of one instance serves or stands by, and changes its role.

A thread of its own decides when claims change: callbacks of zenoh only store what arrives.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from dehyst.adaptive.errors import DehystError, ModelFileError
from dehyst.service.failover.standby_model import StandbyModel
from dehyst.service.failover.state_transfer import HELD, fetch_state, status_of
from dehyst.service.operating.server import FREEZE, THAW
from dehyst.service.protocol.keys import Keys
from dehyst.service.security.authenticator import NO_KEY, Authenticator
from dehyst.service.security.tokens import Claim, Tokens
from dehyst.service.server.axis_server import PRIMARY, STANDBY, AxisServer

# --- Claims to serve an axis, and the rule that decides which instance serves.
#
# A serving instance holds a token with its *epoch*: one more than any epoch that it knew when it took over. Of two
# serving instances the one with the lower epoch stands down; with equal epochs, the one with the lower name. An
# instance that was suspended therefore stands down when it returns, because its successor has the higher epoch. Clocks
# are not compared. A token may be repeated by others after its instance has gone: it counts while that one answers.


class Claims(Tokens[Claim]):
    """The claims of other instances. ``changed`` : set after every update."""

    def __init__(self, keys: Keys, instance: str, by: Authenticator = NO_KEY) -> None:
        super().__init__(Claim, by, keys)
        self.changed = threading.Event()
        self._instance = instance
        self._ignored: frozenset[Claim] = frozenset()
        self._highest_epoch = 0

    def update(self, key: str, appeared: bool) -> None:
        """A token has appeared or disappeared."""
        super().update(key, appeared)
        self.changed.set()

    def take(self, token: Claim, appeared: bool) -> None:
        """Note the claim of another instance."""
        if token.instance != self._instance:
            super().take(token, appeared)
            self._ignored -= {token}
            self._highest_epoch = max(self._highest_epoch, token.epoch)

    def highest(self) -> Claim | None:
        """The claim with precedence among the others; None if there is none."""
        return max(self.alive - self._ignored, default=None)

    def ignore(self, claim: Claim) -> None:
        """Ignore a claim whose instance does not answer, until its token appears anew."""
        with self._updating:
            self._ignored |= {claim}

    def next_epoch(self) -> int:
        """One more than any known epoch."""
        return self._highest_epoch + 1


# --- Role control.

#: Time from the loss of a claim until the loss of the router is known too, s; 5 ms were measured.
_ROUTER_LOSS_KNOWN_S: Final = 0.02
#: Time from a reconnection until the claims behind the router are known, s.
_CLAIMS_KNOWN_S: Final = 0.5
#: Longest wait for the state, and pause before the next attempt, s.
_TRANSFER_S: Final = 3.0
_TRANSFER_PAUSE_S: Final = 0.3
#: Time after which a rival with a lower claim that still serves has not received this instance's claim, s.
_CLAIM_LOST_S: Final = 2.0
_POLL_S: Final = 1.0
#: Longest wait for the status of an instance that claims to serve, s, and pause between two that a standby asks for, s.
_LIFE_S: Final = 2.0
_ASK_S: Final = 1.0
_LEAST_WAIT_S: Final = 0.01
#: Longest time for a change of role, and for restoring a received state, in the thread that handles samples, s.
_CHANGE_S: Final = 60.0
_RESTORE_S: Final = 10.0


class RoleControl:
    """The role of one axis of one instance.

    Parameters
    ----------
    server : of the axis; it listens already. search_s : time to look for a serving instance before serving, s.
    behind_routers : others reach this instance through routers only: it listens nowhere.

    Attributes
    ----------
    settled : set once the role is known.
    ready : set once this instance serves, holds the served model, or was refused it.
    """

    def __init__(
        self,
        session: zenoh.Session,
        server: AxisServer,
        search_s: float,
        behind_routers: bool,
    ) -> None:
        self.server = server
        self.claims = Claims(server.keys, server.instance, server.authenticator)
        #: Who serves, and when it last gave a sign of life, by ``time.monotonic``, s.
        self._alive: tuple[Claim | None, float] = (None, 0.0)
        self.model = StandbyModel(
            server.axis, server.loop.sink, on_restored=server.checkpoints.copy_now, on_gap=self._refetch_state
        )
        self._behind_routers = behind_routers
        self._unconnected_at = -_CLAIMS_KNOWN_S
        self._refusal = ""
        self._session = session
        self._search_s = search_s
        self._stopping = False
        #: Whether the state of the serving instance must be fetched.
        self._outdated = True
        #: Those who wait for this instance to hold a verb of an operator. Held as long as they are here.
        self._waiting: list[zenoh.Query] = []
        self._token: Any = None
        self._rival_at: float | None = None
        self._queryable: Any = None
        # Not a daemon: zenoh's callback threads inherit this from the thread that declares them, here the one that
        # makes the axis serve. A daemon among them that returns from zenoh while the interpreter ends aborts it.
        self._thread = threading.Thread(target=self._run, name=f"role-{server.keys.axis}", daemon=False)
        self.settled = threading.Event()
        self.ready = threading.Event()
        server.set_synced(False)
        server.loop.set_gate(self.model.gate)

    def start(self) -> None:
        """Look for other instances and take a role."""
        self.claims.subscribe(self._session)
        self._queryable = self._session.declare_queryable(self.server.keys.switch, self._on_switch)
        self._thread.start()

    def close(self) -> None:
        """Withdraw the claim and end the thread. The server stays open."""
        self._stopping = True
        self.claims.changed.set()
        if self._thread.is_alive():
            self._thread.join()
        self.claims.undeclare()
        if self._queryable is not None:
            self._queryable.undeclare()
            self._queryable = None
        self._waiting.clear()
        self._drop_claim()

    def _on_switch(self, query: zenoh.Query) -> None:
        """An operator has changed the state that is served: answer once this instance has taken it anew. A verb must
        hold even if the instance that serves dies right after. A query without an answer is not counted there."""
        if self.server.role == STANDBY and self.server.authenticator.is_asked_by_ours(query, self.server.keys.switch):
            self._waiting.append(query)
            self._refetch_state()

    def _refetch_state(self) -> None:
        self._outdated = True
        self.claims.changed.set()

    def _run(self) -> None:
        until = time.monotonic() + self._search_s
        while not self._stopping:
            self.claims.changed.clear()
            try:
                self._decide(until)
            except Exception as error:
                self.server.axis.note("internal_error", f"standby: {type(error).__name__}: {error}")
            wait_s = _POLL_S
            if self.server.role == STANDBY and self.claims.highest() is None:
                wait_s = max(_LEAST_WAIT_S, until - time.monotonic())
            elif self.server.role == STANDBY and self._outdated:
                wait_s = _TRANSFER_PAUSE_S
            self.claims.changed.wait(wait_s)

    def _decide(self, until: float) -> None:
        server, claims = self.server, self.claims
        if claims.refused and not server.claims_refused:
            detail = "a claim without the authenticator of this service is ignored; see docs/access.md"
            server.axis.note("claim_ignored", f"{detail}; later ones are only counted")
        server.set_claims_refused(claims.refused)
        highest = claims.highest()
        if server.role == PRIMARY:
            if highest is None or highest < Claim(server.epoch, server.instance):
                self._check_rival(highest)
            elif self._status_of(highest) is not None:  # who does not answer queries is no successor
                self._stand_down(highest)
        elif highest is not None:
            self.settled.set()
            if self._outdated:
                self._take_state(highest)
            self._compare(highest)
        # A standby knows that the serving instance is gone; a new instance looks for one first. Without a router
        # neither is known; to find that out takes a while.
        elif (
            (self.settled.is_set() or time.monotonic() >= until) and not self._is_cut_off() and claims.highest() is None
        ):
            self._take_over()

    def _is_cut_off(self) -> bool:
        """Whether missing claims do not show that the others have failed; takes 20 ms.

        An instance that loses its router sees the claims of all others disappear. It must not take over then: no client
        could query it, and after the reconnection two would serve, of which the one that never failed would stand down.
        """
        if not self._behind_routers:
            return False
        time.sleep(_ROUTER_LOSS_KNOWN_S)
        now = time.monotonic()
        if not self._session.info.routers_zid():
            self._unconnected_at = now
        return now - self._unconnected_at < _CLAIMS_KNOWN_S

    def _while_alive(self, other: Claim) -> Callable[[], bool]:
        return lambda: not self._stopping and self.claims.highest() == other

    def _status_of(self, rival: Claim) -> dict[str, Any] | None:
        """The status of ``rival``; where it does not answer, its claim is ignored from now on."""
        server, wanted = self.server, self._while_alive(rival)
        status = status_of(self._session, server.keys.status, rival.instance, _LIFE_S, server.authenticator, wanted)
        if status is None and wanted() and not self._is_cut_off():
            self.claims.ignore(rival)
            detail = f"{rival.instance} claims to serve as number {rival.epoch} and does not answer"
            server.axis.note("claim_ignored", f"{detail}: its claim is ignored")
        return status

    def _compare(self, highest: Claim) -> None:
        """Once in a while, ask the instance that serves: whether it is there, and for the digest of its model."""
        axis, now = self.server.axis, time.monotonic()
        if self._alive[0] != highest:
            self._alive = (highest, now)
        if now - self._alive[1] <= _ASK_S or (status := self._status_of(highest)) is None:
            return
        self._alive = (highest, time.monotonic())
        seq, theirs = status.get("snapshot_seq"), status.get("fingerprint")
        if self._outdated or not (self.server.synced and isinstance(seq, int) and isinstance(theirs, str)):
            return
        if axis.differs(seq, theirs):
            axis.note("standby_differed", f"at sample {seq}; the state is fetched again")
            self._refetch_state()

    def _check_rival(self, rival: Claim | None) -> None:
        """Claim again if a rival with a lower claim goes on serving.

        The rival may not have received the claim: zenoh 1.10 did not deliver it to an instance that had been suspended.
        It does deliver a new claim.
        """
        now = time.monotonic()
        if rival is None or self._rival_at is None:
            self._rival_at = None if rival is None else now
        elif now - self._rival_at >= _CLAIM_LOST_S:
            self._rival_at = now
            self._claim()
            detail = f"{rival.instance} serves as number {rival.epoch} and does not stand down"
            self.server.axis.note("claimed_anew", f"as number {self.server.epoch}: {detail}")

    def _claim(self) -> None:
        """Declare a claim above all known ones, then withdraw the previous one."""
        server, before = self.server, self._token
        server.set_epoch(max(server.epoch + 1, self.claims.next_epoch()))
        claim = Claim(server.epoch, server.instance)
        self._token = self._session.liveliness().declare_token(claim.key(server.authenticator, server.keys))
        if before is not None:
            before.undeclare()

    def _drop_claim(self) -> None:
        if self._token is not None:
            self._token.undeclare()
            self._token = None

    # ---- changes of the role

    def _take_over(self) -> None:
        server = self.server
        self._claim()
        server.serve()
        server.loop.queue.call(self._leave_standby, _CHANGE_S)
        self._outdated = False
        self._waiting.clear()
        server.set_synced(True)
        self.settled.set()
        self.ready.set()

    def _stand_down(self, other: Claim) -> None:
        server = self.server
        server.axis.note("stood_down", f"{other.instance} serves: it took over while this instance was unreachable")
        # First: the status must not claim that this is the served model.
        server.set_synced(False)
        server.stand_down()
        self._drop_claim()
        self._rival_at = None
        server.loop.queue.call(self._enter_standby, _CHANGE_S)
        self._take_state(other)

    def _leave_standby(self) -> None:
        axis, source = self.server.axis, self.model.take_over()
        self.server.loop.set_gate(None)
        if self.server.epoch > 1:  # in the first one there is no other state
            if source:
                axis.warnings["not_synced"] = (
                    f"took over without the state of the one before: it continues from {source}, and does not know "
                    "what operators have commanded since"
                )
            model = f"not synced: it continues from {source}" if source else "with the model of the one before"
            axis.note("took_over", f"as number {self.server.epoch}, {model}", synced=not source)

    def _enter_standby(self) -> None:
        self.model.stand_down()
        self.server.axis.warnings.pop("not_synced", None)
        self.server.leave_tuning()
        self.server.loop.set_gate(self.model.gate)

    def _take_state(self, serving: Claim) -> None:
        """Fetch and restore the state of the serving instance; after a failure the next decision tries again."""
        server, taken = self.server, False
        self._outdated = False  # a callback may set it again meanwhile
        waiting, self._waiting = self._waiting, []
        frozen = server.axis.frozen
        try:
            wanted = self._while_alive(serving)
            data = fetch_state(self._session, server.keys.state, _TRANSFER_S, server.authenticator, wanted)
            if data is None:
                return
            server.loop.queue.call(lambda: self.model.take_state(data), _RESTORE_S)
            taken = True
        except DehystError as error:
            refusal = f"the state of the serving instance: {error}"
            if refusal != self._refusal:
                server.axis.note("standby_refused", refusal)
            self._refusal = refusal
            if isinstance(error, ModelFileError):
                # Another configuration: this instance stays without the served model, and records samples.
                self.ready.set()
            return
        finally:
            if not taken:
                self._outdated = True
                self._waiting = waiting + self._waiting
        if server.axis.frozen != frozen:  # a start from its own files must know it
            verb, samples = FREEZE if server.axis.frozen else THAW, server.axis.sequence.received
            entry = {"who": serving.instance, "verb": verb, "instance": server.instance, "ok": True, "samples": samples}
            server.journal().write(entry)
        key, by_key = server.keys.switch, server.authenticator
        for query in waiting:
            with contextlib.suppress(zenoh.ZError), query:
                query.reply(key, HELD, attachment=by_key.answered(query, key, HELD))
        self._refusal = ""
        server.set_synced(True)
        self.ready.set()
