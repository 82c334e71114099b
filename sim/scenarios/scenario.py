"""One scenario: a stage and what happens to it, wrong readings, and the reference."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sim.scenarios.motion import Motion
from sim.scenarios.readings import Readings
from sim.signals.unseen_reference import Reference
from sim.stage.config import Change, StageConfig
from sim.stage.timebase import times


@dataclass(frozen=True)
class Scenario:
    """What happens, and when. Times in s after the start, displacement in µm.

    Attributes
    ----------
    kind, seed : which of the kinds, and what it was drawn from.
    text : what happens, for people.
    stage : as identified, before anything happens to it.
    changes : parameter changes of the stage by time.
    motion : the reference.
    duration_s : of the whole. change_s : when it begins to happen.
    low_um, high_um : the range that the reference commands.
    readings : wrong readings that the learner gets; errors are counted from the true ones.
    quiet_s : (start, stop) of a rest within, None where there is none.
    """

    kind: str
    seed: int
    text: str
    stage: StageConfig
    motion: Motion
    duration_s: float
    change_s: float
    low_um: float
    high_um: float
    changes: tuple[Change, ...] = ()
    readings: Readings = field(default_factory=Readings)
    quiet_s: tuple[float, float] | None = None

    @property
    def name(self) -> str:
        """Kind and seed."""
        return f"{self.kind}/{self.seed}"

    @property
    def range_um(self) -> float:
        """Commanded range, to which percentages refer."""
        return self.high_um - self.low_um

    def changing_stage(self) -> StageConfig:
        """The stage with what happens to it."""
        return replace(self.stage, changes=self.changes)

    def reference(self) -> Reference:
        """The reference at every sample of the run."""
        return self.motion.at(times(self.duration_s, self.stage.dt_s))
