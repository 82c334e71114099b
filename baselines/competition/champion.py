"""What a competition serves: the champion's answer, blended from the one before it, all memories carried along.

The caller's memory holds one share a contestant and then every contestant's own memory. Point by point the shares move
to the champion, at a rate of one over ``blend_s``: after a change of champion every caller goes over in its own
stream, without a jump, and a call is still a pure function of its arguments.

The memory of a contestant that has no share follows the motion and the voltages that are answered (``carry``), as it
would follow those of the stage: that costs next to nothing, where its own answer, which nobody asks for, would not.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.finite import DOUBLE, all_finite, all_finite_doubles
from adaptive.inverse_model import LssvmInverse, evaluate_point
from adaptive.state_codec import prefixed, under
from adaptive.types import Feedforward, FloatArray, InverseModel, StateDict
from adaptive.window.arrays import IntArray
from baselines.competition.kinds import KINDS, Carry, carries, carry_of, kind_of


@dataclass(frozen=True)
class ChampionInverse:
    """Immutable; implements ``adaptive.types.InverseModel``.

    Parameters
    ----------
    names, models : of the contestants, in order, all of one sample time.
    champion : index of the one that answers.
    blend_s : how long a change of champion takes in a caller's stream of points, s.
    """

    names: tuple[str, ...]
    models: tuple[InverseModel, ...]
    champion: int
    blend_s: float = 0.05
    name: str = "auto"
    _cuts: tuple[int, ...] = field(init=False, repr=False, compare=False)
    #: The shares of a stream that is wholly the champion's, as bytes; and of the others what carries their memories.
    _alone: bytes = field(init=False, repr=False, compare=False)
    _others: tuple[tuple[Carry, slice], ...] = field(init=False, repr=False, compare=False)
    #: The champion's part of a memory, and the champion itself as compiled code takes it; None for another kind.
    _own: slice = field(init=False, repr=False, compare=False)
    _packed: tuple[FloatArray, IntArray] | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.models or len(self.names) != len(self.models) or not 0 <= self.champion < len(self.models):
            raise InputError(
                f"names, models, champion: got {len(self.names)}, {len(self.models)}, {self.champion}, "
                "expected as many names as models, and the index of one of them"
            )
        if len({model.dt_s for model in self.models}) != 1 or not self.blend_s >= 0.0:
            raise InputError("models, blend_s: expected models of one sample time, and a time of at least 0 s")
        sizes = [len(self.models), *(model.memory_size for model in self.models)]
        cuts = tuple(int(cut) for cut in np.cumsum(sizes))
        object.__setattr__(self, "_cuts", cuts)
        object.__setattr__(self, "_alone", self._settled().tobytes())
        parts = [slice(begin, end) for begin, end in itertools.pairwise(cuts)]
        object.__setattr__(self, "_others", carries(self.models, parts, self.champion))
        object.__setattr__(self, "_own", parts[self.champion])
        served = self.served
        object.__setattr__(self, "_packed", served.packed if type(served) is LssvmInverse else None)

    @property
    def dt_s(self) -> float:
        return self.models[0].dt_s

    @property
    def memory_size(self) -> int:
        """One share a contestant, then their memories in order."""
        return self._cuts[-1]

    @property
    def served(self) -> InverseModel:
        """The champion's model itself."""
        return self.models[self.champion]

    @property
    def valid(self) -> bool:
        """Whether the champion vouches for itself."""
        return bool(getattr(self.served, "valid", True))

    def rest_memory(self, y_um: float) -> FloatArray:
        """(m,) memory of a stage at rest at ``y_um``, wholly the champion's."""
        return np.concatenate([self._settled(), *(model.rest_memory(y_um) for model in self.models)])

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """Voltages for (n,) points; pure. Raises InputError on shapes that do not fit together."""
        if self._is_settled(memory):
            return self._champions(y_um, v_um_per_s, a_um_per_s2, memory)
        shares, parts = self._parts(memory)
        champion = self.served.feedforward(y_um, v_um_per_s, a_um_per_s2, parts[self.champion])
        n = champion.u_V.size
        weights = self._weights(shares, n)
        answers = {
            i: champion if i == self.champion else model.feedforward(y_um, v_um_per_s, a_um_per_s2, parts[i])
            for i, model in enumerate(self.models)
            if i == self.champion or shares[i] > 0.0
        }
        u, std, inside = champion.u_V, champion.std_V, champion.inside
        if len(answers) > 1:
            u, variance, inside = np.zeros(n), np.zeros(n), inside.copy()
            for i, answer in answers.items():
                # A contestant that has nothing finite to say leaves its share to the champion.
                u += weights[:, i] * np.where(np.isfinite(answer.u_V), answer.u_V, champion.u_V)
            for i, answer in answers.items():
                apart = np.where(np.isfinite(answer.u_V), answer.u_V, champion.u_V) - u
                variance += np.where(weights[:, i] > 0.0, weights[:, i] * (answer.std_V**2 + apart**2), 0.0)
                inside &= answer.inside | (weights[:, i] <= 0.0)
            std = np.sqrt(variance)
        ends = []
        for i, (model, part) in enumerate(zip(self.models, parts, strict=True)):
            end = answers[i].memory if i in answers else part.copy()
            if i not in answers and part.size:
                carry_of(model)(np.ascontiguousarray(y_um, dtype=np.float64), u, end)
            ends.append(end if np.isfinite(end).all() else part)
        return Feedforward(u, std, inside, np.concatenate([weights[-1] if n else shares, *ends]))

    def track(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, u_V: FloatArray, memory: FloatArray
    ) -> FloatArray:
        """(m,) memory after (n,) measured points with the voltages applied."""
        shares, parts = self._parts(memory)
        ends = []
        for model, part in zip(self.models, parts, strict=True):
            end = model.track(y_um, v_um_per_s, a_um_per_s2, u_V, part)
            ends.append(end if np.isfinite(end).all() else part)
        n = np.asarray(y_um).size
        return np.concatenate([self._weights(shares, n)[-1] if n else shares, *ends])

    def with_model(self, name: str, model: InverseModel) -> ChampionInverse:
        """The same with another model of the contestant called ``name``."""
        models = tuple(model if name == own else old for own, old in zip(self.names, self.models, strict=True))
        return replace(self, models=models)

    def with_memory(self, memory: FloatArray, name: str, own: FloatArray) -> FloatArray:
        """``memory`` (m,) with that of the contestant called ``name`` replaced by ``own``. Not changed in place."""
        i = self.names.index(name)
        after = memory.copy()
        after[self._cuts[i] : self._cuts[i + 1]] = own
        return after

    def _is_settled(self, memory: FloatArray) -> bool:
        """Whether a caller's stream of points is wholly the champion's: almost always."""
        if type(memory) is not np.ndarray or memory.dtype is not DOUBLE or memory.shape != self._cuts[-1:]:
            return False
        # As it leaves this class; anything else goes the long way, where it is judged.
        return memory[: len(self.models)].tobytes() == self._alone

    def _champions(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """The champion's answer, and all memories after it."""
        answer = self.models[self.champion].feedforward(y_um, v_um_per_s, a_um_per_s2, memory[self._own])
        after = memory.copy()
        after[self._own] = answer.memory
        for carry, part in self._others:
            carry(y_um, answer.u_V, after[part])
        if not all_finite(after):
            # One that cannot go on stays where it was; it is no reason for the others to.
            for first, stop in itertools.pairwise(self._cuts):
                if not np.isfinite(after[first:stop]).all():
                    after[first:stop] = memory[first:stop]
        return Feedforward(answer.u_V, answer.std_V, answer.inside, after)

    def evaluate_point(
        self, y_um: float, v_um_per_s: float, a_um_per_s2: float, memory: FloatArray, one: tuple[FloatArray, FloatArray]
    ) -> tuple[float, float, bool] | None:
        """``feedforward`` of one point, (voltage, deviation, inside), without its checks: three floats and no others.

        ``memory`` (m,) is advanced in place; ``one``: two arrays (1,) that are overwritten. None for another kind of
        champion, a stream that is not wholly its own, a memory that does not stay finite: ask ``feedforward`` with the
        memory from before. For who asks point by point at a controller's rate.
        """
        packed = self._packed
        if packed is None or not self._is_settled(memory):
            return None
        answer: tuple[float, float, bool] = evaluate_point(
            y_um, v_um_per_s, a_um_per_s2, memory[self._own], packed[0], packed[1]
        )
        motion, voltage = one
        motion[0], voltage[0] = y_um, answer[0]
        for carry, part in self._others:
            carry(motion, voltage, memory[part])
        return answer if all_finite_doubles(memory) else None

    def _settled(self) -> FloatArray:
        shares = np.zeros(len(self.models))
        shares[self.champion] = 1.0
        return shares

    def _weights(self, shares: FloatArray, n: int) -> FloatArray:
        """(n, k) shares at each of n points, going over to the champion from ``shares`` (k,)."""
        at = float(shares[self.champion])
        if at >= 1.0 or self.blend_s <= 0.0:
            return np.tile(self._settled(), (n, 1))
        own = np.minimum(1.0, at + np.arange(1, n + 1) * (self.dt_s / self.blend_s))
        weights = np.outer((1.0 - own) / (1.0 - at), shares)
        weights[:, self.champion] = own
        return weights

    def _parts(self, memory: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        memory = np.asarray(memory, dtype=np.float64)
        if memory.shape != (self.memory_size,):
            raise InputError(
                f"memory: got shape {memory.shape}, expected ({self.memory_size},);"
                " start from rest_memory() or bring back the memory of the last reply"
            )
        first, *rest = np.split(memory, self._cuts[:-1])
        total = float(first.sum())
        # Shares that are none, such as those of a memory made elsewhere, are taken for the champion's alone.
        if not (np.all(np.isfinite(first)) and np.all(first >= 0.0) and total > 0.0):
            return self._settled(), rest
        return first / total if total != 1.0 else first.copy(), rest

    def state_dict(self) -> StateDict:
        """Flat names: the contestants' own under ``NAME.``."""
        kinds = [kind_of(model) for model in self.models]
        state: StateDict = {
            "name": self.name,
            "names": ",".join(self.names),
            "kinds": ",".join(kinds),
            "champion": self.champion,
            "blend_s": self.blend_s,
        }
        for name, model in zip(self.names, self.models, strict=True):
            state |= prefixed(f"{name}.", model.state_dict())
        return state

    @classmethod
    def from_state(cls, state: StateDict) -> ChampionInverse:
        """Inverse of ``state_dict``. Raises ModelFileError on missing or misfit entries."""
        try:
            names, kinds = str(state["names"]).split(","), str(state["kinds"]).split(",")
            models = []
            for name, kind in zip(names, kinds, strict=True):
                models.append(KINDS[kind].from_state(under(f"{name}.", state)))
            return cls(tuple(names), tuple(models), int(state["champion"]), float(state["blend_s"]), str(state["name"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(
                f"champion model: entry missing or damaged: {error}; identify the stage again"
            ) from error
