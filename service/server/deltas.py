"""Publishes the changes of the models that learn, for followers (docs/protocol.md, "Model changes").

The thread that handles samples decides when a whole model is due, and copies what moves between two
(`service.server.moves`); the publishing thread makes the messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import Served
from dehyst.service.protocol.delta import checksum, encode_delta
from dehyst.service.protocol.model import encode_model
from dehyst.service.server.axis import Axis
from dehyst.service.server.moves import Move, same_choice

#: Interval of the check for followers, s.
_LOOK_S: Final = 0.05
#: Pause between two whole models where nothing moves between them, and before the last message is sent again, s.
_PAUSE_S: Final = 0.1


@dataclass(slots=True)
class _Stream:
    """The changes of one model. ``base``, ``payload`` : the snapshot that was sent as a whole, and how; None, b"" while
    nobody follows. ``moved`` : whether moves of it were sent."""

    name: str
    put: Callable[[bytes], None]
    followed: Callable[[], bool]
    base: Served | None = None
    payload: bytes = b""
    moved: bool = False
    sent_at_s: float = -math.inf
    #: The last message, until it was sent twice: zenoh may drop it, and another may not come for long.
    last: bytes = b""

    def send(self, payload: bytes, now_s: float) -> None:
        """Publish a message."""
        self.last, self.sent_at_s = payload, now_s
        self.put(payload)


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
        self._axis.moves.want(False)

    def payload(self, name: str) -> bytes:
        """The whole model that the next changes are of; empty where no changes are published. From any thread."""
        stream = self._streams.get(name)
        return b"" if stream is None else stream.payload

    def tick(self, now_s: float) -> None:
        """Publish what has changed at ``now_s`` (``time.monotonic``)."""
        # In this order: the moves of an earlier base are among those that are drained.
        base = self._axis.moves.base
        moves = self._axis.moves.drain()
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            self._look(now_s)
        for stream in self._streams.values():
            newest = self._axis.newest
            if stream.base is None:
                continue
            if base is not None and self._moves(stream, base):
                # Of an earlier base, another contestant than the learner may be the champion.
                moving = [move for move in moves if self._moves(stream, move.base)]
                for move in moving:
                    self._send_move(stream, move, now_s)
                if not moving:
                    self._send_whole(stream, base, now_s)
            elif stream.moved or now_s - stream.sent_at_s >= _PAUSE_S or not same_choice(newest, stream.base):
                self._send_whole(stream, newest, now_s)
            if stream.last and now_s - stream.sent_at_s >= _PAUSE_S:
                stream.put(stream.last)
                stream.last = b""

    def _look(self, now_s: float) -> None:
        """Begin the streams that have followers now, and end those that have none."""
        for stream in self._streams.values():
            followed = stream.followed()
            if followed and stream.base is None:
                self._send_whole(stream, self._axis.moves.base or self._axis.newest, now_s)
            elif not followed:
                stream.base, stream.payload, stream.last = None, b"", b""
        self._axis.moves.want(any(stream.base is not None for stream in self._streams.values()))

    def _send_whole(self, stream: _Stream, served: Served, now_s: float) -> None:
        if served is stream.base:
            return
        model, seq, memory = self._axis.model(stream.name, served)
        payload = encode_model(stream.name, model, seq, memory, self._axis.safety(stream.name, served))
        # First the state: a follower that gets a change may ask at once for the model that it is of.
        stream.base, stream.payload, stream.moved = served, payload, False
        stream.send(payload, now_s)

    def _moves(self, stream: _Stream, base: Served) -> bool:
        """Whether what moves is in this model: not in a champion that is another one than learns."""
        model = base.models[stream.name]
        return not isinstance(model, ChampionInverse) or model.names[model.champion] == self._axis.config.learn

    def _send_move(self, stream: _Stream, move: Move, now_s: float) -> None:
        self._send_whole(stream, move.base, now_s)
        model, memory = move.base.models[stream.name], move.part.memory
        if isinstance(model, ChampionInverse):
            # The other contestants' memories stay those of the whole model: to track them costs as much as learning.
            memory = model.with_memory(move.base.memories[stream.name], self._axis.config.learn, memory)
        stream.moved = True
        stream.send(encode_delta(move.seq, checksum(stream.payload), move.part, memory), now_s)
