"""The numerics of the window, counted where they happen, reach whoever asks the service for its status."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive.types import InverseModel
from service.answers.guard import Limits
from service.config.settings import AxisConfig
from service.protocol.keys import Keys
from service.protocol.samples import SampleBatch
from service.server.axis_loading import load_axis
from service.server.axis_loop import AxisLoop
from service.server.query_answers import LatencyMeter
from service.server.status import axis_status
from service.storage.model_file import Bundle, BundleMeta
from tests.service.axes import loop_of

DT_S = 1e-3
#: What is published of the numerics: residuals, refinements, refreshes, and steps refused and undone.
WINDOW = {
    "steps", "bad_inputs", "ill_conditioned", "undone", "residuals_exceeded", "residual_rounds", "refinements",
    "refreshes",
}  # fmt: skip


def give(loop: AxisLoop, first: int, n: int) -> None:
    """n samples of a stage with 5 % less gain than the models believe, in messages of 20."""
    for start in range(first, first + n, 20):
        k = np.arange(start, start + 20)
        y = 45.0 + 25.0 * np.sin(2 * np.pi * 3.0 * k * DT_S) + 8.0 * np.sin(2 * np.pi * 7.1 * k * DT_S)
        loop.handle(SampleBatch(k, k * DT_S, (y - 1.0) / (11.0 * 0.95), y))


def told(loop: AxisLoop) -> dict[str, Any]:
    """The learner's counters as a client reads them."""
    status = axis_status(Keys("demo", "x"), "one", loop, LatencyMeter())
    counters: dict[str, Any] = json.loads(json.dumps(status, allow_nan=False))["learner"]
    return counters


@pytest.mark.parametrize("compete", [(), ("linear",)], ids=["alone", "competing"])
def test_the_counters_of_the_window_reach_the_status(models: dict[str, InverseModel], compete: tuple[str, ...]) -> None:
    config = AxisConfig(
        "x", Path("x.npz"), Limits(0.0, 10.0, 2000.0, 0.0, 90.0), compete=compete,
        # A small window that learns whatever comes, so that whole rounds of its rows are checked.
        learner={"window": 30, "learn_every": 2, "valid_enter": 10.0, "valid_leave": 10.0},
    )  # fmt: skip
    axis = load_axis("demo", config, bundle=Bundle(models, BundleMeta("demo", "x", DT_S)))
    loop = loop_of(axis)
    give(loop, 0, 1000)
    learner: Any = axis.learner
    window = (learner.competition.favourite if compete else learner).parts.window
    first = told(loop)
    assert first.keys() >= {f"window_{name}" for name in WINDOW}
    assert {f"window_{name}": count for name, count in window.counters().items()} == {
        name: count for name, count in first.items() if name.startswith("window_")
    }
    assert first["window_steps"] > 100
    quality = axis_status(Keys("demo", "x"), "one", loop, LatencyMeter())["quality"]
    assert quality["window_cholesky"] == float(window.form == "cholesky")
    assert 0.0 <= quality["window_residual_V"] < 1e-6
    assert first["window_residual_rounds"] >= 1
    # A step that is refused shows there, like every other.
    assert window.learn(np.full(models["lssvm_adaptive"].features.kernel_size, np.nan), 0.0) == "numerics"  # type: ignore[attr-defined]
    give(loop, 1000, 100)
    second = told(loop)
    assert (first["window_bad_inputs"], second["window_bad_inputs"]) == (0, 1)
    assert second["window_steps"] > first["window_steps"]
