"""The inverse model that a competition serves: the champion's answer, with the memories of all contestants.

The caller's memory holds one weight per contestant, then the memory of every contestant. From point to point the
weights move to the champion within ``blend_s``. After a change of champion, every caller therefore passes to the new
one in its own stream of points, without a jump, and a call is still a pure function of its arguments.

The memory of a contestant with weight 0 is advanced with the requested motion and the answered voltages, as it would
be with those of the stage. That costs far less than an answer of its own, which is not needed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Final

import numpy as np

from dehyst.adaptive.compiled import DOUBLE, all_finite, all_finite_doubles
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.inverse_model import LssvmInverse, evaluate_point
from dehyst.adaptive.state import Entry, Refused, load, save, within
from dehyst.adaptive.types import Feedforward, FloatArray, IntArray, InverseModel, StateDict, prefixed, under
from dehyst.baselines.bouc_wen.model import BoucWenInverse
from dehyst.baselines.linear import LinearInverse
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse

#: Class of a contestant's inverse model by the name that stored states use.
INVERSE_KINDS: Final[dict[str, Any]] = {
    "lssvm": LssvmInverse,
    "linear": LinearInverse,
    "bouc_wen": BoucWenInverse,
    "mpi": MpiInverse,
}
#: Largest rounding of the sum of the weights in a memory.
_SHARES_OFF: Final = 1e-6
#: Advances a memory in place: (n,) motion µm, (n,) voltages answered for it V, memory (m,).
AdvanceMemory = Callable[[FloatArray, FloatArray, FloatArray], None]


def _others_of(models: Sequence[Any], parts: Sequence[slice], champion: int) -> tuple[tuple[AdvanceMemory, slice], ...]:
    """What advances the memories of all models that have one, except the champion's, and their parts of the whole."""
    return tuple(
        (model.carry, part)
        for i, (model, part) in enumerate(zip(models, parts, strict=True))
        if i != champion and part.stop > part.start
    )


def _inverse_kind_of(model: InverseModel) -> str:
    """Name of the model's class in stored states. Raises InputError for a class that has none."""
    for kind, known in INVERSE_KINDS.items():
        if type(model) is known:
            return kind
    raise InputError(
        f"model {model.name!r}: got a {type(model).__name__}, expected one of the kinds {', '.join(INVERSE_KINDS)}"
    )


@dataclass(frozen=True, slots=True)
class ChampionEntries:
    """What a stored `ChampionInverse` holds beside its models, which are under their names."""

    name: Annotated[str, Entry("by which it is served", most=1000)]
    names: Annotated[str, Entry("names of the contestants, separated by commas", most=10_000)]
    kinds: Annotated[str, Entry("kinds of their models", most=10_000)]
    champion: Annotated[int, Entry("index of the contestant that answers", low=0)]
    blend_s: Annotated[float, Entry("duration of a change of champion in a caller's stream", "s", low=0.0)]


@dataclass(frozen=True)
class ChampionInverse:
    """The models of all contestants and which of them answers. Immutable; implements ``adaptive.types.InverseModel``.

    Parameters
    ----------
    names, models : the contestants, in order; all models have one sample time, and ``carry``, a `track` in place.
    champion : index of the contestant that answers.
    blend_s : duration of a change of champion in a caller's stream of points, s.

    Raises InputError where names, models and champion do not fit together.
    """

    names: tuple[str, ...]
    models: tuple[InverseModel, ...]
    champion: int
    blend_s: float = 0.05
    name: str = "auto"
    #: Ends of the parts of a memory: the weights, then the memory of each contestant.
    _ends: tuple[int, ...] = field(init=False, repr=False, compare=False)
    #: The weights of a stream that belongs to the champion alone, as bytes.
    _settled_bytes: bytes = field(init=False, repr=False, compare=False)
    #: How the memories of the other contestants advance, and where they lie.
    _others: tuple[tuple[AdvanceMemory, slice], ...] = field(init=False, repr=False, compare=False)
    #: The champion's part of a memory.
    _champion_part: slice = field(init=False, repr=False, compare=False)
    #: The champion's arrays for compiled code; None unless it is an LSSVM.
    _packed: tuple[FloatArray, IntArray] | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.models or len(self.names) != len(self.models) or not 0 <= self.champion < len(self.models):
            raise InputError(
                f"names, models, champion: got {len(self.names)}, {len(self.models)}, {self.champion}, "
                "expected one name per model and the index of one of them"
            )
        if len({model.dt_s for model in self.models}) != 1 or not self.blend_s >= 0.0:
            raise InputError("models, blend_s: expected models of one sample time and a blend time of at least 0 s")
        sizes = [len(self.models), *(model.memory_size for model in self.models)]
        ends = tuple(int(end) for end in np.cumsum(sizes))
        object.__setattr__(self, "_ends", ends)
        object.__setattr__(self, "_settled_bytes", self._settled_weights().tobytes())
        parts = [slice(start, stop) for start, stop in itertools.pairwise(ends)]
        object.__setattr__(self, "_others", _others_of(self.models, parts, self.champion))
        object.__setattr__(self, "_champion_part", parts[self.champion])
        served = self.served
        object.__setattr__(self, "_packed", served.packed if type(served) is LssvmInverse else None)

    @property
    def dt_s(self) -> float:
        """Sample time of all contestants, s."""
        return self.models[0].dt_s

    @property
    def memory_size(self) -> int:
        """Number of values in a memory: one weight per contestant, then their memories in order."""
        return self._ends[-1]

    @property
    def served(self) -> InverseModel:
        """The champion's model."""
        return self.models[self.champion]

    @property
    def valid(self) -> bool:
        """Whether the champion's answers can be used."""
        return bool(getattr(self.served, "valid", True))

    def rest_memory(self, y_um: float) -> FloatArray:
        """(m,) memory of a stage at rest at ``y_um`` µm; the champion has all the weight."""
        return np.concatenate([self._settled_weights(), *(model.rest_memory(y_um) for model in self.models)])

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """Voltages for (n,) points. Pure. Raises InputError on shapes that do not fit together.

        During a change of champion the voltage is the weighted mean of the contestants with a weight, ``std_V``
        includes their spread, and a point is inside only where all of them say so.
        """
        if self._is_settled(memory):
            return self._champion_alone(y_um, v_um_per_s, a_um_per_s2, memory)
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
                # Where a contestant has no finite answer, the champion's takes its place.
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
                model.carry(np.ascontiguousarray(y_um, dtype=np.float64), u, end)  # type: ignore[attr-defined]
            ends.append(end if np.isfinite(end).all() else part)
        return Feedforward(u, std, inside, np.concatenate([weights[-1] if n else shares, *ends]))

    def track(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, u_V: FloatArray, memory: FloatArray
    ) -> FloatArray:
        """(m,) memory after (n,) measured points with the applied voltages ``u_V``."""
        shares, parts = self._parts(memory)
        ends = []
        for model, part in zip(self.models, parts, strict=True):
            end = model.track(y_um, v_um_per_s, a_um_per_s2, u_V, part)
            ends.append(end if np.isfinite(end).all() else part)
        n = np.asarray(y_um).size
        return np.concatenate([self._weights(shares, n)[-1] if n else shares, *ends])

    def has_weights(self, memory: FloatArray) -> bool:
        """Whether the (m,) ``memory`` begins with weights: 0 to 1 each, with the sum 1. All that this model gave do."""
        # Each query pays for this: of a handful of numbers, numpy's reductions take ten times as long as plain floats.
        shares = memory[: len(self.models)].tolist()
        return all(0.0 <= share <= 1.0 for share in shares) and abs(sum(shares) - 1.0) <= _SHARES_OFF

    def with_model(self, name: str, model: InverseModel) -> ChampionInverse:
        """A copy in which the contestant ``name`` has another model."""
        models = tuple(model if name == own else old for own, old in zip(self.names, self.models, strict=True))
        return replace(self, models=models)

    def with_memory(self, memory: FloatArray, name: str, own: FloatArray) -> FloatArray:
        """A copy of ``memory`` (m,) in which ``own`` is the memory of the contestant ``name``."""
        i = self.names.index(name)
        after = memory.copy()
        after[self._ends[i] : self._ends[i + 1]] = own
        return after

    def _is_settled(self, memory: FloatArray) -> bool:
        """Whether the champion has all the weight in a caller's memory, which is almost always so."""
        if type(memory) is not np.ndarray or memory.dtype is not DOUBLE or memory.shape != self._ends[-1:]:
            return False
        # Compares with the weights as this class writes them; any others take the general path, which checks them.
        return memory[: len(self.models)].tobytes() == self._settled_bytes

    def _champion_alone(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """The champion's answer and all memories after it."""
        answer = self.models[self.champion].feedforward(y_um, v_um_per_s, a_um_per_s2, memory[self._champion_part])
        after = memory.copy()
        after[self._champion_part] = answer.memory
        for advance, part in self._others:
            advance(y_um, answer.u_V, after[part])
        if not all_finite(after):
            # A memory that is not finite is set back alone; the others keep their progress.
            for first, stop in itertools.pairwise(self._ends):
                if not np.isfinite(after[first:stop]).all():
                    after[first:stop] = memory[first:stop]
        return Feedforward(answer.u_V, answer.std_V, answer.inside, after)

    def evaluate_point(
        self, y_um: float, v_um_per_s: float, a_um_per_s2: float, memory: FloatArray, one: tuple[FloatArray, FloatArray]
    ) -> tuple[float, float, bool] | None:
        """``feedforward`` of one point without checks, for calls at a controller's rate: (voltage, deviation, inside).

        ``memory`` (m,) is advanced in place; ``one`` holds two work arrays (1,). Returns None where the champion is no
        LSSVM, where it does not have all the weight, or where the memory does not stay finite. Then call
        ``feedforward`` with a copy of the memory from before.
        """
        packed = self._packed
        if packed is None or not self._is_settled(memory):
            return None
        answer: tuple[float, float, bool] = evaluate_point(
            y_um, v_um_per_s, a_um_per_s2, memory[self._champion_part], packed[0], packed[1]
        )
        motion, voltage = one
        motion[0], voltage[0] = y_um, answer[0]
        for advance, part in self._others:
            advance(motion, voltage, memory[part])
        return answer if all_finite_doubles(memory) else None

    def _settled_weights(self) -> FloatArray:
        shares = np.zeros(len(self.models))
        shares[self.champion] = 1.0
        return shares

    def _weights(self, shares: FloatArray, n: int) -> FloatArray:
        """(n, k) weights at each of n points, moving from ``shares`` (k,) to the champion."""
        at = float(shares[self.champion])
        if at >= 1.0 or self.blend_s <= 0.0:
            return np.tile(self._settled_weights(), (n, 1))
        own = np.minimum(1.0, at + np.arange(1, n + 1) * (self.dt_s / self.blend_s))
        weights = np.outer((1.0 - own) / (1.0 - at), shares)
        weights[:, self.champion] = own
        return weights

    def _parts(self, memory: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        memory = np.asarray(memory, dtype=np.float64)
        if memory.shape != (self.memory_size,):
            raise InputError(
                f"memory: got shape {memory.shape}, expected ({self.memory_size},);"
                " start from rest_memory() or send the memory of the last reply"
            )
        first, *rest = np.split(memory, self._ends[:-1])
        total = float(first.sum())
        # Weights that are not valid, such as those of a memory from elsewhere, become the champion's alone.
        if not (np.all(np.isfinite(first)) and np.all(first >= 0.0) and total > 0.0):
            return self._settled_weights(), rest
        return first / total if total != 1.0 else first.copy(), rest

    def state_dict(self) -> StateDict:
        """Flat entries; contestants under ``NAME.``. Raises InputError for a class that cannot be stored."""
        kinds = ",".join(_inverse_kind_of(model) for model in self.models)
        state = save(ChampionEntries(self.name, ",".join(self.names), kinds, self.champion, self.blend_s))
        for name, model in zip(self.names, self.models, strict=True):
            state |= prefixed(f"{name}.", model.state_dict())
        return state

    @classmethod
    def from_state(cls, state: StateDict) -> ChampionInverse:
        """Inverse of ``state_dict``. Raises ModelFileError on missing or damaged entries."""
        names = str(state.get("names")).split(",")
        models = {name: under(f"{name}.", state) for name in names}
        own = load(
            ChampionEntries,
            {n: value for n, value in state.items() if not n.startswith(tuple(f"{name}." for name in names))},
        )
        kinds, built = own.kinds.split(","), []
        if len(set(names)) != len(names) or len(kinds) != len(names) or set(kinds) - set(INVERSE_KINDS):
            raise Refused("kinds", repr(own.kinds)[:80], f"one of {', '.join(INVERSE_KINDS)} for each of {names}"[:200])
        for name, kind in zip(names, kinds, strict=True):
            with within(f"{name}."):
                built.append(INVERSE_KINDS[kind].from_state(models[name]))
        try:
            return cls(tuple(names), tuple(built), own.champion, own.blend_s, own.name)
        except ValueError as error:
            raise Refused.by_check(error) from error
