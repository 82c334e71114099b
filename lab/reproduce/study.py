"""Compute everything that the report needs, with progress messages. No picture is drawn and no file written."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lab.reproduce.measured import Benchmark, Stack, data_folder, run_benchmark, run_stack
from sim.chapter.characterisation import Characterisation, characterise
from sim.chapter.control import Control, run_control
from sim.chapter.experiments import Experiments, experiments
from sim.chapter.modelling import ForwardRun, identify_forward
from sim.chapter.replayed import ReplayRun, replay_records

Progress = Callable[[str], None]
#: Identifications run on one core; CPU time does not depend on the load of the machine.
_CLOCK = time.process_time


@dataclass(frozen=True, slots=True)
class StudyConfig:
    """presets : names of stages. quick : shorter records and fewer epochs. pso : also the swarms. seed : of the stages.

    data : folder of measured data; None for the default folder. measured : whether to use them.
    """

    presets: tuple[str, ...] = ("rich", "bouc_wen")
    quick: bool = False
    pso: bool = True
    epochs: int = 1500
    seed: int = 0
    data: Path | None = None
    measured: bool = True


@dataclass(frozen=True, slots=True)
class PresetStudy:
    """The chapter on one stage."""

    name: str
    data: Experiments
    characterisation: Characterisation
    forward: tuple[ForwardRun, ...]
    control: Control
    replayed: tuple[ReplayRun, ...]
    seconds: float

    def model(self, key: str) -> ForwardRun:
        """The forward model of that key; raises KeyError."""
        for run in self.forward:
            if run.key == key:
                return run
        raise KeyError(key)


@dataclass(frozen=True, slots=True)
class Study:
    """The whole study. ``stack`` and ``benchmark`` are None without their data; ``machine`` is text for the report."""

    config: StudyConfig
    presets: tuple[PresetStudy, ...]
    stack: Stack | None
    benchmark: Benchmark | None
    seconds: float
    machine: str


def run_study(config: StudyConfig, progress: Progress = lambda _: None) -> Study:
    """Run the study. Raises InputError for an unknown preset, MissingTorchError for swarms without torch."""
    begin = time.perf_counter()
    studies = []
    for name in config.presets:
        start = time.perf_counter()

        def say(text: str, name: str = name) -> None:
            progress(f"[{name}] {text}")

        say("recording the stage")
        data = experiments(name, seed=config.seed, quick=config.quick)
        character = characterise(data.config)
        forward = identify_forward(data, pso=config.pso, epochs=config.epochs, clock=_CLOCK, progress=say)
        control = run_control(data, quick=config.quick, clock=_CLOCK, progress=say)
        replayed = replay_records(data, control.inverses, quick=config.quick, progress=say)
        taken = time.perf_counter() - start
        studies.append(PresetStudy(name, data, character, tuple(forward), control, replayed, taken))
    folder = config.data or data_folder()
    stack = run_stack(folder / "picma_stack", progress) if config.measured else None
    benchmark = run_benchmark(folder / "boucwen_benchmark", progress) if config.measured else None
    for found, title in ((stack, "picma_stack"), (benchmark, "boucwen_benchmark")):
        if found is None and config.measured:
            progress(f"no measured data {title!r}: set DEHYST_DATA to the folder that holds it; left out")
    machine = f"{platform.machine()}, Python {platform.python_version()}, one BLAS thread"
    return Study(config, tuple(studies), stack, benchmark, time.perf_counter() - begin, machine)
