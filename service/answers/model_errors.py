"""Keeps the words of an error that a model raises, which no model may: the answer is replaced, the reason is logged."""

from __future__ import annotations

import logging
import threading
import time
from typing import Final

from adaptive.types import InverseModel

_LOGGER: Final = logging.getLogger("dehyst.model")
#: An error is logged again after this time, s; so many different ones are told apart.
_AGAIN_S: Final = 60.0
_MOST: Final = 64
_lock: Final = threading.Lock()
_logged: dict[tuple[str, str], float] = {}


def log_model_error(model: InverseModel, error: Exception) -> None:
    """Log what ``model`` raised, with its traceback, at most once a minute for each kind of model and error."""
    key = type(model).__name__, type(error).__name__
    now = time.monotonic()
    with _lock:
        if now - _logged.get(key, -_AGAIN_S) < _AGAIN_S or len(_logged) >= _MOST:
            return
        _logged[key] = now
    _LOGGER.error("%s raised %s: %s; its answer is replaced", *key, error, exc_info=error)
