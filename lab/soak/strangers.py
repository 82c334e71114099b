"""Strangers to a service: processes on its network that do not have its key, and try to move it.

``python -m dehyst.lab.soak.strangers forge ENDPOINT SEED MODEL.npz`` answers whoever asks for the state with forged
ones, and with some that it begins and never ends, and makes standbys ask. ``... claim ENDPOINT SEED`` claims to serve,
and tells again what the one that serves claims. Both ask for the state too, with signatures that they have seen. They
print ``ready``, run until they are stopped, and print JSON: how often they ``tried``, and how many ``states`` they were
given.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
import zenoh

from dehyst.adaptive.types import StateDict
from dehyst.lab.soak.controller import AXIS, SERVED, STAGE
from dehyst.lab.testbed.processes import run_client_process
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.failover.state_transfer import fetch_state, part_of
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import SURELY, open_client
from dehyst.service.runtime.stopping import StopSignal
from dehyst.service.security.authenticator import STAMP, TAG
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.checkpoint import CheckpointMeta, encode_checkpoint

#: Pause between two attempts, s; longest wait for a state that is asked for, s.
PAUSE_S: Final = 0.5
_ASK_S: Final = 0.3
#: Sessions that begin to send a state and stop.
_CROWD: Final = 6
#: An epoch above any that is known.
EPOCH: Final = 900_000_000


def forged_states(model: Path, seed: int) -> Iterator[tuple[CheckpointMeta, StateDict]]:
    """States of an axis without end, (meta, state): each with one array emptied, cut or full of NaN."""
    axis = load_axis(STAGE, AxisConfig(AXIS, model, Limits(0.0, 10.0, 1e4), served=SERVED))
    whole = axis.state_dict()
    arrays = [name for name, value in whole.items() if isinstance(value, np.ndarray) and value.size]
    rng = np.random.default_rng(seed)
    meta = CheckpointMeta(STAGE, AXIS, axis.dt_s, 2**40, 2**40, instance="i0-stranger", models=axis.identified)
    for number in itertools.count(1):
        name = arrays[int(rng.integers(len(arrays)))]
        value = whole[name]
        yield meta, whole | {name: (value[:0], value.ravel()[:1], np.full(value.shape, np.nan))[number % 3]}


class Stranger:
    """What both have: they ask for the state, through a session of their own, and count what they get."""

    def __init__(self, session: zenoh.Session) -> None:
        self.counts = {"tried": 0, "states": 0}
        self.session = session
        self.keys = Keys(STAGE, AXIS)
        #: Whether it asks now: it does not answer itself.
        self.asks = False
        #: Parameters and attachment of the last signed query.
        self.seen: tuple[str, bytes] | None = None

    def run(self, stop: StopSignal, act: Any) -> None:
        """Until stopped: ``act``, and ask for the state, unsigned, and with the signature that a standby sent."""
        print("ready", flush=True)
        while not stop.reason:
            act()
            stop.wait(PAUSE_S)
            self.asks = True
            self.counts["tried"] += 1
            self.counts["states"] += fetch_state(self.session, self.keys.state, _ASK_S) is not None
            if self.seen is not None:
                parameters, attached = self.seen
                replies = self.session.get(f"{self.keys.state}?{parameters}", attachment=attached, timeout=_ASK_S)
                self.counts["states"] += any(reply.ok is not None for reply in replies)
            self.asks = False
        print(json.dumps(self.counts), flush=True)

    def see(self, query: zenoh.Query) -> None:
        """Keep what a query for the state carries."""
        attached = None if query.attachment is None else query.attachment.to_bytes()
        if attached and len(attached) > STAMP:
            self.seen = str(query.parameters), attached


def forge(endpoint: str, seed: int, model: Path) -> int:
    """Answer for the state with forged ones, and tell standbys that the model has changed, so that they ask."""
    stop, states = StopSignal(), forged_states(model, seed)
    next(states)
    with ExitStack() as stack:
        session, own = (stack.enter_context(open_client(endpoint, 20.0)) for _ in range(2))
        stranger = Stranger(own)
        keys = stranger.keys
        held: deque[zenoh.Query] = deque(maxlen=_CROWD)

        def answer(query: zenoh.Query) -> None:
            stranger.see(query)
            with query:
                if not stranger.asks:
                    part, _ = part_of(b"".join(encode_checkpoint(*next(states))), 0)
                    query.reply(keys.state, part, attachment=query.attachment)

        def begin(query: zenoh.Query) -> None:
            """Send the first of some parts, and leave the query open; not to this process itself."""
            if stranger.asks:
                with query:
                    return
            held.append(query)
            query.reply(keys.state, part_of(bytes(3_000_000), 0)[0], attachment=bytes(32))

        stack.callback(session.declare_queryable(keys.state, answer).undeclare)
        for _ in range(_CROWD):
            crowd = stack.enter_context(open_client(endpoint, 20.0))
            stack.callback(crowd.declare_queryable(keys.state, begin).undeclare)
        stack.callback(held.clear)
        # A standby believes an event at most as far as to ask who serves for the state.
        event = json.dumps({"event": "selected", "instance": "i0-stranger"})
        stranger.run(stop, lambda: session.put(keys.event, event, congestion_control=SURELY))
    return 0


def claim(endpoint: str, seed: int) -> int:
    """Claim to serve, by one name after the other, unsigned and with tags of nobody, and answer for the status."""
    stop, rng = StopSignal(), np.random.default_rng(seed)
    with ExitStack() as stack:
        session, own = (stack.enter_context(open_client(endpoint, 20.0)) for _ in range(2))
        stranger = Stranger(own)
        keys = stranger.keys
        tokens: list[Any] = []
        claims, told = set[str](), set[str]()

        def see(query: zenoh.Query) -> None:
            with query:
                stranger.see(query)

        def alive(query: zenoh.Query) -> None:
            with query:
                name = json.dumps({"instance": f"i{max(0, len(tokens) - 1)}-rogue"})
                query.reply(keys.status, name, attachment=bytes(32))

        def act() -> None:
            tag = "" if len(tokens) % 2 else rng.bytes(TAG).hex()
            again = {real for real in set(claims) if "-rogue" not in real} - told
            told.update(again)
            for key in (keys.token("claim", f"{EPOCH + len(tokens)}/i{len(tokens)}-rogue", tag), *again):
                tokens.append(session.liveliness().declare_token(key))

        for entity in (
            session.declare_queryable(keys.state, see),
            session.declare_queryable(keys.status, alive),
            session.liveliness().declare_subscriber(
                keys.tokens("claim"), lambda sample: claims.add(str(sample.key_expr)), history=True
            ),
        ):
            stack.callback(entity.undeclare)
        stack.callback(lambda: [token.undeclare() for token in tokens])
        stranger.run(stop, act)
    return 0


def main(argv: list[str]) -> int:
    """Entry of the process. Returns its exit status."""
    what, endpoint, seed = argv[:3]
    return claim(endpoint, int(seed)) if what == "claim" else forge(endpoint, int(seed), Path(argv[3]))


if __name__ == "__main__":
    sys.exit(run_client_process(lambda: main(sys.argv[1:])))
