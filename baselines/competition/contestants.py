"""Who may compete: the online forms of the models, by kind, to be begun from an identified model or a kept state."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from adaptive.online.learner import Learner
from adaptive.types import InverseModel, OnlineModel
from baselines.bouc_wen.inverse import BoucWenInverse
from baselines.bouc_wen.online import BoucWenOnline
from baselines.linear import LinearInverse
from baselines.linear_online import LinearOnline
from baselines.online import OnlineBaseline
from baselines.prandtl_ishlinskii.inverse import MpiInverse
from baselines.prandtl_ishlinskii.online import MpiOnline

#: Makes a model that has failed anew, from its last snapshot.
Revive = Callable[[InverseModel], OnlineModel]
#: Kinds of contestants that a state can be read back into.
ONLINE_KINDS: Final[dict[str, type[Learner] | type[OnlineBaseline]]] = {
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


def stating(model: InverseModel, rms_V: float) -> InverseModel:
    """``model`` with a deviation of at least ``rms_V``, V, what its answers were judged to be wrong by.

    A baseline knows the residuals of its own fit, which say little of an answer as old as callers' are. An LSSVM
    is calibrated on its own predictions, and stays as it is.
    """
    # Before any answer was judged nothing is known, which is not that nothing is wrong.
    if not isinstance(model, LinearInverse | MpiInverse | BoucWenInverse) or not 0.0 < rms_V < math.inf:
        return model
    return model if model.voltage_std_V >= rms_V else replace(model, voltage_std_V=rms_V)


def fingerprint(model: InverseModel) -> str:
    """A short digest of a model's numbers."""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        array = isinstance(value, np.ndarray)
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(value).tobytes() if array else json.dumps(value).encode())
    return sha.hexdigest()
