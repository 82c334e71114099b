"""The body of checkpoints and model messages: what is written comes back, what is malformed is refused by name."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from adaptive.errors import InputError, ModelFileError
from service.protocol.container import decode_body, encode_body, split_state

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


def test_what_is_not_finite_becomes_an_array() -> None:
    values, arrays = split_state({"a": float("nan"), "b": np.float64(2.0), "c": "word", "d": np.ones(2)})
    assert values == {"b": 2.0, "c": "word"}
    assert arrays["a"].shape == ()
    with pytest.raises(ModelFileError, match="only numbers"):
        split_state({"a": np.array(["word"])})


def test_a_type_that_no_reader_takes_is_not_written() -> None:
    with pytest.raises(ModelFileError, match="float16"):
        encode_body({}, {"a": np.float16([1.0])})
    with pytest.raises(ModelFileError, match="JSON"):
        encode_body({"a": object()}, {})


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
        ({"arrays": [["a", "<f8", [0, 2**40]]]}, "at most 1024 bytes"),
    ],
)
def test_a_malformed_header_is_refused(header: Any, words: str) -> None:
    text = json.dumps(header).encode()
    with pytest.raises(InputError, match=words):
        decode_body(text + bytes(8), len(text), 1024)
