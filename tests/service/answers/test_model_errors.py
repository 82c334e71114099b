"""What a model raises is replaced in the answer, and its words are kept in the log, once."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import pytest

from dehyst.service.answers import which_model
from dehyst.service.answers.fallback import Rules, answer_safely
from dehyst.service.answers.guard import Limits
from dehyst.service.answers.which_model import voltages_along


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(which_model, "_logged", {})

    class Broken:
        dt_s = 1e-3
        memory_size = 1

        def feedforward(self, *_: Any) -> Any:
            raise ZeroDivisionError("the width is zero")

        def rest_memory(self, _: float) -> np.ndarray:
            return np.zeros(1)

    return Broken()


def test_the_words_of_a_models_error_are_logged_once(broken: Any, caplog: pytest.LogCaptureFixture) -> None:
    one = np.array([1.0])
    limits = Limits(0.0, 10.0, 1e4)
    with caplog.at_level(logging.ERROR, "dehyst.model"):
        for _ in range(3):
            answer = answer_safely(broken, np.zeros(1), (one, one, one), math.nan, Rules(limits), None)
            assert np.isfinite(answer.u_V).all()
        assert np.isnan(voltages_along(broken, np.linspace(0.0, 1.0, 3))).all()
    (record,) = caplog.records
    assert "Broken raised ZeroDivisionError: the width is zero" in record.getMessage()
    assert record.exc_info is not None
