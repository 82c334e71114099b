"""What another process tells as JSON, where a message that is none is passed over."""

from __future__ import annotations

import json
from typing import Any


def fields_of(payload: bytes) -> dict[str, Any]:
    """The fields of a JSON object; none where ``payload`` is not one. Never raises."""
    try:
        told = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return told if isinstance(told, dict) else {}
