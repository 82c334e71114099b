"""The targets of the fuzzer: everything that decodes bytes of others, with valid payloads as seeds.

A target accepts any bytes. It may raise only the exceptions documented for malformed input, must be fast, and must not
keep memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import zenoh

from benchmarks.forged_states import edited, make_axis, recording
from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import MovingPart
from dehyst.service.failover.role_control import Claims
from dehyst.service.operating.verbs import Request, decode_request, encode_request
from dehyst.service.protocol import delta as wire_delta
from dehyst.service.protocol import model as wire_model
from dehyst.service.protocol import query as wire_query
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import error_from_json, error_to_json
from dehyst.service.protocol.keys import Keys
from dehyst.service.security.authenticator import Authenticator
from dehyst.service.security.tokens import Holder
from dehyst.service.stage_node.faults import decode_fault
from dehyst.service.storage import checkpoint
from tests.service.conftest import make_models

Target = Callable[[bytes], None]
#: What a decoder may raise on malformed bytes.
EXPECTED = (InputError, ModelFileError)


def _refusing(decode: Callable[[bytes], object]) -> Target:
    def target(data: bytes) -> None:
        with contextlib.suppress(*EXPECTED):
            decode(data)

    return target


def _answering() -> Target:
    """A query through the whole service: decoded and answered by a model."""
    lssvm = make_models()["lssvm_adaptive"]
    memory = lssvm.rest_memory(0.0)

    def target(data: bytes) -> None:
        try:
            query = wire_query.decode_query(data)
        except EXPECTED:
            return
        n = min(query.y_um.size, 64)
        carried = memory if query.memory is None or query.memory.size != memory.size else query.memory
        with np.errstate(all="ignore"):
            lssvm.feedforward(query.y_um[:n], query.v_um_per_s[:n], query.a_um_per_s2[:n], carried)

    return target


def _framed_model(data: bytes) -> None:
    """A model with any JSON and any body, under a header that fits them, so that decoding gets past the lengths."""
    size = int.from_bytes(data[:2], "little")
    text, body = data[2 : 2 + size], data[2 + size :]
    count = 1
    with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
        count = max(1, len(json.loads(text)["arrays"]))
    head = struct.pack("<BBHIqII", wire.VERSION, wire.MODEL, 0, count, 5, len(text), len(body))
    with contextlib.suppress(*EXPECTED):
        wire_model.decode_model(head + text + body)


def _framed_checkpoint(data: bytes) -> None:
    """A checkpoint with any JSON and any body, under a header whose digest fits: a standby decodes what a service
    sends."""
    size = int.from_bytes(data[:2], "little")
    digest = hashlib.blake2b(data[2:], digest_size=16).digest()
    head = struct.pack("<8sQ16s", checkpoint.MAGIC, min(size, len(data[2:])), digest)
    with contextlib.suppress(*EXPECTED):
        checkpoint.decode_checkpoint(head + data[2:])


def _changing() -> Target:
    """A payload of kind 7, taken by a follower: decoded, and made a model."""
    model = make_models()["lssvm_adaptive"]
    whole = wire_model.ModelMessage("lssvm_adaptive", model, 5, model.rest_memory(1.0))

    def target(data: bytes) -> None:
        with contextlib.suppress(*EXPECTED):
            decoded = wire_delta.decode_delta(data)
            made = wire_delta.moved(whole, decoded)
            if made.snapshot_seq != decoded.snapshot_seq:
                raise AssertionError("the result has another number than the message")

    return target


def _claims() -> Target:
    """Keys of liveliness tokens: whatever they say, nobody who lacks the key has a claim."""
    keys = Keys("demo", "x")
    claims = Claims(keys, "i-me", Authenticator(b"0123456789abcdef"))

    def target(data: bytes) -> None:
        claims.update(f"{keys.base}/claim/{data.decode(errors='replace')}", True)
        if claims.highest() is not None or claims.next_epoch() != 1:
            raise AssertionError("a claim without a tag was believed")

    return target


def _owners() -> Target:
    """The same of the token of the controller that commands."""
    keys, by = Keys("demo", "x"), Authenticator(b"0123456789abcdef")

    def target(data: bytes) -> None:
        if Holder.read(by, keys, f"{keys.base}/owner/{data.decode(errors='replace')}") is not None:
            raise AssertionError("a token without a tag was believed")

    return target


def _signed() -> Target:
    """An attachment, then a payload: as a publication, a reply and a request. Without the key none is believed."""
    by = Authenticator(b"0123456789abcdef")

    def target(data: bytes) -> None:
        attached, payload = zenoh.ZBytes(data[:32]), zenoh.ZBytes(data[32:])
        said: Any = SimpleNamespace(key_expr="k", parameters="", attachment=attached, payload=payload)
        answer = by.question(payload=data[32:]).answer(said)
        if by.heard(said, "k") is not None or answer is not None or by.is_asked_by_ours(said, "k"):
            raise AssertionError("a message without a right tag was believed")

    return target


def _state() -> Target:
    """A valid state with entries replaced: an axis refuses it, or takes it and learns and answers from it."""
    axis = make_axis(alone=True)
    axis.handle(recording(0, 400))
    state = axis.state_dict()

    def target(data: bytes) -> None:
        with np.errstate(all="ignore"), contextlib.suppress(ModelFileError):
            axis.restore(edited(state, data))
            # Small numbers: a count that was forged to be huge cannot go on.
            first = axis.sequence.last + 1 if 0 <= axis.sequence.last < 2**31 else 400
            axis.handle(recording(first, 5))
            u_V = axis.answer(wire_query.FeedforwardQuery(np.array([40.0]), np.zeros(1), np.zeros(1))).u_V
            if not (0.0 <= u_V[0] <= 10.0):
                raise AssertionError(f"a forged state was taken, and the answer is {u_V[0]} V")
        axis.take_events()

    return target


#: Words that a mutation may insert, from the JSON of the payloads.
WORDS = (
    '"name"', '"kind"', '"dt_s"', '"values"', '"arrays"', '"/memory"', '"lssvm"', '"linear"', '"<f8"', '"<i8"', '"|u1"',
    '"|b1"', "[]", "{}", "null", "true", "1e999", "-1", "NaN", '"verb"', '"who"', '"arguments"', '"freeze"', '"select"',
    '"rollback"', '"checkpoint"', '"model"', '"error"', '"message"', '"field"', "Timeout", "[[[[[[", '{"a":{"a":{"a":',
)  # fmt: skip

TARGETS: dict[str, Callable[[], Target]] = {
    "samples": lambda: _refusing(wire.decode_samples),
    "command": lambda: _refusing(wire.decode_command),
    "reference": lambda: _refusing(wire.decode_reference),
    "query": lambda: _refusing(wire_query.decode_query),
    "reply": lambda: _refusing(wire_query.decode_reply),
    "answer": _answering,
    "model": lambda: _refusing(wire_model.decode_model),
    "delta": _changing,
    "framed": lambda: _framed_model,
    "checkpoint": lambda: _framed_checkpoint,
    "state": _state,
    "claim": _claims,
    "owner": _owners,
    "signed": _signed,
    "fault": lambda: _refusing(decode_fault),
    "operate": lambda: _refusing(decode_request),
    "error": lambda: _refusing(error_from_json),
}


def _changes() -> list[bytes]:
    """Changes of the small LSSVM."""
    model = make_models()["lssvm_adaptive"]
    assert isinstance(model, LssvmInverse)
    memory = model.rest_memory(1.0)
    part = MovingPart(0.94, 1.8, model.beta + 0.01, model.domain, 2e-6, memory, None)
    return [wire_delta.encode_delta(seq, 7, part, memory) for seq in (-1, 9)]


def seeds(target: str) -> list[bytes]:
    """Valid payloads of a target."""
    y, v, a = np.linspace(1.0, 80.0, 12).reshape(3, 4)
    query = [
        wire_query.encode_query(40.0, 0.0),
        wire_query.encode_query(y, v, a, [1.0, 2.0], "lssvm_adaptive", 7, 1.5),
        wire_query.encode_query(y, v, a, make_models()["lssvm_adaptive"].rest_memory(3.0)),
        wire_query.encode_query(y, v, a, pending=wire_query.Pending(3, y, 0.1 * y)),
    ]
    sent = [wire_model.encode_model(name, m, 5, m.rest_memory(1.0)) for name, m in make_models().items()]
    framed = []
    for payload in sent:
        size = struct.unpack_from("<I", payload, 16)[0]
        framed.append(size.to_bytes(2, "little") + payload[24:])
    meta = checkpoint.CheckpointMeta("demo", "x", 1e-3, 41, 40)
    kept = b"".join(checkpoint.encode_checkpoint(meta, {"a": np.arange(3.0), "name": "x", "n": 2, "b": np.eye(2)}))
    reply = wire_query.Answer(y, v, np.zeros(4, np.uint8), np.ones(2), 41, "mpi", True, True, True)
    return {
        "samples": [wire.encode_samples([1, 2, 3], [0.0, 1e-3, 2e-3], [1.0, np.nan, 2.0], [3.0, 4.0, np.inf])],
        "command": [wire.encode_command(9, y)],
        "reference": [wire.encode_reference(9, y)],
        "query": query,
        "answer": query,
        "reply": [wire_query.encode_reply(reply)],
        "model": sent,
        "delta": _changes(),
        "framed": framed,
        "checkpoint": [kept[8:10] + kept[32:], b""],
        "state": [struct.pack("<HB8s", entry, change, bytes(8)) for entry, change in ((0, 0), (40, 3), (90, 41))],
        "owner": [
            b"1795875430000/0123456789abcdef/4711/lab1/00ff00ff00ff00ff00ff00ff00ff00ff",
            b"1/0123456789abcdef/2/lab1",
        ],
        "claim": [b"3/i-rogue/00ff00ff00ff00ff00ff00ff00ff00ff", b"999999999/i-rogue"],
        "signed": [Authenticator(bytes(16)).published("k", b"{}") or b"", bytes(40), b""],
        "fault": [b'{"fault": "nan", "duration_s": 1}', b'{"fault": "change", "values": {"gain_drift.gain": -0.06}}'],
        "operate": [
            encode_request(Request("rollback", "alice", {"checkpoint": 3})),
            encode_request(Request("select", "bob", {"model": "linear"})),
        ],
        "error": [error_to_json(InputError("y_um[0]: got nan")), json.dumps({"error": "x"}).encode(), b"Timeout"],
    }[target]
