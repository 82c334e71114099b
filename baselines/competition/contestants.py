"""Which online models can compete, how a stored state names them, and how an identified baseline starts one."""

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
from baselines.linear import LinearInverse, LinearOnline
from baselines.online_baseline import OnlineBaseline
from baselines.prandtl_ishlinskii.inverse import MpiInverse
from baselines.prandtl_ishlinskii.online import MpiOnline

#: Makes a new online model from the last snapshot of one that has failed.
Restart = Callable[[InverseModel], OnlineModel]
#: Class of a contestant by the name that stored states use.
ONLINE_KINDS: Final[dict[str, type[Learner] | type[OnlineBaseline]]] = {
    "learner": Learner,
    "linear": LinearOnline,
    "mpi": MpiOnline,
    "bouc_wen": BoucWenOnline,
}
#: Inverse models whose stated deviation is that of a fit, not of served answers.
_BASELINES = (LinearInverse, MpiInverse, BoucWenInverse)


def online_form(model: InverseModel) -> OnlineModel | None:
    """A new online model that starts from an identified baseline; None where the model has no online form."""
    if isinstance(model, LinearInverse):
        return LinearOnline(model)
    if isinstance(model, MpiInverse):
        return MpiOnline(model)
    if isinstance(model, BoucWenInverse):
        return BoucWenOnline(model)
    return None


def with_deviation_of_at_least(model: InverseModel, rms_V: float) -> InverseModel:
    """``model`` with a stated standard deviation of at least ``rms_V``, V, the error measured on served answers.

    A baseline states the residual of its own fit, which is too small for answers as old as those of callers. An LSSVM
    calibrates its deviation on its own predictions and is returned unchanged. An ``rms_V`` of 0 means that nothing
    has been scored yet; the model is then returned unchanged too.
    """
    if not isinstance(model, _BASELINES) or not 0.0 < rms_V < math.inf:
        return model
    return model if model.voltage_std_V >= rms_V else replace(model, voltage_std_V=rms_V)


def fingerprint(model: InverseModel) -> str:
    """Digest of a model's parameters, 16 hexadecimal digits."""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        array = isinstance(value, np.ndarray)
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(value).tobytes() if array else json.dumps(value).encode())
    return sha.hexdigest()
