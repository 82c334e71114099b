"""Decides whether one axis of one instance serves or stands by, and changes its role.

A thread of its own decides when claims change: callbacks of zenoh only store what arrives.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import zenoh

from adaptive.errors import DehystError, ModelFileError
from service.failover.standby_model import PeerFiles, StandbyModel, restore_from_peer
from service.failover.state_transfer import fetch_state, status_of
from service.operating.server import FREEZE, THAW, Switch
from service.operating.verbs import MAX_WHO
from service.protocol.container import fields_of
from service.protocol.keys import Keys
from service.security.authenticator import NO_KEY, Authenticator
from service.server.axis_server import PRIMARY, STANDBY, AxisServer

# --- Claims to serve an axis, and the rule that decides which instance serves.
#
# A serving instance holds a liveliness token with its *epoch*: one more than any epoch that it knew when it took over.
# Of two serving instances the one with the lower epoch stands down; with equal epochs, the one with the lower name. An
# instance that was suspended therefore stands down when it returns, because its successor has the higher epoch. Clocks
# are not compared.


@dataclass(frozen=True, slots=True, order=True)
class Claim:
    """One claim; the greatest one has precedence."""

    epoch: int
    instance: str


#: Greatest epoch that is taken for one: a take-over every second for thirty years.
MAX_EPOCH: Final = 10**9
_CLAIM: Final = re.compile(r"/claim/([0-9]{1,10})/([a-z][a-z0-9_-]{0,63})(?:/([0-9a-f]{1,64}))?$")


def claim_key(by: Authenticator, keys: Keys, claim: Claim) -> str:
    """The key of the token that claims; its tag shows that others repeat at most what was said."""
    key = keys.claim(claim.epoch, claim.instance)
    return keys.claim(claim.epoch, claim.instance, by.tag("claim", key).hex())


def read_claim(by: Authenticator, keys: Keys, key: str) -> Claim | None:
    """The claim in the key of a token; None if the key is not a claim, its epoch is out of range or its tag wrong."""
    found = _CLAIM.search(key)
    if found is None or int(found[1]) > MAX_EPOCH:
        return None
    claim = Claim(int(found[1]), found[2])
    return None if by and key != claim_key(by, keys, claim) else claim


class Claims:
    """The claims of other instances that are alive. Zenoh's thread updates them, the thread of the role reads them.

    Attributes
    ----------
    changed : set after every update. unsigned : count of claims that were ignored because they prove nothing.
    """

    def __init__(self, keys: Keys, instance: str, authenticator: Authenticator = NO_KEY) -> None:
        self.unsigned = 0
        self.changed = threading.Event()
        self._keys, self._instance, self._by = keys, instance, authenticator
        self._alive: set[Claim] = set()
        self._ignored: set[Claim] = set()
        self._highest_epoch = 0
        self._lock = threading.Lock()

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared (``alive``) or disappeared."""
        claim = read_claim(self._by, self._keys, key)
        if claim is None:
            self.unsigned += alive
        elif claim.instance != self._instance:
            with self._lock:
                self._ignored.discard(claim)
                self._highest_epoch = max(self._highest_epoch, claim.epoch)
                (self._alive.add if alive else self._alive.discard)(claim)
        self.changed.set()

    def highest(self) -> Claim | None:
        """The claim with precedence among the others; None if there is none."""
        with self._lock:
            return max(self._alive - self._ignored, default=None)

    def ignore(self, claim: Claim) -> None:
        """Ignore a claim whose instance does not answer, until its token appears anew."""
        with self._lock:
            self._ignored.add(claim)

    def next_epoch(self) -> int:
        """One more than any known epoch."""
        with self._lock:
            return self._highest_epoch + 1


# --- Whether an instance behind routers is connected to one of them.
#
# An instance that loses its router sees the claims of all others disappear. It must not take over then: no client could
# query it, and after the reconnection two instances would serve, of which the one that never failed would stand down.

#: Time from the loss of a claim until the loss of the router is known too, s; 5 ms were measured.
_ROUTER_LOSS_KNOWN_S: Final = 0.02
#: Time from a reconnection until the claims behind the router are known, s.
_CLAIMS_KNOWN_S: Final = 0.5


class Reachability:
    """Reachability of one session.

    Parameters
    ----------
    behind_routers : True if others reach this instance through routers only: it listens at no endpoint.
    """

    def __init__(self, session: zenoh.Session, behind_routers: bool) -> None:
        self._session = session
        self._behind_routers = behind_routers
        self._unconnected_at = -_CLAIMS_KNOWN_S

    def is_cut_off(self) -> bool:
        """True if missing claims do not show that the others have failed. Takes 20 ms; do not call it in a callback."""
        if not self._behind_routers:
            return False
        time.sleep(_ROUTER_LOSS_KNOWN_S)
        now = time.monotonic()
        if not self._session.info.routers_zid():
            self._unconnected_at = now
        return now - self._unconnected_at < _CLAIMS_KNOWN_S


# --- Role control.

#: Events of the serving instance after which its model no longer follows from the samples alone.
MODEL_EVENTS: Final = frozenset({"selected", "rolled_back", "retuning_adopted"})
#: Longest wait for a part of the state, and pause before the next attempt, s.
_TRANSFER_S: Final = 3.0
_TRANSFER_PAUSE_S: Final = 0.3
#: Time after which a rival with a lower claim that still serves has not received this instance's claim, s.
_CLAIM_LOST_S: Final = 2.0
_POLL_S: Final = 1.0
#: Longest wait for the status of an instance that claims to serve, s, and pause between two that a standby asks for, s.
#: It believes nothing else: a liveliness token can be held by anybody, long after its instance.
_LIFE_S: Final = 2.0
_ASK_S: Final = 1.0
#: Pause between two transfers of the state to a standby that has one, s: that its model differs anybody may say.
_REFETCH_S: Final = 1.0
_LEAST_WAIT_S: Final = 0.01
#: Longest time for a change of role, and for restoring a received state, in the thread that handles samples, s.
_CHANGE_S: Final = 60.0
_RESTORE_S: Final = 10.0


class RoleControl:
    """The role of one axis of one instance.

    Parameters
    ----------
    server : of the axis; it listens already. search_s : time to look for a serving instance before serving, s.
    reachability : of this instance. peer_files : checkpoints and recordings of the other instance on this host.

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
        reachability: Reachability,
        peer_files: PeerFiles,
    ) -> None:
        self.server = server
        self.claims = Claims(server.keys, server.instance, server.authenticator)
        #: When the instance that serves last gave a sign of life, by ``time.monotonic``, s, and its name.
        self._alive: tuple[str, float] = ("", 0.0)
        #: When a state was last asked for, by ``time.monotonic``, s.
        self._fetched_s = -math.inf
        self.model = StandbyModel(
            server.axis, server.loop.sink, on_restored=server.checkpoints.copy_now, on_gap=self._refetch_state
        )
        self._peer_files = peer_files
        self._reachability = reachability
        self._refusal = ""
        self._session = session
        self._search_s = search_s
        self._stopping = False
        #: Whether the state of the serving instance must be fetched.
        self._outdated = True
        #: The last *freeze* or *thaw* of the one that serves, and by whom, until a state from it includes it.
        self._switch: tuple[str, str] | None = None
        self._token: Any = None
        self._epoch = 0
        self._rival_at: float | None = None
        self._entities: list[Any] = []
        # Not a daemon: zenoh's callback threads inherit this from the thread that declares them, here the one that
        # makes the axis serve. A daemon among them that returns from zenoh while the interpreter ends aborts it.
        self._thread = threading.Thread(target=self._run, name=f"role-{server.keys.axis}", daemon=False)
        self.settled = threading.Event()
        self.ready = threading.Event()
        server.set_synced(False)
        server.loop.set_gate(self.model.gate)

    def start(self) -> None:
        """Look for other instances and take a role."""
        keys = self.server.keys
        self._entities = [
            self._session.liveliness().declare_subscriber(keys.claim_any, self._on_claim, history=True),
            self._session.declare_subscriber(keys.event, self._on_event),
            self._session.declare_queryable(keys.switch, self._on_switch),
        ]
        self._thread.start()

    def close(self) -> None:
        """Withdraw the claim and end the thread. The server stays open."""
        self._stopping = True
        self.claims.changed.set()
        if self._thread.is_alive():
            self._thread.join()
        for entity in self._entities:
            entity.undeclare()
        self._entities = []
        self._drop_claim()

    def _on_claim(self, sample: zenoh.Sample) -> None:
        self.claims.update(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def _on_event(self, sample: zenoh.Sample) -> None:
        event = fields_of(sample.payload.to_bytes())
        if event.get("instance") != self.server.instance and event.get("event") in MODEL_EVENTS:
            self._refetch_state()

    def _on_switch(self, query: zenoh.Query) -> None:
        """A freeze or thaw of the instance that serves must hold even if that one dies before its state has come."""
        with query:
            key, by_key, highest = self.server.keys.switch, self.server.authenticator, self.claims.highest()
            if self.server.role == PRIMARY or highest is None or query.payload is None:
                return  # the sender counts those who confirm
            if not by_key.is_asked_by_ours(query, key):
                return
            switch = fields_of(query.payload.to_bytes())
            verb, by = switch.get("verb"), switch.get("by")
            if switch.get("instance") != highest.instance or verb not in (FREEZE, THAW) or not isinstance(by, str):
                return
            samples = switch.get("samples")
            if not isinstance(samples, int) or samples < self.model.state_samples:
                return  # told again by somebody: the state that came since includes it, and what followed
            self._switch = verb, by[:MAX_WHO]
            self._refetch_state()
            query.reply(key, held := b"held", attachment=by_key.answered(query, key, held))

    def _compare(self, status: dict[str, Any]) -> None:
        """Compare the digest of the served model with the own one of the same sample."""
        server = self.server
        if not server.synced or self._outdated:
            return  # the present model is about to be replaced
        seq, theirs = status.get("snapshot_seq"), status.get("fingerprint")
        if isinstance(seq, int) and isinstance(theirs, str) and server.axis.differs(seq, theirs):
            server.axis.note("standby_differed", f"at sample {seq}; the state is fetched again")
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
            highest = self.claims.highest()
            if self.server.role == STANDBY and highest is None:
                wait_s = max(_LEAST_WAIT_S, until - time.monotonic())
            else:
                wait_s = _TRANSFER_PAUSE_S if self.server.role == STANDBY and self._outdated else _POLL_S
            self.claims.changed.wait(wait_s)

    def _decide(self, until: float) -> None:
        self._note_unsigned()
        highest = self.claims.highest()
        if self.server.role == PRIMARY:
            if highest is not None and highest > Claim(self._epoch, self.server.instance):
                # Who does not answer queries is no successor.
                if self._status_of(highest) is not None:
                    self._stand_down(highest)
            else:
                self._check_rival(highest)
            return
        if highest is None:
            # A standby knows that the serving instance is gone; a new instance looks for one first. Without a router
            # neither is known.
            searched = self.settled.is_set() or time.monotonic() >= until
            if searched and not self._reachability.is_cut_off() and self.claims.highest() is None:
                self._take_over()
            return
        self.settled.set()
        if self._outdated and (not self.server.synced or time.monotonic() - self._fetched_s >= _REFETCH_S):
            self._take_state(highest)
        self._check_alive(highest)

    def _while_alive(self, other: Claim) -> Callable[[], bool]:
        return lambda: not self._stopping and self.claims.highest() == other

    def _status_of(self, rival: Claim) -> dict[str, Any] | None:
        """The status of ``rival``; where it does not answer, its claim is ignored from now on."""
        server, wanted = self.server, self._while_alive(rival)
        status = status_of(self._session, server.keys.status, rival.instance, _LIFE_S, server.authenticator, wanted)
        if status is not None or not wanted() or self._reachability.is_cut_off():
            return status
        self.claims.ignore(rival)
        detail = f"{rival.instance} claims to serve as number {rival.epoch} and does not answer: its claim is ignored"
        server.axis.note("claim_ignored", detail)
        return None

    def _check_alive(self, highest: Claim) -> None:
        """Ask the instance that serves for its status: its claim may be told by somebody else, long after it."""
        now = time.monotonic()
        if self._alive[0] != highest.instance:
            self._alive = (highest.instance, now)
        elif now - self._alive[1] > _ASK_S and (status := self._status_of(highest)) is not None:
            self._alive = (highest.instance, time.monotonic())
            self._compare(status)

    def _note_unsigned(self) -> None:
        """Note the first claim that proves nothing; the others are counted."""
        if self.claims.unsigned and not self.server.claims_refused:
            detail = "a claim without the authenticator of this service is ignored; see docs/access.md"
            self.server.axis.note("claim_ignored", f"{detail}; later ones are only counted")
        self.server.set_claims_refused(self.claims.unsigned)

    def _check_rival(self, rival: Claim | None) -> None:
        """Claim again if a rival with a lower claim goes on serving.

        The rival may not have received the claim: zenoh 1.10 did not deliver it to an instance that had been suspended.
        It does deliver a new claim.
        """
        now = time.monotonic()
        if rival is None:
            self._rival_at = None
        elif self._rival_at is None:
            self._rival_at = now
        elif now - self._rival_at >= _CLAIM_LOST_S:
            self._rival_at = now
            self._claim()
            detail = f"as number {self._epoch}: {rival.instance} serves as number {rival.epoch} and does not stand down"
            self.server.axis.note("claimed_anew", detail)

    def _claim(self) -> None:
        """Declare a claim above all known ones, then withdraw the previous one."""
        server, before = self.server, self._token
        self._epoch = max(self._epoch + 1, self.claims.next_epoch())
        server.set_epoch(self._epoch)
        key = claim_key(server.authenticator, server.keys, Claim(self._epoch, server.instance))
        self._token = self._session.liveliness().declare_token(key)
        if before is not None:
            before.undeclare()

    def _take_over(self) -> None:
        server = self.server
        self._claim()
        if self._switch is not None:  # before anybody is answered
            server.loop.queue.call(self._apply_switch, _CHANGE_S, urgent=True)
        server.serve()
        server.loop.queue.call(self._leave_standby, _CHANGE_S)
        self._outdated = False
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

    def _apply_switch(self) -> None:
        """Freeze or thaw as the one before did last, if that was not yet in a state from it: it was answered."""
        if self._switch is not None:
            verb, by = self._switch
            Switch(verb, by, 0, 0.0).apply(self.server.axis)

    def _leave_standby(self) -> None:
        axis = self.server.axis
        # In the first epoch there is no other state to take over: continue from its own.
        source = self.model.take_over(self._restore if self._epoch > 1 else lambda _: "")
        self._apply_switch()  # once more: another state may have been restored
        self._switch = None
        self.server.loop.set_gate(None)
        if self._epoch > 1:
            model = f"not synced: it continues from {source}" if source else "with the model of the one before"
            axis.note("took_over", f"as number {self._epoch}, {model}", synced=not source)

    def _restore(self, newest_seq: int) -> str:
        return restore_from_peer(self.server.axis, self._peer_files, self.server.keys.stage, newest_seq)

    def _enter_standby(self) -> None:
        self.model.stand_down()
        self.server.leave_tuning()
        self.server.loop.set_gate(self.model.gate)

    def _take_state(self, serving: Claim) -> None:
        """Fetch and restore the state of the serving instance; after a failure the next decision tries again."""
        self._outdated = False  # a callback may set it again meanwhile
        taken = False
        try:
            taken = self._fetch_and_restore(serving)
        finally:
            self._outdated = self._outdated or not taken

    def _fetch_and_restore(self, serving: Claim) -> bool:
        self._fetched_s = time.monotonic()
        server = self.server
        try:
            key, wanted = server.keys.state, self._while_alive(serving)
            data = fetch_state(self._session, key, _TRANSFER_S, server.authenticator, wanted)
            if data is None:
                return False
            server.loop.queue.call(lambda: self.model.take_state(data), _RESTORE_S)
        except DehystError as error:
            refusal = f"the state of the serving instance: {error}"
            if refusal != self._refusal:
                server.axis.note("standby_refused", refusal)
            self._refusal = refusal
            if isinstance(error, ModelFileError):
                # Another configuration: this instance stays without the served model, and records samples.
                self.ready.set()
            return False
        if not self._outdated:  # no verb came while it was sent
            self._switch = None
        self._refusal = ""
        server.set_synced(True)
        self.ready.set()
        return True

    def _drop_claim(self) -> None:
        if self._token is not None:
            self._token.undeclare()
            self._token = None
