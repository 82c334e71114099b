"""Who may compete: the online forms of the models, by kind, to be begun from an identified model or a kept state."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from adaptive.learner import Learner
from adaptive.types import InverseModel, OnlineModel
from baselines.bouc_wen_inverse import BoucWenInverse
from baselines.linear import LinearInverse
from baselines.mpi_inverse import MpiInverse
from baselines.online_bouc_wen import BoucWenOnline
from baselines.online_linear import LinearOnline
from baselines.online_mpi import MpiOnline

#: Makes a model that has failed anew, from its last snapshot.
Revive = Callable[[InverseModel], OnlineModel]
#: Kinds of contestants that a state can be read back into.
KINDS: Final[dict[str, Any]] = {
    "learner": Learner,
    "linear": LinearOnline,
    "mpi": MpiOnline,
    "bouc_wen": BoucWenOnline,
}


def challenger(model: InverseModel) -> OnlineModel | None:
    """The online form of an identified baseline; None where it has none."""
    if isinstance(model, LinearInverse):
        return LinearOnline(model)
    if isinstance(model, MpiInverse):
        return MpiOnline(model)
    if isinstance(model, BoucWenInverse):
        return BoucWenOnline(model)
    return None


def fingerprint(model: InverseModel | None) -> str:
    """A short digest of a model's numbers; empty for none."""
    if model is None:
        return ""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        array = isinstance(value, np.ndarray)
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(value).tobytes() if array else json.dumps(value).encode())
    return sha.hexdigest()
