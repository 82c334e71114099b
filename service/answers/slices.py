"""Evaluates a long query in slices, between which other queries run; the result is the same to the bit.

Only the LSSVM is cut: a point of it costs as much as fifty of a baseline, and its memory is carried from point to point
unchanged. The other models convert their memory at the ends of an evaluation, so that a cut would round it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import Feedforward, FloatArray, InverseModel, StateDict
from dehyst.baselines.competition.champion import ChampionInverse

#: Points of a slice: half a millisecond with a window of 500.
SLICE: Final = 256
#: Called after a slice with the number of points done. It returns when the next one may begin, or raises.
Pace = Callable[[int], None]


class StoppedError(BaseException):
    """Ends an evaluation between two slices. Not an `Exception`: the stand-in replaces a model that raises one."""


class SlicedLssvm:
    """An LSSVM evaluated in slices of `SLICE` points; implements ``adaptive.types.InverseModel`` as the model does."""

    def __init__(self, model: LssvmInverse, pace: Pace) -> None:
        self._model, self._pace = model, pace

    @property
    def name(self) -> str:
        return self._model.name

    @property
    def dt_s(self) -> float:
        return self._model.dt_s

    @property
    def memory_size(self) -> int:
        return self._model.memory_size

    @property
    def valid(self) -> bool:
        """Whether the learner declares the model valid."""
        return self._model.valid

    def rest_memory(self, y_um: float) -> FloatArray:
        return self._model.rest_memory(y_um)

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """As that of the model; `Pace` is called between two slices."""
        n = y_um.size
        parts: list[Feedforward] = []
        for start in range(0, n, SLICE):
            part = slice(start, start + SLICE)
            got = self._model.feedforward(y_um[part], v_um_per_s[part], a_um_per_s2[part], memory)
            parts.append(got)
            memory = got.memory
            self._pace(got.u_V.size)
        if not parts:
            return self._model.feedforward(y_um, v_um_per_s, a_um_per_s2, memory)
        u, std, inside = (np.concatenate([part[i] for part in parts]) for i in range(3))
        return Feedforward(u, std, inside, memory)

    def track(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, u_V: FloatArray, memory: FloatArray
    ) -> FloatArray:
        return self._model.track(y_um, v_um_per_s, a_um_per_s2, u_V, memory)

    def carry(self, y_um: FloatArray, u_V: FloatArray, memory: FloatArray) -> None:
        """As that of the model, in one piece: it costs a hundredth of an evaluation."""
        self._model.carry(y_um, u_V, memory)

    def state_dict(self) -> StateDict:
        return self._model.state_dict()


def in_slices(model: InverseModel, pace: Pace | None) -> InverseModel:
    """``model`` with its LSSVMs evaluated in slices; the model itself for None."""
    if pace is None:
        return model
    if isinstance(model, ChampionInverse):
        return replace(model, models=tuple(in_slices(contestant, pace) for contestant in model.models))
    return SlicedLssvm(model, pace) if isinstance(model, LssvmInverse) else model
