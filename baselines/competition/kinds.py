"""The kinds of models that may compete, and how the memory of one follows what another one answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from adaptive.errors import InputError
from adaptive.inverse_model import LssvmInverse
from adaptive.types import FloatArray, InverseModel
from baselines.bouc_wen.inverse import BoucWenInverse
from baselines.linear import LinearInverse
from baselines.prandtl_ishlinskii.inverse import MpiInverse

#: Kinds of contestants that a state can be read back into.
KINDS: Final[dict[str, Any]] = {
    "lssvm": LssvmInverse,
    "linear": LinearInverse,
    "bouc_wen": BoucWenInverse,
    "mpi": MpiInverse,
}
#: Takes (n,) motion, µm, the voltages answered for it, V, and a memory that it advances in place.
Carry = Callable[[FloatArray, FloatArray, FloatArray], None]


def carry_of(model: InverseModel) -> Carry:
    """How the memory of a contestant follows what others answer."""
    carry: Carry | None = getattr(model, "carry", None)
    if carry is not None:
        return carry

    def track(y_um: FloatArray, u_V: FloatArray, memory: FloatArray) -> None:
        still = np.zeros(np.asarray(y_um).size)
        memory[:] = model.track(y_um, still, still, u_V, memory)

    return track


def carries(models: Sequence[InverseModel], parts: Sequence[slice], but: int) -> tuple[tuple[Carry, slice], ...]:
    """How the memories of all follow but that of number ``but``, with each one's part of a common memory."""
    others = ((carry_of(model), part) for i, (model, part) in enumerate(zip(models, parts, strict=True)) if i != but)
    return tuple((carry, part) for carry, part in others if part.stop > part.start)


def kind_of(model: InverseModel) -> str:
    """Kind of a contestant; raises InputError where its class is none of them."""
    for kind, known in KINDS.items():
        if type(model) is known:
            return kind
    raise InputError(
        f"model {model.name!r}: got a {type(model).__name__}, expected one of the kinds {', '.join(KINDS)}"
    )
