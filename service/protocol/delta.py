"""Changes of a followed model: the payload of kind 7 (docs/protocol.md, "Model changes").

A whole model is sent now and then, as a payload of kind 6. In between, each *move* carries all that moves with every
step of the learner: frame, linear part, domain, noise and memory. It states which whole model it is a move of, and
replaces the move before: a lost one costs nothing.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray, MovingPart
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.model import ModelMessage
from dehyst.service.protocol.samples import (
    DELTA,
    VERSION,
    check_finite,
    check_header,
    check_length,
    check_sizes,
    doubles,
)

# version, kind, options (0), doubles of the linear part, snapshot_seq, checksum of the whole model, doubles of memory
_HEAD: Final = struct.Struct("<BBHIqII")
#: gain, offset µm, noise V², domain
_FIXED: Final = 9


class Delta(NamedTuple):
    """What has moved in a whole model up to sample ``snapshot_seq``.

    Attributes
    ----------
    base : `checksum` of the payload of the whole model.
    memory : (m,) of the whole model. beta, domain : (p,), V, and (6,) of its LSSVM, which is its champion.
    """

    snapshot_seq: int
    base: int
    gain: float
    offset_um: float
    noise_variance: float
    domain: FloatArray
    beta: FloatArray
    memory: FloatArray


def checksum(payload: bytes) -> int:
    """CRC-32 of the payload of a whole model."""
    return zlib.crc32(payload)


def encode_delta(snapshot_seq: int, base: int, part: MovingPart, memory: FloatArray) -> bytes:
    """The payload; ``memory`` is that of the whole model, (m,)."""
    head = _HEAD.pack(VERSION, DELTA, 0, part.beta.size, snapshot_seq, base, memory.size)
    numbers = [part.gain, part.offset_um, part.noise_variance], part.domain, part.beta, memory
    return head + np.concatenate(numbers).astype("<f8", copy=False).tobytes()


def decode_delta(data: bytes) -> Delta:
    """Inverse of `encode_delta`. Raises InputError if it is malformed or not finite."""
    _, p = check_header(data, DELTA, _HEAD.size)
    *_, seq, base, m = _HEAD.unpack_from(data)
    if seq < -1:
        raise FieldError("snapshot_seq", seq, "a sequence number, or -1 before any sample")
    check_sizes(m, 0)
    check_length(data, _HEAD.size + 8 * (_FIXED + p + m))
    values = doubles(data, _HEAD.size, _FIXED + p + m)
    check_finite("values", values[: _FIXED + p])
    gain, offset_um, noise_variance = values[:3].tolist()
    beta, memory = values[_FIXED : _FIXED + p], values[_FIXED + p :]
    return Delta(seq, base, gain, offset_um, noise_variance, values[3:_FIXED], beta, memory)


def moved(whole: ModelMessage, delta: Delta) -> ModelMessage:
    """The whole model after a change of it. Raises InputError if they do not fit together.

    The kernel part is shared, so that a follower can make hundreds a second.
    """
    model = whole.model
    learnt = model.models[model.champion] if isinstance(model, ChampionInverse) else model
    if not isinstance(learnt, LssvmInverse):
        raise FieldError("base", f"a model {model.name!r} without a part that moves", "one that learns")
    if delta.memory.shape != whole.memory.shape:
        raise FieldError("m", delta.memory.size, f"{whole.memory.size}, as the whole model has")
    learnt = learnt.moved((delta.gain, delta.offset_um), delta.beta, delta.domain, delta.noise_variance)
    if isinstance(model, ChampionInverse):
        model = model.with_model(model.names[model.champion], learnt)
    else:
        model = learnt
    return replace(whole, model=model, snapshot_seq=delta.snapshot_seq, memory=delta.memory)
