"""What the demonstration does and when, in sequence numbers: nothing here depends on a clock.

Time line of one run (ticks of ``dt_s``)::

    block j covers the ticks [jB, (j+1)B); it is asked for when the stage has published tick jB - lead - 1,
    and answered from the newest snapshot that has seen no sample after jB - lead - margin.

The margin gives the samples time to arrive, so that a run in real time and a fast one ask the same questions of the
same snapshots and get the same voltages.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.signals.references import demo_reference
from sim.signals.voltages import training_input
from sim.stage.config import StageConfig
from sim.stage.file import load_stage
from sim.stage.presets import preset

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
#: Axis name, in keys, of the twin that each model drives; the teacher has the axis itself.
UNITS: dict[str, str] = {name: AXIS if name == TEACHER else f"{AXIS}_{name}" for name in MODELS}


@dataclass(frozen=True, slots=True)
class Plan:
    """A demonstration run.

    Attributes
    ----------
    dt_s : sample time, s. identify_s, run_s : lengths of the two parts, s.
    gain_change, payload_ratio : relative change of the stage's gain half way through; mass added over mass moved.
    low_um, high_um : range of the reference, µm.
    block, lead, margin : ticks per query, ticks that it is asked ahead, ticks left for samples to arrive.
    seed : of the stage's noise and of the reference.
    drive_low_V, drive_high_V : range of the identification signal, V.
    slowness : factor by which the reference is slower than the usual one.
    stage_file : a stage file in place of the stage that stands in for hardware; see `lab.demo.own_stage`.

    Raises InputError on a run that is too short or a lead that is no multiple of the block.
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
    drive_low_V: float = 0.0
    drive_high_V: float = 8.0
    slowness: float = 1.0
    stage_file: str = ""

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
        """Commanded range, µm, to which all percentages refer."""
        return self.high_um - self.low_um

    def as_of(self, block: int) -> int:
        """Last sequence number that the answer for ``block`` may have learnt from. -1: none, and the newest snapshot
        answers, which has learnt nothing only before the first sample."""
        return max(-1, block * self.block - self.lead - self.margin)

    def phases(self) -> dict[str, slice]:
        """The parts of the run in the table, as tick ranges."""
        second = round(1.0 / self.dt_s)
        quiet = min(10 * second, self.change_tick // 2)
        return {
            "before": slice(self.change_tick - quiet, self.change_tick),
            "first_second": slice(self.change_tick, self.change_tick + second),
            "settled": slice(self.ticks - quiet, self.ticks),
        }

    def identification_voltage(self) -> FloatArray:
        """The chapter's training input (2.37) at ``dt_s``, V, over the stage's voltage range."""
        wave_V = training_input(self.dt_s, self.identify_s)[1]
        if (self.drive_low_V, self.drive_high_V) == (0.0, 8.0):
            return wave_V
        return np.asarray(self.drive_low_V + (self.drive_high_V - self.drive_low_V) * wave_V / 8.0)

    def reference(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement µm, velocity µm/s, acceleration µm/s² of the reference, which is not in the training data."""
        n, slow, limits = self.ticks, self.slowness, (self.low_um, self.high_um)
        motion = demo_reference(n * self.dt_s / slow, self.dt_s / slow, limits, self.seed)
        return motion.y_um[:n], motion.v_um_per_s[:n] / slow, motion.a_um_per_s2[:n] / slow**2

    @property
    def change_text(self) -> str:
        """Description of the change."""
        text = f"gain {100.0 * self.gain_change:+.0f} %"
        return f"{text}, moved mass x {1.0 + self.payload_ratio:g} by a payload" if self.payload_ratio else text

    def stage(self, *, changing: bool) -> StageConfig:
        """The stage at rest; with ``changing`` its gain drops and its payload grows at ``change_tick``."""
        if self.stage_file:
            config = replace(load_stage(self.stage_file), dt_s=self.dt_s, seed=self.seed)
        else:
            config = preset("rich", dt_s=self.dt_s, seed=self.seed)
        if not changing:
            return config
        at_s = self.change_tick * self.dt_s
        change = {"gain_drift.gain": config.effects["gain_drift"].values["gain"] + self.gain_change}
        for e in config.effects:
            if e.name == "resonance":
                change[f"{e.label}.payload_ratio"] = self.payload_ratio
            elif e.name == "mechanics":
                change[f"{e.label}.payload_kg"] = self.payload_ratio * e.values["mass_kg"]
        return replace(config, changes=(*config.changes, (at_s, change)))
