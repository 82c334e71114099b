"""Payloads, keys and errors of the wire (docs/protocol.md); needs numpy only.

`keys` names the keys, `samples` the payloads of stage and controller, `query` and `reply` those of a feedforward query,
`model` a snapshot, `container` the body that snapshot, checkpoint and model file share, `model_classes` the models by
their stored kind, `errors` the exceptions and error replies.
"""

from __future__ import annotations

from dehyst.service.protocol.errors import (
    BehindError,
    FieldError,
    NoReplyError,
    RefusedError,
    ReplyTimeoutError,
    ServiceError,
    SessionError,
)
from dehyst.service.protocol.keys import AUTO, Keys

__all__ = [
    "AUTO",
    "BehindError",
    "FieldError",
    "Keys",
    "NoReplyError",
    "RefusedError",
    "ReplyTimeoutError",
    "ServiceError",
    "SessionError",
]
