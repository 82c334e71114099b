"""A long evaluation in slices answers to the same bit as one in a piece."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from dehyst.service.answers.fallback import Rules, answer_safely
from dehyst.service.answers.guard import Limits
from dehyst.service.answers.slices import SLICE
from dehyst.service.protocol.model import decode_model
from tests.vectors import make_vectors as vectors

N = 3 * SLICE + 77
K = np.arange(N)
Y = 45.0 + 60.0 * np.sin(9e-3 * K) + 8.0 * np.sin(3.1e-2 * K)
V = np.gradient(Y, 1e-3)
MODELS = sorted(path.name for path in Path(vectors.DEFAULT_OUT).glob("*.model.payload"))


@pytest.mark.parametrize("resumes_V", [math.nan, 4.0], ids=["afresh", "resumed"])
@pytest.mark.parametrize("name", MODELS)
def test_slices_give_the_same_bits(name: str, resumes_V: float) -> None:
    message = decode_model((Path(vectors.DEFAULT_OUT) / name).read_bytes())
    safety = message.safety
    rules = Rules(Limits(0.0, 6.0, 300.0), safety.blend_share, safety.trust)
    done: list[int] = []
    whole, sliced = (
        answer_safely(
            message.model, message.memory, (Y, V, np.gradient(V, 1e-3)), 3.0, rules, safety.stand_in, safety.blends,
            resumes_V, pace,
        )
        for pace in (None, done.append)
    )  # fmt: skip
    for field in ("u_V", "std_V", "flags", "memory"):
        assert getattr(whole, field).tobytes() == getattr(sliced, field).tobytes(), field
    assert (whole.stand_in, whole.fallback) == (sliced.stand_in, sliced.fallback)
    if name.startswith(("lssvm", "auto.")):
        assert done == [SLICE, SLICE, SLICE, 77]
