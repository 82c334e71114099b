"""What a comparison of two stretches has found: the causes with their numbers, and the words for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from adaptive.types import FloatArray
from sim.changes.columns import Scales

SCHEMA = 1


@dataclass(frozen=True)
class Change:
    """One cause: its numbers with 95 % intervals, and the share of the held-out squared error that it removed."""

    name: str
    alternatives: tuple[str, ...]
    numbers: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    heldout_gain: float
    text: str


@dataclass(frozen=True)
class Comparison:
    """What has changed. Errors are rms of the frozen model, as displacement, µm.

    ``verdict``: ``unchanged``; ``changed``, by ``changes``; ``unexplained``: grown, and no cause known explains it.
    ``gain_t_s``, ``gain``: the stage's relative gain over time, stretch by stretch, against the reference.
    """

    verdict: str
    changes: tuple[Change, ...]
    before_um: float
    recent_um: float
    left_um: float
    text: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "text": self.text,
            "error_before_um": self.before_um,
            "error_recent_um": self.recent_um,
            "error_explained_um": self.left_um,
            "effects": [
                {
                    "name": c.name,
                    "alternatives": list(c.alternatives),
                    "parameters": c.numbers,
                    "intervals": {name: list(span) for name, span in c.intervals.items()},
                    "heldout_gain": c.heldout_gain,
                    "text": c.text,
                }
                for c in self.changes
            ],
        }


def phrase(name: str, values: FloatArray, scales: Scales) -> str:
    """A cause as a person would say it, with its size."""
    first = float(values[0])
    match name:
        case "gain_drift":
            return f"gain drift, {100.0 * first:+.1f} %"
        case "thermal_drift":
            return f"thermal drift or another offset, {first:+.3g} µm"
        case "sensor_lag":
            return f"lag, {1e3 * first:+.3g} ms"
        case "payload_change":
            return f"payload on the stage, {first:+.2g} s² of 1/ω²"
        case "sensor_nonlinearity":
            return f"bend of the characteristic, {100.0 * first:+.2g} % of half the range"
        case "hysteresis_shape":
            return f"shape of the loop, {100.0 * float(np.sum(values)):+.2g} % of the motion"
        case "mains_hum":
            return f"mains hum, {float(np.hypot(*values)) / abs(scales.slope_V_per_um) * 1e3:.3g} nm"
    return name
