"""Stand-ins for online models in tests: one that lacks every ability, and one that passes everything on to another."""

from __future__ import annotations

from typing import Any

from dehyst.adaptive.online.learner import Learner, Parts
from dehyst.adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    MovingPart,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
)


class PlainModel:
    """Learns nothing and serves ``base``. Subclasses override what their test is about."""

    def __init__(self, base: InverseModel) -> None:
        self.base = base
        self.seq = -1
        self.trouble = self.why = ""
        self.distrusts = False

    def handle(self, sample: Sample) -> str:
        self.seq = sample.seq
        return "learnt"

    def resync(self) -> None: ...

    def take_place_of(self, other: OnlineModel) -> None: ...

    def freeze(self) -> None: ...

    def thaw(self) -> None: ...

    def snapshot(self) -> InverseModel:
        return self.base

    def moving(self) -> MovingPart | None:
        return None

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        return None

    def window_data(self) -> WindowData | None:
        return None

    def adopt(self, hyper: Hyperparameters) -> str:
        return "it has no hyper-parameters"

    def counters(self) -> dict[str, int]:
        return {}

    def diagnostics(self) -> dict[str, Any]:
        return {}

    def take_events(self) -> list[tuple[str, str]]:
        return []

    def warm(self) -> None: ...

    def state_dict(self) -> StateDict:
        return {}

    def restored(self, state: StateDict) -> OnlineModel:
        return self


class PlainLearner(PlainModel):
    """Takes samples and snapshots from ``inner`` and lacks its other abilities."""

    def __init__(self, inner: OnlineModel) -> None:
        super().__init__(inner.base)
        self.inner = inner

    def handle(self, sample: Sample) -> str:
        verdict = self.inner.handle(sample)
        self.seq = self.inner.seq
        return verdict

    def snapshot(self) -> InverseModel:
        return self.inner.snapshot()

    def counters(self) -> dict[str, int]:
        return self.inner.counters()

    def state_dict(self) -> StateDict:
        return self.inner.state_dict()


class SmoothingLearner(PlainLearner):
    """The same for a learner that competes: the motion is that of ``inner``."""

    inner: Learner

    @property
    def parts(self) -> Parts:
        return self.inner.parts
