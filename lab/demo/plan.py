"""What the demonstration does and when, in sequence numbers: nothing here depends on a clock.

Time line of one run (ticks of ``dt_s``)::

    block j covers the ticks [jB, (j+1)B); it is computed when the stage has published tick jB - lead - 1,
    by the newest model that has seen no sample after jB - lead - margin - 1, the last one of a block.

The controller follows the model and evaluates it itself. The margin gives the samples time to be learnt, and the model
time to arrive, so that a run in real time and a fast one use models of the same samples; the kernel part that is
followed in real time is up to 0.2 s older. Each block also commands the ``reserve`` ticks after it: where the
controller stalls, the stage goes on along the reference by a model that is as much older.

That is with ``strict``. Otherwise stage and controller wait for each other, up to ``LOCK_STEP_S``: a busy machine makes
the run longer, not its voltages late, and a reserve is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.presets import preset

#: Served models in the order of the table, with their titles there.
MODELS: dict[str, str] = {
    "linear": "linear gain only",
    "bouc_wen": "Bouc-Wen, inverse",
    "mpi": "modified Prandtl-Ishlinskii, inverse",
    "lssvm_frozen": "LSSVM as in the chapter, frozen",
    "lssvm_adaptive": "LSSVM with memory, adaptive",
}
#: The model from whose stage the service learns.
TEACHER = "lssvm_adaptive"
STAGE, AXIS = "demo", "x"
#: Ticks of the reserve of a controller that follows a model in real time.
RESERVE = 60
#: Ticks between two snapshots of the service.
SNAPSHOT_EVERY = 20
#: Longest time, s, for which the stage's clock stands still until a voltage comes.
LOCK_STEP_S = 5.0
#: Axis name, in keys, of the twin that each model drives; the teacher has the axis itself.
UNITS: dict[str, str] = {name: AXIS if name == TEACHER else f"{AXIS}_{name}" for name in MODELS}


@dataclass(frozen=True, slots=True)
class Plan:
    """A demonstration run.

    Attributes
    ----------
    dt_s : sample time, s. run_s : length after the identification, s.
    gain_change, payload_ratio : relative change of the stage's gain half way through; mass added over mass moved.
    low_um, high_um : range of the reference, µm.
    block, lead, margin : ticks per block, ticks that it is computed ahead, ticks left for samples and model to arrive.
    reserve : ticks after each block that are commanded as well; only with ``strict``.
    strict : the stage's clock keeps real time, also where a voltage is late.
    seed : of the stage's noise and of the reference.

    Raises InputError on a run that is too short or a lead that is no multiple of the block.
    """

    dt_s: float = 0.001
    run_s: float = 60.0
    gain_change: float = -0.06
    payload_ratio: float = 1.0
    low_um: float = 4.0
    high_um: float = 80.0
    block: int = 5
    lead: int = 5
    margin: int = 10
    reserve: int = 0
    strict: bool = False
    seed: int = 20

    def __post_init__(self) -> None:
        if self.run_s < 8.0:
            raise InputError(f"run_s: got {self.run_s:g} s, expected at least 8 s: the table needs a settled part")
        if self.lead % self.block or self.lead < self.block:
            raise InputError(f"lead: got {self.lead} ticks, expected a multiple of block ({self.block})")

    @property
    def ticks(self) -> int:
        """Length of the second part in ticks, whole snapshots."""
        return round(self.run_s / self.dt_s) // SNAPSHOT_EVERY * SNAPSHOT_EVERY

    @property
    def change_tick(self) -> int:
        """The first tick of the changed stage."""
        return self.ticks // 2

    @property
    def range_um(self) -> float:
        """Commanded range, µm, to which all percentages refer."""
        return self.high_um - self.low_um

    def as_of(self, block: int) -> int:
        """Last sequence number that the answer for ``block`` may have learnt from. -1: none, and the newest snapshot
        answers, which has learnt nothing only before the first sample."""
        return max(-1, block * self.block - self.lead - self.margin - 1)

    def phases(self) -> dict[str, slice]:
        """The parts of the run in the table, as tick ranges."""
        second = round(1.0 / self.dt_s)
        quiet = min(10 * second, self.change_tick // 2)
        return {
            "before": slice(self.change_tick - quiet, self.change_tick),
            "first_second": slice(self.change_tick, self.change_tick + second),
            "catching_up": slice(self.change_tick + second, self.ticks - quiet),
            "settled": slice(self.ticks - quiet, self.ticks),
        }

    def reference(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement µm, velocity µm/s, acceleration µm/s² of the reference, which is not in the training data."""
        motion = demo_reference(self.ticks * self.dt_s, self.dt_s, (self.low_um, self.high_um), self.seed)
        return motion.y_um, motion.v_um_per_s, motion.a_um_per_s2

    @property
    def change_text(self) -> str:
        """Description of the change."""
        return f"gain {100.0 * self.gain_change:+.0f} %, moved mass x {1.0 + self.payload_ratio:g} by a payload"

    def stage(self, *, changing: bool) -> StageConfig:
        """The stage at rest; with ``changing`` its gain drops and its payload grows at ``change_tick``."""
        config = preset("rich", dt_s=self.dt_s, seed=self.seed)
        if not changing:
            return config
        change = {"gain_drift.gain": self.gain_change, "resonance.payload_ratio": self.payload_ratio}
        return replace(config, changes=((self.change_tick * self.dt_s, change),))


def make_plan(run_s: float, seed: int, strict: bool = False) -> Plan:
    """The plan of the demonstration; with ``strict`` it has a reserve."""
    return Plan(run_s=run_s, seed=seed, strict=strict, reserve=RESERVE if strict else 0)
