"""What a run of the demonstration leaves behind, whichever way it was made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adaptive.types import FloatArray
from service.demo.plan import MODELS, Plan
from service.demo.score import latency, score


@dataclass(slots=True)
class Run:
    """Motion of the twin stages, by model, and what happened on the way.

    Attributes
    ----------
    y_um, u_V, std_V : by model, (ticks,); what the sensor read, what was applied, its standard deviation.
    query_s : durations of the feedforward queries, s. late_queries : answers that came after their block was due.
    samples : counts ``sent``, ``received``, ``learnt`` of the stage that teaches.
    ticks : counts ``count``, ``late`` (a command was not there in time) and ``bare_late`` (the bare loop's).
    notes : records for the viewer (events, diagnostics, status), in order.
    """

    y_um: dict[str, FloatArray]
    u_V: dict[str, FloatArray]
    std_V: dict[str, FloatArray]
    query_s: FloatArray
    late_queries: int
    samples: dict[str, int]
    ticks: dict[str, int]
    notes: list[Any] = field(default_factory=list)

    def summary(self, plan: Plan, reference_um: FloatArray) -> dict[str, Any]:
        """The content of ``summary.json``."""
        return {
            "schema": 1,
            "range_um": plan.range_um,
            "models": {name: score(reference_um - self.y_um[name], plan) for name in MODELS},
            "queries": latency(self.query_s, self.late_queries),
            "samples": self.samples,
            "ticks": self.ticks,
            "change": {
                "t_s": plan.change_tick * plan.dt_s,
                "gain": plan.gain_change,
                "payload_ratio": plan.payload_ratio,
                "text": plan.change_text,
            },
            "seed": plan.seed,
        }


def empty(plan: Plan) -> dict[str, FloatArray]:
    """An array of ticks for each model, NaN where nothing is known yet."""
    return {name: np.full(plan.ticks, np.nan) for name in MODELS}
