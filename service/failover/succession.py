"""Decides, for one axis of one instance, whether it serves or stands by, and brings it about.

A thread of its own, woken by the claims of others: nothing is decided in a callback of the wire.
"""

from __future__ import annotations

import threading
import time
from typing import Any, Final

import zenoh

from adaptive.errors import DehystError, ModelFileError
from service.failover.claims import Claim, Claims
from service.failover.reachability import Reach
from service.failover.standby_model import Shadow
from service.failover.state_transfer import MOST_PAUSE_S, PAUSE_S, ask_for_state
from service.failover.storage import Estate, inherit
from service.protocol.json_message import fields_of
from service.server.endpoints import PRIMARY, STANDBY, AxisServer

#: Events of the serving instance after which its model is another than the samples alone would make it.
OPERATIONS: Final = frozenset({"frozen", "thawed", "selected", "rolled_back", "retuning_adopted"})
#: Longest wait for the state of the serving instance, and pause before it is asked for again, s.
_STATE_S: Final = 3.0
_AGAIN_S: Final = 0.3
#: One that serves and should not, and still does after so long, was not told of this instance's claim, s.
_UNHEARD_S: Final = 2.0


class Succession:
    """One axis' place in the line.

    Parameters
    ----------
    server : listens already. patience_s : how long to look for one that serves before serving oneself, s.
    reach : whether this instance can be heard at all. estate : where the other instance of a pair keeps its
    checkpoints and recordings, if that is on this host.
    """

    def __init__(
        self, session: zenoh.Session, server: AxisServer, patience_s: float, reach: Reach, estate: Estate
    ) -> None:
        self.server = server
        self.claims = Claims(server.keys, server.instance)
        self.shadow = Shadow(server.axis, server.intake, changed=server.keeper.at_once, torn=self._differs)
        self._estate = estate
        self._reach = reach
        self._refused = ""
        self._pause_s = PAUSE_S
        self._session = session
        self._patience_s = patience_s
        self._stopping = False
        self._stale = True
        self._taking = False
        self._token: Any = None
        self._mine = 0
        self._rival_at: float | None = None
        self._subscribers: list[Any] = []
        self._thread = threading.Thread(target=self._run, name=f"succession-{server.keys.axis}", daemon=True)
        #: Set once it is known whether this instance serves.
        self.settled = threading.Event()
        #: Set once it serves, or holds the model of the one that serves, or was refused it.
        self.ready = threading.Event()
        server.synced = False
        server.intake.gate = self.shadow.gate

    def start(self) -> None:
        """Look for others, and find one's place."""
        keys = self.server.keys
        self._subscribers = [
            self._session.liveliness().declare_subscriber(keys.claim_any, self._on_claim, history=True),
            self._session.declare_subscriber(keys.event, self._on_event),
            self._session.declare_subscriber(keys.status, self._on_status),
        ]
        self._thread.start()

    def close(self) -> None:
        """Give up one's claim and end the thread; the server is closed by whoever opened it."""
        self._stopping = True
        self.claims.changed.set()
        if self._thread.is_alive():
            self._thread.join()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers = []
        self._drop_claim()

    def _on_claim(self, sample: zenoh.Sample) -> None:
        self.claims.hear(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def _on_event(self, sample: zenoh.Sample) -> None:
        told = fields_of(sample.payload.to_bytes())
        if told.get("instance") != self.server.instance and told.get("event") in OPERATIONS:
            self._differs()

    def _on_status(self, sample: zenoh.Sample) -> None:
        """Once a second the serving instance tells a digest of its model: ours of the same sample must be the same."""
        told = fields_of(sample.payload.to_bytes())
        server = self.server
        if server.role == PRIMARY or not server.synced or told.get("instance") == server.instance:
            return
        if self._stale or self._taking:
            return  # what it has now is to be replaced, and that it differs says nothing of what comes
        seq, theirs = told.get("snapshot_seq"), told.get("fingerprint")
        if isinstance(seq, int) and isinstance(theirs, str) and server.axis.differs(seq, theirs):
            server.axis.note("standby_differed", f"at sample {seq}; the state is taken over anew")
            self._differs()

    def _differs(self) -> None:
        self._stale = True
        self.claims.changed.set()

    def _run(self) -> None:
        until = time.monotonic() + self._patience_s
        while not self._stopping:
            self.claims.changed.clear()
            try:
                self._decide(until)
            except Exception as error:
                self.server.axis.note("internal_error", f"standby: {type(error).__name__}: {error}")
            first = self.claims.first()
            if self.server.role == STANDBY and first is None:
                wait_s = max(0.01, until - time.monotonic())
            else:
                wait_s = _AGAIN_S if self.server.role == STANDBY and self._stale else 1.0
            self.claims.changed.wait(wait_s)

    def _decide(self, until: float) -> None:
        first = self.claims.first()
        if self.server.role == PRIMARY:
            if first is not None and (first.epoch, first.instance) > (self._mine, self.server.instance):
                self._yield_to(first.instance)
            else:
                self._look_at_rival(first)
            return
        if first is None:
            # Who has stood by knows that the one that served is gone; who has just begun looks around first. Who is
            # cut off knows nothing.
            looked = self.settled.is_set() or time.monotonic() >= until
            if looked and not self._reach.cut_off() and self.claims.first() is None:
                self._take_over()
            return
        self.settled.set()
        if self._stale:
            self._take_state()

    def _look_at_rival(self, rival: Claim | None) -> None:
        """Claim anew where another one goes on serving that should have stood down.

        It may be that the wire did not tell it: of a pair of which one had been stopped this was seen (zenoh 1.10). Of
        a new claim it hears.
        """
        now = time.monotonic()
        if rival is None:
            self._rival_at = None
        elif self._rival_at is None:
            self._rival_at = now
        elif now - self._rival_at >= _UNHEARD_S:
            self._rival_at = now
            self._claim()
            told = f"as number {self._mine}: {rival.instance} serves as number {rival.epoch} and does not stand down"
            self.server.axis.note("claimed_anew", told)

    def _claim(self) -> None:
        """Hold a token above all that are known; the one before, if any, goes after it has come."""
        server, before = self.server, self._token
        server.epoch = self._mine = max(self._mine + 1, self.claims.next_epoch())
        self._token = self._session.liveliness().declare_token(server.keys.claim(self._mine, server.instance))
        if before is not None:
            before.undeclare()

    def _take_over(self) -> None:
        server = self.server
        self._claim()
        server.serve()
        server.intake.call(self._release, 60.0)
        self._stale = False
        server.synced = True
        self.settled.set()
        self.ready.set()

    def _yield_to(self, other: str) -> None:
        server = self.server
        server.axis.note("stood_down", f"{other} serves: it took over while this instance was not heard")
        # First, so that nobody takes what it has for the model of the one that serves.
        server.synced = False
        server.stand_down()
        self._drop_claim()
        self._rival_at = None
        server.intake.call(self._hold, 60.0)
        self._stale = True
        self._take_state()

    def _release(self) -> None:
        axis = self.server.axis
        # The first of a line takes over from nobody: what it began from is what it has.
        began = self.shadow.give_up(self._inherit if self._mine > 1 else lambda _: "")
        self.server.intake.gate = None
        if self._mine > 1:
            model = f"not synced: it goes on from {began}" if began else "with the model of the one before"
            axis.note("took_over", f"as number {self._mine}, {model}", synced=not began)

    def _inherit(self, newest_seq: int) -> str:
        return inherit(self.server.axis, self._estate, self.server.keys.stage, newest_seq)

    def _hold(self) -> None:
        self.shadow.hold()
        self.server.leave_tuning()
        self.server.intake.gate = self.shadow.gate

    def _take_state(self) -> None:
        """Take over the state of the one that serves; where it does not come, once more after a while."""
        self._taking, self._stale = True, False  # what makes it stale again may happen while it is taken
        taken = False
        try:
            taken = self._taken()
        finally:
            self._taking = False
            self._stale = self._stale or not taken

    def _taken(self) -> bool:
        data = ask_for_state(self._session, self.server.keys.state, _STATE_S, self._pause_s)
        # A machine that is too busy for it this time gets it more slowly the next.
        self._pause_s = min(2.0 * self._pause_s, MOST_PAUSE_S)
        if data is None:
            return False
        try:
            self.server.intake.call(lambda: self.shadow.take_state(data), 10.0)
        except DehystError as error:
            if str(error) != self._refused:
                self.server.axis.note("standby_refused", f"the state of the serving instance: {error}")
            self._refused = str(error)
            if isinstance(error, ModelFileError):
                # Another configuration: it stays without, and says so, but records all the same.
                self.ready.set()
            return False
        self._refused, self._pause_s = "", PAUSE_S
        self.server.synced = True
        self.ready.set()
        return True

    def _drop_claim(self) -> None:
        if self._token is not None:
            self._token.undeclare()
            self._token = None
