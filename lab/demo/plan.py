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
from pathlib import Path

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.export import OFFSET
from dehyst.sim.effects import effect
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.file import load_stage, save_stage
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

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
    dt_s : sample time, s. identify_s, run_s : lengths of the two parts, s.
    gain_change, payload_ratio : relative change of the stage's gain half way through; mass added over mass moved.
    low_um, high_um : range of the reference, µm.
    block, lead, margin : ticks per block, ticks that it is computed ahead, ticks left for samples and model to arrive.
    reserve : ticks after each block that are commanded as well; only with ``strict``.
    strict : the stage's clock keeps real time, also where a voltage is late.
    seed : of the stage's noise and of the reference.
    drive_low_V, drive_high_V : range of the identification signal, V.
    slowness : factor by which the reference is slower than the usual one.
    stage_file : a stage file in place of the stage that stands in for hardware; see `lab.demo.plan`.

    Raises InputError on a run that is too short or a lead that is no multiple of the block.
    """

    dt_s: float = 0.001
    identify_s: float = 10.0
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


def make_plan(run_s: float, seed: int, strict: bool = False) -> Plan:
    """The plan on the usual stage."""
    return Plan(run_s=run_s, seed=seed, strict=strict, reserve=RESERVE if strict else 0)


# --- Fits the plan of the demonstration to a stage from a file, by measuring the stage.

#: Share of the voltage limits that identification uses, and range of the reference as shares of the range found by it.
DRIVE_SHARE, LOW_SHARE, HIGH_SHARE = 0.8, 0.045, 0.9
#: A stage with a rise time up to this, s, gets the usual reference; a slower one a slower reference.
QUICK_S = 4e-3


def plan_for(path: Path, folder: Path, run_s: float, seed: int, strict: bool = False) -> Plan:
    """The plan for the stage in the file ``path``; the stage that is run is written into ``folder``.

    Voltages stay within ``DRIVE_SHARE`` of the file's limits; the commanded range is a share of what they reach. The
    sample time is the plan's own. Raises InputError if the stage does not move, or diverges.
    """
    base = make_plan(run_s, seed, strict)
    config = replace(_able_to_drift(_from_zero(load_stage(path))), dt_s=base.dt_s, seed=seed)
    high = DRIVE_SHARE * config.u_max_V
    # A stage of one polarity keeps it; a bipolar stage is driven both ways.
    low = DRIVE_SHARE * config.u_min_V if config.u_min_V < -0.5 * config.u_max_V else 0.0
    ours = folder / "stage.toml"
    save_stage(config, ours)
    plan = replace(
        base, stage_file=str(ours.resolve()), drive_low_V=low, drive_high_V=high, payload_ratio=_payload(config)
    )
    stage = Stage(plan.stage(changing=False))
    y_um, _ = stage.run(stage.initial_state(), plan.identification_voltage())
    settled = y_um[round(0.5 / plan.dt_s) :]
    bottom, span = float(settled.min()), float(np.ptp(settled))
    if not np.isfinite(span) or not 1e-6 < span < 1e9:
        raise InputError(
            f"--stage: got {path}, whose reading spans {span:g} µm for {low:g} to {high:g} V, expected a stage that "
            "moves: look at its actuator and its limits u_min_V, u_max_V"
        )
    slowness = float(np.clip(_rise_s(stage, low, high) / QUICK_S, 1.0, 20.0))
    return replace(plan, low_um=bottom + LOW_SHARE * span, high_um=bottom + HIGH_SHARE * span, slowness=slowness)


def _rise_s(stage: Stage, low_V: float, high_V: float) -> float:
    """Time to 63 % of the response to a small step, s."""
    dt_s, middle = stage.config.dt_s, 0.5 * (low_V + high_V)
    n = round(0.5 / dt_s)
    drive = np.concatenate([np.full(n, middle), np.full(n, middle + 0.1 * (high_V - low_V))])
    y_um, _ = stage.run(stage.initial_state(), drive)
    rise = (y_um[n:] - y_um[n - 10 : n].mean()) / (y_um[-10:].mean() - y_um[n - 10 : n].mean())
    there = np.flatnonzero(rise > 0.63)
    return float(there[0]) * dt_s if there.size else 0.5


def _from_zero(config: StageConfig) -> StageConfig:
    """The stage without the sensor offset that a diagnosis found, so that it reads zero at rest.

    With the offset a change of the gain would shift the rest position by a meaningless amount.
    """
    if OFFSET not in config.effects:
        return config
    return replace(config, effects=config.effects.replace({f"{OFFSET}.offset_um": 0.0}))


def _able_to_drift(config: StageConfig) -> StageConfig:
    """The stage with a gain that can change half way; if the file has none, a constant one is added."""
    if any(e.label == "gain_drift" for e in config.effects):
        return config
    still = effect("gain_drift", ramp_per_min=0.0)
    return replace(config, effects=config.effects + still)


def _payload(config: StageConfig) -> float:
    """Mass to add over mass moved; zero if no effect of the file depends on it."""
    return 1.0 if any(e.name in ("resonance", "mechanics") for e in config.effects) else 0.0
