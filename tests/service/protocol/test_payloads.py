"""What goes over the wire: keys, payloads and containers."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.types import InverseModel
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.container import decode_body, encode_body
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import Keys, check_name
from dehyst.service.protocol.model import decode_model, encode_model
from dehyst.service.protocol.query import decode_query, encode_query

# --- Payloads: what is encoded comes back, and nothing malformed gets through.

FINITE = st.floats(allow_nan=False, allow_infinity=False)
ANY = st.floats()


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, wire.MAX_SEQ), ANY, ANY, ANY), min_size=1, max_size=20))
def test_samples_come_back_to_the_last_bit(rows: list[tuple[int, float, float, float]]) -> None:
    seq, t, u, y = (np.array(column) for column in zip(*rows, strict=True))
    batch = wire.decode_samples(wire.encode_samples(seq, t, u, y))
    assert batch.seq.tolist() == seq.tolist()
    for got, sent in ((batch.t_s, t), (batch.u_V, u), (batch.y_um, y)):
        np.testing.assert_array_equal(got, sent)


@settings(deadline=None)
@given(st.integers(0, wire.MAX_SEQ), st.lists(FINITE, min_size=1, max_size=50))
def test_blocks_come_back(seq: int, values: list[float]) -> None:
    command = wire.decode_command(wire.encode_command(seq, values))
    assert (command.seq, command.values.tolist()) == (seq, values)
    reference = wire.decode_reference(wire.encode_reference(seq, values))
    assert (reference.seq, reference.values.tolist()) == (seq, values)


@settings(deadline=None)
@given(
    n=st.integers(1, 30),
    memory=st.none() | st.lists(FINITE, max_size=9),
    acceleration=st.booleans(),
    model=st.sampled_from(["", "mpi", "größe"]),
    as_of=st.integers(-1, wire.MAX_SEQ),
    before=FINITE | st.just(math.nan),
)
def test_queries_come_back(
    n: int, memory: list[float] | None, acceleration: bool, model: str, as_of: int, before: float
) -> None:
    y, v, a = np.arange(3.0 * n).reshape(3, n)
    query = decode_query(encode_query(y, v, a if acceleration else None, memory, model, as_of, before))
    np.testing.assert_array_equal(query.y_um, y)
    np.testing.assert_array_equal(query.v_um_per_s, v)
    np.testing.assert_array_equal(query.a_um_per_s2, a if acceleration else np.zeros(n))
    assert (None if query.memory is None else query.memory.tolist()) == memory
    assert (query.model, query.as_of) == (model, as_of)
    assert query.u_before_V == before or (math.isnan(before) and math.isnan(query.u_before_V))
    assert query.y_um.flags.writeable  # compiled loops would be compiled once more for what is read-only


@pytest.mark.parametrize(
    ("payload", "field"),
    [
        (b"", "payload"),
        (struct.pack("<BBHIqd", 2, 2, 0, 1, 0, 1.0), "version"),
        (struct.pack("<BBHIqd", 1, 3, 0, 1, 0, 1.0), "kind"),
        (struct.pack("<BBHIqd", 1, 2, 1, 1, 0, 1.0), "options"),
        (struct.pack("<BBHIqd", 1, 2, 0, 0, 0, 1.0), "n"),
        (struct.pack("<BBHIqd", 1, 2, 0, 2**32 - 1, 0, 1.0), "n"),
        (struct.pack("<BBHIqd", 1, 2, 0, 2, 0, 1.0), "payload"),
        (struct.pack("<BBHIqd", 1, 2, 0, 1, 0, 1.0) + b"\0", "payload"),
        (struct.pack("<BBHIqd", 1, 2, 0, 1, -1, 1.0), "seq"),
        (struct.pack("<BBHIqdd", 1, 2, 0, 2, 0, 1.0, math.nan), "u_V[1]"),
    ],
)
def test_malformed_commands_are_refused_by_field(payload: bytes, field: str) -> None:
    with pytest.raises(FieldError) as refused:
        wire.decode_command(payload)
    assert refused.value.field == field
    assert refused.value.expected


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"y_um": [1.0, math.nan]}, "y_um[1]"),
        ({"v_um_per_s": [math.inf, 0.0]}, "v_um_per_s[0]"),
        ({"a_um_per_s2": [0.0, math.nan]}, "a_um_per_s2[1]"),
        ({"memory": [math.nan]}, "memory[0]"),
        ({"as_of": -2}, "as_of"),
        ({"u_before_V": math.inf}, "u_before_V"),
    ],
)
def test_bad_values_in_a_query_are_refused_by_field(change: dict[str, object], field: str) -> None:
    fields: dict[str, object] = {
        "y_um": [1.0, 2.0],
        "v_um_per_s": [0.0, 0.0],
        "a_um_per_s2": [0.0, 0.0],
        "memory": [0.0],
    }
    with pytest.raises(FieldError) as refused:
        decode_query(encode_query(**{**fields, **change}))  # type: ignore[arg-type]
    assert refused.value.field == field


def test_unequal_lengths_and_long_blocks_are_refused_before_they_are_sent() -> None:
    with pytest.raises(InputError, match="u_V"):
        wire.encode_samples([1, 2], [0.0, 1.0], [0.0], [0.0, 1.0])
    with pytest.raises(InputError, match="v_um_per_s"):
        encode_query([1.0, 2.0], [0.0])
    with pytest.raises(InputError, match="65536"):
        wire.encode_command(0, np.zeros(wire.MAX_COUNT + 1))
    with pytest.raises(InputError, match="one-dimensional"):
        wire.encode_command(0, np.zeros((2, 2)))


def test_a_model_with_a_memory_of_another_size_is_refused(models: dict[str, InverseModel]) -> None:
    model = models["lssvm_adaptive"]
    with pytest.raises(ModelFileError, match="memory"):
        decode_model(encode_model("lssvm_adaptive", model, 0, np.zeros(model.memory_size + 1)))


def test_the_bytes_printed_on_the_page_are_what_it_says() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^    (?:[0-9a-f]{2} ){8}.*\n)+", page, re.M)
    sample, query = (
        bytes.fromhex("".join(line.strip()[:23] for line in block.strip().splitlines())) for block in blocks
    )
    batch = wire.decode_samples(sample)
    assert (batch.seq[0], batch.t_s[0], batch.u_V[0], batch.y_um[0]) == (1000, 1.0, 5.0, 40.25)
    assert sample == wire.encode_samples(batch.seq, batch.t_s, batch.u_V, batch.y_um)
    asked = decode_query(query)
    assert (asked.y_um[0], asked.v_um_per_s[0], asked.as_of, asked.model) == (40.0, 0.0, -1, "")
    assert math.isnan(asked.u_before_V)


# --- The body of checkpoints and model messages: what is written comes back, what is malformed is refused by name.

ARRAYS = {
    "f": np.linspace(0.0, 1.0, 3), "b": np.array([True, False]), "u": np.arange(5, dtype=np.uint8),
    "i": np.arange(6).reshape(2, 3).T, "none": np.empty((0, 4)), "one": np.array(np.nan), "s": np.float32([1.5]),
}  # fmt: skip


def test_arrays_come_back_with_type_and_shape() -> None:
    text, *rest = encode_body({"meta": 1}, ARRAYS)
    assert len(text) % 8 == 0
    assert sum(map(len, rest)) % 8 == 0
    header, arrays = decode_body(b"".join((text, *rest)), len(text), 2**20)
    assert header == {"meta": 1}
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype  # type: ignore[union-attr]
        np.testing.assert_array_equal(arrays[name], array)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ([], "a JSON object"),
        ({}, "arrays"),
        ({"arrays": [1]}, "arrays"),
        ({"arrays": [["a", "<f8", ["x"]]]}, "arrays"),
        ({"arrays": [["a", "|O", [1]]]}, "arrays.a"),
        ({"arrays": [["a", "<f8", [-1]]]}, "arrays.a"),
        ({"arrays": [["a", "<f8", [1] * 5]]}, "at most 4 dimensions"),
        ({"arrays": [["a", "<f8", [2]]]}, "no more than"),
        *(({"arrays": [["a", "<f8", shape]]}, "at most 1024 bytes") for shape in ([0, 2**40], [2**62, 4], [0, 10**30])),
        *(({"arrays": [["a", "<f8", shape]]}, "arrays") for shape in ([float("inf")], [None])),
    ],
)
def test_a_malformed_header_is_refused(header: Any, words: str) -> None:
    text = json.dumps(header).encode()
    with pytest.raises(InputError, match=words):
        decode_body(text + bytes(8), len(text), 1024)


# --- Names and keys.


def test_keys_are_those_of_the_page() -> None:
    keys = Keys("demo", "x")
    assert keys.sample == "dehyst/v1/demo/x/sample"
    assert keys.alive("i1") == "dehyst/v1/demo/x/alive/i1"
    names = ("sample", "command", "reference", "feedforward", "model", "status", "event", "diagnostics")
    assert [getattr(keys, name) for name in names] == [f"dehyst/v1/demo/x/{name}" for name in names]


@pytest.mark.parametrize("name", ["", "X", "a/b", "*", "**", "a$*", "1a", "a b", "ä", "a" * 65, "a\n", None, 3])
def test_names_that_cannot_be_part_of_a_key_are_refused(name: object) -> None:
    with pytest.raises(InputError, match="stage"):
        check_name("stage", name)


@pytest.mark.parametrize("wrong", ["40", None, "a", {}, 1j, [40.0, None], [1, [2, 3]], np.array("x"), ["40"]], ids=repr)
def test_what_is_no_number_is_refused_by_field_and_never_guessed(wrong: Any) -> None:
    """Texts that show a number, None, dictionaries, rows of different lengths: one typed message each."""
    refused: dict[str, Callable[[], object]] = {
        "y_um": lambda: encode_query(wrong, 0.0),
        "v_um_per_s": lambda: encode_query(40.0, wrong),
        "u_before_V": lambda: encode_query(40.0, 0.0, u_before_V=wrong),
        "seq": lambda: wire.encode_samples(wrong, 0.0, 0.0, 0.0),
        "u_V": lambda: wire.encode_samples(1, 0.0, wrong, 0.0),
        "as_of": lambda: encode_query(40.0, 0.0, as_of=wrong),
    }
    if wrong is not None:  # for none
        refused["memory"] = lambda: encode_query(40.0, 0.0, memory=wrong)
    for field, encode in refused.items():
        with pytest.raises(InputError, match=f"^{field}: got "):
            encode()
    with pytest.raises(InputError, match=r"^seq: got .* expected a sequence number"):
        wire.encode_command(wrong, 1.0)


@pytest.mark.parametrize("seq", [1.5, [1.0, 2.5], np.nan, -1, 2**62 + 1])
def test_a_sample_number_is_never_rounded(seq: Any) -> None:
    n = np.size(seq)
    with pytest.raises(InputError, match="seq: got"):
        wire.encode_samples(seq, np.zeros(n), np.zeros(n), np.zeros(n))
    assert wire.decode_samples(wire.encode_samples([1.0, 2.0], np.zeros(2), np.zeros(2), np.zeros(2))).seq.tolist() == [
        1,
        2,
    ]
