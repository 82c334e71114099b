"""Table 2.4 for inverse models: voltages for the motion of every record, from frozen and from learning models.

The error is a voltage. Times the mean gain of the training record it is a displacement, comparable with the errors of
the forward models. A learning model answers each block from a snapshot of its past.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from adaptive.smoothing import SmootherConfig, smooth_recording
from adaptive.types import InverseModel
from sim.chapter.adaptive_loop import replay
from sim.chapter.control import FROZEN, LEARNING, Inverse, learner_of
from sim.chapter.experiments import DT_S, Experiments, Record, Score


@dataclass(frozen=True, slots=True)
class ReplayRun:
    """Scores of one inverse model by record: (2.45), then the records of the third family."""

    model: str
    scores: dict[str, Score]

    @property
    def third_mae_pct(self) -> float:
        """Mean MAE over the third family."""
        return float(np.mean([score.mae_pct for name, score in self.scores.items() if name != "generalisation"]))


def replay_records(
    data: Experiments,
    inverses: dict[str, Inverse],
    *,
    quick: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[ReplayRun, ...]:
    """Scores of every frozen and learning model on all records except the training one; ``quick``: on two records."""
    gain = float(np.polyfit(data.training.u_V, data.training.y_um, 1)[0])
    records = (data.generalisation, *(data.third[:1] if quick else data.third))
    progress("replaying the records through the inverse models")
    runs = []
    for key in FROZEN:
        runs.append(ReplayRun(key, dict(_scores(records, inverses[key].model, False, gain, data.range_um))))
    for key, (_, base) in LEARNING.items():
        runs.append(ReplayRun(key, dict(_scores(records, inverses[base].model, True, gain, data.range_um))))
    return tuple(runs)


def _scores(
    records: tuple[Record, ...], model: InverseModel, learns: bool, gain: float, range_um: float
) -> Iterator[tuple[str, Score]]:
    for record in records:
        motion = smooth_recording(record.y_um, SmootherConfig.for_rate(DT_S))
        if learns:
            u = replay(learner_of(model), motion, record.u_V, record.y_um, DT_S)
        else:
            y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
            u = model.feedforward(y, v, a, model.rest_memory(float(y[0]))).u_V
        yield record.name, Score.of((u - record.u_V) * gain, range_um)
