"""Stored states of a learner: whether one fits the learner of an axis, and the fingerprint of a model."""

from __future__ import annotations

import hashlib
import json
import re
from typing import Any, Final

import numpy as np

from adaptive.errors import ModelFileError
from adaptive.types import InverseModel, OnlineModel, StateDict

#: Version of the state of an axis (`service.server.axis.Axis.state_dict`); others are refused.
STATE_SCHEMA: Final = 3
#: Entries of a learner's state that learning does not change: its settings, and of the identified model what tuning
#: does not change. They must equal those of the present learner.
_FIXED: Final = re.compile(r"(^|\.)(config\.|base\.(beta$|span_V$|features\.))")
#: Settings that older states lack; learners of that time had no such bounds.
_ADDED: Final = re.compile(r"(^|\.)config\.envelope\.")


def restored_learner(state: StateDict, like: OnlineModel) -> OnlineModel:
    """A learner of the kind of ``like`` with ``state``. Raises ModelFileError with the reason if it does not fit."""
    if not state:
        raise ModelFileError("it holds no learner, but this axis learns")
    for name, value in like.state_dict().items():
        if not _FIXED.search(name) or (name not in state and _ADDED.search(name)):
            continue
        if name not in state or not _equal(value, state[name]):
            what = "setting" if "config." in name else "identified model"
            raise ModelFileError(
                f"it belongs to another {what}: {name} is {_short(state.get(name))}, now {_short(value)}"
            )
    return like.restored(state)


def fingerprint(model: InverseModel) -> str:
    """16 hexadecimal digits; equal for models that give the same answers to the last bit."""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        # These may change without any change of the answers.
        if name in ("seq", "valid", "noise_variance"):
            continue
        sha.update(name.encode())
        sha.update(value.tobytes() if isinstance(value, np.ndarray) else json.dumps(value).encode())
    return sha.hexdigest()


def _equal(a: Any, b: Any) -> bool:
    # A file stores a number that is not finite as an array, and a tuple as a list.
    if isinstance(a, np.ndarray | float) or isinstance(b, np.ndarray | float):
        return np.shape(a) == np.shape(b) and bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))
    return bool(a == b or (isinstance(a, tuple) and list(a) == b))


def _short(value: Any) -> str:
    text = f"an array {value.shape}" if isinstance(value, np.ndarray) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
