"""Publishes the changes of the models that learn, for followers (docs/protocol.md, "Model changes").

The thread that handles samples copies what moves (`service.server.moves`); the publishing thread makes the messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import Served
from dehyst.service.protocol.delta import DeltaMessage, FollowedState, doubles, encode_delta
from dehyst.service.protocol.keys import AUTO
from dehyst.service.protocol.model import model_parts
from dehyst.service.server.axis import Axis
from dehyst.service.server.moves import Move

#: Interval of the check for followers, s.
_LOOK_S: Final = 0.05


@dataclass(slots=True)
class _Stream:
    """The changes of one model. ``served`` : the snapshot whose kernel part ``state`` has."""

    name: str
    put: Callable[[bytes], None]
    followed: Callable[[], bool]
    state: FollowedState | None = None
    served: Served | None = None
    sent_at_s: float = -math.inf

    def send(self, change: tuple[FollowedState, DeltaMessage | None]) -> None:
        # First the state: a follower that gets the change may ask at once for a model that has it.
        self.state, message = change
        if message is not None:
            self.put(encode_delta(message))


class DeltaStreams:
    """The published changes of an axis. One thread calls all but `payload`."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._streams: dict[str, _Stream] = {}
        self._looked_s = -math.inf

    def publish(self, name: str, put: Callable[[bytes], None], followed: Callable[[], bool]) -> None:
        """Publish the changes of the model ``name`` by ``put`` while ``followed`` says that somebody subscribes."""
        self._streams[name] = _Stream(name, put, followed)

    def close(self) -> None:
        """Publish no longer."""
        self._streams = {}
        self._axis.moves.want(frozenset())

    def payload(self, name: str) -> bytes | None:
        """The whole model that the next change changes; None where no changes are published. From any thread."""
        stream = self._streams.get(name)
        state = None if stream is None else stream.state
        return None if state is None else state.payload()

    def tick(self, now_s: float) -> None:
        """Publish what has changed at ``now_s`` (``time.monotonic``)."""
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            self._look()
        moves = self._axis.moves.drain()
        newest = self._axis.newest
        for stream in self._streams.values():
            if stream.state is None:
                continue
            for move in moves:
                if move.served is stream.served:
                    stream.send(stream.state.changed(self._entries(stream.name, move), move.seq))
            if newest is not stream.served and now_s - stream.sent_at_s >= 0.5 / self._axis.config.delta_hz:
                stream.served, stream.sent_at_s = newest, now_s
                later = [move for move in moves if move.served is newest]
                state = self._snapshot(stream, newest)
                if later:  # one message for the snapshot and the first move from it
                    state = state.changed(self._entries(stream.name, later[0]), later[0].seq)[0]
                stream.send(stream.state.replaced(state))
                for move in later[1:]:
                    stream.send(stream.state.changed(self._entries(stream.name, move), move.seq))

    def _look(self) -> None:
        """Begin the streams that have followers now, and end those that have none."""
        for stream in self._streams.values():
            followed = stream.followed()
            if followed and stream.served is None:
                stream.served = newest = self._axis.newest
                stream.send((state := self._snapshot(stream, newest), state.whole()))
            elif not followed:
                stream.state = stream.served = None
        self._axis.moves.want(frozenset(name for name, stream in self._streams.items() if stream.served is not None))

    def _snapshot(self, stream: _Stream, served: Served) -> FollowedState:
        model, seq, memory = self._axis.model(stream.name, served)
        parts = model_parts(stream.name, model, memory, self._axis.safety(stream.name, served))
        return FollowedState.of(*parts, seq, stream.state)

    def _entries(self, name: str, move: Move) -> dict[str, bytes]:
        """What ``move`` changes; nothing in a champion that is another model than the one that learns."""
        part, learn, memory, prefix = move.part, self._axis.config.learn, move.part.memory, ""
        if name == AUTO:
            champion = move.served.models[AUTO]
            if not isinstance(champion, ChampionInverse) or champion.names[champion.champion] != learn:
                return {}
            # The other contestants' memories stay those of the snapshot: to track them too costs as much as learning.
            memory, prefix = champion.with_memory(move.served.memories[AUTO], learn, memory), f"{learn}."
        return {
            f"{prefix}features.gain": doubles(part.gain),
            f"{prefix}features.offset_um": doubles(part.offset_um),
            f"{prefix}beta": doubles(part.beta),
            f"{prefix}domain": doubles(part.domain),
            f"{prefix}noise_variance": doubles(part.noise_variance),
            "/memory": doubles(memory),
        }
