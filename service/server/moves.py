"""What moves in the model that learns between two whole models, for followers.

A move has the learner's present linear part, frame, domain, deviation and memory; the kernel part is that of a snapshot
of at most `WHOLE_S` before. Nothing is done while there are no followers. Answers to queries do not depend on moves.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple, TypeGuard

import numpy as np

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import InverseModel, MovingPart, OnlineModel
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import Served
from dehyst.service.protocol.keys import AUTO

#: Time of samples after which followers get the kernel part anew, s. On the demo's stage, whose gain drops, one that is
#: 0.2 s old changes voltages by 0.002 % of their range (median; 99 %: 0.02 %).
WHOLE_S: Final = 0.2
#: Moves that wait for the publishing thread; of more the oldest are left out, which followers do not notice.
_KEPT: Final = 64


class Move(NamedTuple):
    """What has moved since the snapshot ``base``, up to sample ``seq``.

    ``part`` : of the learning model, its constant with the bias of the snapshot's kernel part.
    """

    base: Served
    seq: int
    part: MovingPart


class Moves:
    """Collects the moves of one axis at sample numbers that do not depend on the messages, for followers.

    Parameters
    ----------
    learn : name of the model that learns. rate_hz : highest rate of moves, 0 for none. dt_s : sample time, s.

    Attributes
    ----------
    base : the snapshot that moves count from; None where only whole snapshots tell what has changed.
    """

    def __init__(self, learn: str, rate_hz: float, dt_s: float) -> None:
        self._learn = learn
        #: Samples between two moves, and between two bases.
        self.every = max(1, math.ceil(1.0 / (rate_hz * dt_s) - 1e-9)) if rate_hz > 0.0 and learn else 0
        self._base_every = math.ceil(WHOLE_S / dt_s)
        self._wanted = False
        self._waiting: deque[Move] = deque(maxlen=_KEPT)
        self._last = -1
        self.base: Served | None = None
        #: What stands for the kernel part of the base, and its bias, V.
        self._kernel: object = None
        self._bias_V = 0.0

    def want(self, wanted: bool) -> None:
        """Whether somebody follows; from any thread."""
        self._wanted = wanted

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
        return self._wanted and self.every > 0 and (seq + 1) % self.every == 0

    def due_at_end(self, seq: int) -> bool:
        """Whether a move is due after ``seq``, the last sample of a message."""
        return self._wanted and self.every > 0 and abs(seq - self._last) >= self.every

    def begin(self, served: Served, learner: OnlineModel | None) -> None:
        """``served`` has just been taken: moves count from it where the base is too old, or another model answers."""
        base, self.base = self.base, None
        if not self._wanted or learner is None or served.frozen or served.trouble:
            return
        model, now = served.models.get(self._learn), learner.moving()
        if now is None or not _is_newest(model, now):
            return
        # By the numbers of the samples, so that a run that is repeated, or fast, has the same bases.
        near = (
            base is not None
            and served.seq // self._base_every == base.seq // self._base_every
            and now.kernel is self._kernel
        )
        if base is not None and near and same_choice(base, served):
            self.base = base
        else:
            self.base, self._kernel, self._bias_V = served, now.kernel, float(model.beta[0] - now.beta[0])

    def end(self) -> None:
        """What is served was changed by an operator: only the whole model tells."""
        self.base = None

    def take(self, seq: int, learner: OnlineModel | None) -> None:
        """Note what has moved up to sample ``seq``."""
        self._last, base = seq, self.base
        if base is None or learner is None:
            return
        part = learner.moving()
        if part is None or part.kernel is not self._kernel or part.memory.shape != base.memories[self._learn].shape:
            return
        if not (all_finite(part.beta) and all_finite(part.memory)):
            return
        part.beta[0] += self._bias_V
        self._waiting.append(Move(base, seq, part))


def _is_newest(model: InverseModel | None, now: MovingPart) -> TypeGuard[LssvmInverse]:
    """Whether ``model`` is the learner's newest: the watch may serve another."""
    if type(model) is not LssvmInverse or model.beta.shape != now.beta.shape:
        return False
    frame = model.features.gain, model.features.offset_um
    return frame == (now.gain, now.offset_um) and np.array_equal(model.beta[1:], now.beta[1:])


def same_choice(one: Served, other: Served) -> bool:
    """Whether the same model answers by the same rules in both, so that only learnt numbers differ."""

    def choice(served: Served) -> tuple[object, ...]:
        auto = served.models.get(AUTO)
        champion = auto.champion if isinstance(auto, ChampionInverse) else -1
        return champion, served.stand_in, served.trust, served.trouble, served.frozen

    return choice(one) == choice(other)
