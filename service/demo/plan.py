"""What the demonstration does and when, in sequence numbers: nothing here depends on a clock.

Time line of one run (ticks of ``dt_s``)::

    block j covers the ticks [jB, (j+1)B); it is asked for when the stage has published tick jB - lead - 1,
    and answered from the newest snapshot that has seen no sample after jB - lead - margin.

The margin leaves the samples their way through the wire, so that a run in real time and a fast one ask the
same questions of the same snapshots and get the same voltages.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.presets import preset
from sim.reference import demo_reference
from sim.signals import training_input
from sim.stage import StageConfig

#: Served models in the order of the table, with what the table calls them.
MODELS: dict[str, str] = {
    "linear": "linear gain only",
    "bouc_wen": "Bouc-Wen, inverse",
    "mpi": "modified Prandtl-Ishlinskii, inverse",
    "lssvm_frozen": "LSSVM as in the chapter, frozen",
    "lssvm_adaptive": "LSSVM with memory, adaptive",
}
#: The model whose stage teaches the service.
TEACHER = "lssvm_adaptive"
STAGE, AXIS = "demo", "x"
#: Axis name on the wire of the twin that each model drives; the teacher has the axis itself.
UNITS: dict[str, str] = {name: AXIS if name == TEACHER else f"{AXIS}_{name}" for name in MODELS}


@dataclass(frozen=True, slots=True)
class Plan:
    """A demonstration run.

    Attributes
    ----------
    dt_s : sample time, s. identify_s, run_s : lengths of the two parts, s.
    change_s : when the stage changes, s after the start of the second part.
    gain_change, payload_ratio : relative change of the stage's gain; mass added over mass moved.
    low_um, high_um : the range that the reference commands, µm.
    block, lead, margin : ticks per query, ticks asked ahead, ticks left for samples to arrive.
    seed : of the stage's noise and of the reference.
    """

    dt_s: float = 0.001
    identify_s: float = 10.0
    run_s: float = 60.0
    gain_change: float = -0.06
    payload_ratio: float = 1.0
    low_um: float = 4.0
    high_um: float = 80.0
    block: int = 20
    lead: int = 60
    margin: int = 20
    seed: int = 20

    def __post_init__(self) -> None:
        if self.run_s < 8.0:
            raise InputError(f"run_s: got {self.run_s:g} s, expected at least 8 s: the table needs a settled part")
        if self.lead % self.block or self.lead < self.block:
            raise InputError(f"lead: got {self.lead} ticks, expected a multiple of block ({self.block})")

    @property
    def ticks(self) -> int:
        """Length of the second part in ticks, whole blocks."""
        return round(self.run_s / self.dt_s) // self.block * self.block

    @property
    def change_tick(self) -> int:
        """The first tick of the changed stage."""
        return self.ticks // 2

    @property
    def range_um(self) -> float:
        """Commanded range, to which all percentages refer."""
        return self.high_um - self.low_um

    def as_of(self, block: int) -> int:
        """Last sequence number that the answer for ``block`` may have learnt from; -1: none."""
        return max(-1, block * self.block - self.lead - self.margin)

    def phases(self) -> dict[str, slice]:
        """The parts of the run that the table speaks of, as tick ranges."""
        second = round(1.0 / self.dt_s)
        quiet = min(10 * second, self.change_tick // 2)
        return {
            "before": slice(self.change_tick - quiet, self.change_tick),
            "first_second": slice(self.change_tick, self.change_tick + second),
            "settled": slice(self.ticks - quiet, self.ticks),
        }

    def identification_voltage(self) -> FloatArray:
        """The chapter's training input (2.37) at ``dt_s``, V."""
        return training_input(self.dt_s, self.identify_s)[1]

    def reference(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement µm, velocity µm/s, acceleration µm/s² of the reference that no model has seen."""
        motion = demo_reference(self.ticks * self.dt_s, self.dt_s, (self.low_um, self.high_um), self.seed)
        n = self.ticks
        return motion.y_um[:n], motion.v_um_per_s[:n], motion.a_um_per_s2[:n]

    @property
    def change_text(self) -> str:
        """The change as a person would say it."""
        return f"gain {100.0 * self.gain_change:+.0f} %, moved mass x {1.0 + self.payload_ratio:g} by a payload"

    def stage(self, *, changing: bool) -> StageConfig:
        """The stage, rested; with ``changing`` its gain drops and its payload grows at ``change_tick``."""
        config = preset("rich", dt_s=self.dt_s, seed=self.seed)
        if not changing:
            return config
        at_s = self.change_tick * self.dt_s
        change = {"gain_drift.gain": self.gain_change, "resonance.payload_ratio": self.payload_ratio}
        return replace(config, changes=((at_s, change),))
