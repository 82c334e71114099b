"""What moves in the model that learns between two snapshots, for followers.

A move has the learner's present linear part, frame, domain, deviation and memory; the kernel part is that of the
snapshot. Nothing is done while there are no followers. Answers to queries do not depend on moves.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import MovingPart, OnlineModel
from dehyst.service.answers.answering import Served

#: Moves that wait for the publishing thread; of more the oldest are left out, which followers do not notice.
_KEPT: Final = 64


class Move(NamedTuple):
    """What has moved since the snapshot ``served``, up to sample ``seq``.

    ``part`` : of the learning model, its constant with the bias of the snapshot's kernel part.
    """

    served: Served
    seq: int
    part: MovingPart


class Moves:
    """Collects the moves of one axis at sample numbers that do not depend on the messages, for who follows.

    Parameters
    ----------
    learn : name of the model that learns. rate_hz : highest rate of moves, 0 for none. dt_s : sample time, s.
    """

    def __init__(self, learn: str, rate_hz: float, dt_s: float) -> None:
        self._learn = learn
        #: Samples between two moves.
        self.every = max(1, math.ceil(1.0 / (rate_hz * dt_s) - 1e-9)) if rate_hz > 0.0 and learn else 0
        self._wanted: frozenset[str] = frozenset()
        self._waiting: deque[Move] = deque(maxlen=_KEPT)
        self._last = -1
        #: The snapshot, the bias of its kernel part, V, and what stands for that part; None: nothing moves from it.
        self._begun: tuple[Served, float, object] | None = None

    def want(self, names: frozenset[str]) -> None:
        """Which models are followed; from any thread."""
        self._wanted = names

    @property
    def waiting(self) -> bool:
        """Whether there are moves to publish."""
        return bool(self._waiting)

    def drain(self) -> list[Move]:
        """The moves since the last call, oldest first."""
        moves = []
        while self._waiting:
            moves.append(self._waiting.popleft())
        return moves

    def due(self, seq: int) -> bool:
        """Whether a move is due after sample ``seq``: after the last of each ``every`` numbers."""
        return bool(self._wanted) and self.every > 0 and (seq + 1) % self.every == 0

    def due_at_end(self, seq: int) -> bool:
        """Whether a move is due after ``seq``, the last sample of a message."""
        return bool(self._wanted) and self.every > 0 and abs(seq - self._last) >= self.every

    def begin(self, served: Served, learner: OnlineModel | None) -> None:
        """Moves count from the snapshot ``served`` on, which has just been taken."""
        self._begun = None
        if not self._wanted or learner is None or served.frozen or served.trouble:
            return
        model, now = served.models.get(self._learn), learner.moving()
        if now is None or type(model) is not LssvmInverse or model.beta.shape != now.beta.shape:
            return
        frame = (model.features.gain, model.features.offset_um)
        # The watch may serve another model than the learner's newest.
        if frame == (now.gain, now.offset_um) and np.array_equal(model.beta[1:], now.beta[1:]):
            self._begun = served, float(model.beta[0] - now.beta[0]), now.kernel

    def take(self, seq: int, learner: OnlineModel | None) -> None:
        """Note what has moved up to sample ``seq``."""
        self._last = seq
        if self._begun is None or learner is None:
            return
        served, bias_V, kernel = self._begun
        part = learner.moving()
        if part is None or part.kernel is not kernel or part.memory.shape != served.memories[self._learn].shape:
            return
        if not (all_finite(part.beta) and all_finite(part.memory)):
            return
        part.beta[0] += bias_V
        self._waiting.append(Move(served, seq, part))
