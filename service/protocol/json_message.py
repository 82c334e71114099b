"""JSON on the wire: what other processes send, and what this one answers."""

from __future__ import annotations

import json
from typing import Any, Final

import numpy as np

#: Encoding of replies and publications that are JSON.
JSON: Final = "application/json"


def fields_of(payload: bytes) -> dict[str, Any]:
    """The fields of a JSON object; empty if ``payload`` is not one. Never raises."""
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def to_json(value: Any) -> bytes:
    """JSON of ``value``, in which numpy's numbers and arrays may be; anything else becomes its text."""
    return json.dumps(value, default=_plain).encode()


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
