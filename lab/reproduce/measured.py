"""Compute everything that the report needs: the chapter's models, and the models on data from others."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import AdmissionConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import FloatArray
from dehyst.service.identification.identifying import SETTLE_SHARE, Identified, Stretch, identify_all, score_of
from dehyst.sim.chapter.control import Control, learner_of, replay, run_control
from dehyst.sim.chapter.experiments import Characterisation, Experiments, characterise, experiments
from dehyst.sim.chapter.modelling import ForwardRun, identify_forward
from dehyst.sim.recordings import ColumnMap, read, repaired
from dehyst.sim.stage.closed_loop import BlockConfig

# --- The models on data from others: a measured stack actuator.
#
# The folder of data is that of the environment variable ``DEHYST_DATA``, by default ``shared/data`` beside the
# project.

Progress = Callable[[str], None]

#: The two windows of the stack's test recording that its authors report on (first row, row after the last), and what
#: their result: RMSE between wanted and measured displacement, mean removed, µm.
WINDOWS = {"linear drive": (5052, 6052, 1.68), "inverse feedforward": (11152, 12152, 0.58)}


def data_folder() -> Path:
    """The folder of measured data."""
    here = Path(__file__).resolve().parents[2]
    return Path(os.environ.get("DEHYST_DATA", here.parent / "shared" / "data"))


@dataclass(frozen=True, slots=True)
class Stack:
    """The measured stack actuator.

    reproduced_um : the authors' own two figures, computed anew from the file. wanted_um, t_s, u_V, y_um : the test
    recording. results : the models with their voltage errors.
    """

    reproduced_um: dict[str, float]
    results: tuple[Identified, ...]
    gain_um_per_V: float
    range_um: float
    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    wanted_um: FloatArray

    def windows_rmse_um(self, result: Identified) -> dict[str, float]:
        """A model's equivalent displacement error in both windows, RMSE, mean removed, µm; empty where it failed."""
        error = result.error_V * self.gain_um_per_V
        windows = {} if result.score is None else WINDOWS
        return {name: _centred_rmse(error[start:stop]) for name, (start, stop, _) in windows.items()}


def _centred_rmse(error: FloatArray) -> float:
    return float(np.std(error[np.isfinite(error)]))


def run_stack(folder: Path, progress: Progress = lambda _: None) -> Stack | None:
    """Identify on the 1 Hz recording, test on the ramped sine; None if the files are missing."""
    train_file, test_file = folder / "model_sine_1hz.csv", folder / "test_ramped_sine_ff.csv"
    if not (train_file.is_file() and test_file.is_file()):
        return None
    # The sensor's column lies one sample late in the file, as its authors state.
    mapping = ColumnMap(sensor_late=1)
    train, test = (Stretch.of(repaired(read(file, mapping))) for file in (train_file, test_file))
    recording = read(test_file, mapping)
    wanted = np.genfromtxt(test_file, delimiter=",", names=True)["ref_um"][: len(recording)]
    dt_s = recording.dt_s
    gain = float(np.polyfit(train.u_V, train.y_um, 1)[0])
    range_um = float(np.ptp(train.motion[:, 0]))

    def say(name: str, phase: str, _share: float) -> None:
        if phase == "fit":
            progress(f"measured stack: identifying {name}")

    results = identify_all(train, test, dt_s, follows=False, progress=say)
    for result in list(results):
        learning = _learning(result, test, dt_s, gain, range_um, progress)
        if learning is not None:
            results.append(learning)
    y = recording.y_um
    reproduced = {name: _centred_rmse(y[start:stop] - wanted[start:stop]) for name, (start, stop, _) in WINDOWS.items()}
    return Stack(reproduced, tuple(results), gain, range_um, recording.t_s, recording.u_V, y, np.asarray(wanted))


#: The gate's default belongs to 1 ms; at 5 ms the prediction error of the smoother is larger. Window and filter learn
#: at the same rate in time as at 1 ms.
_LEARNER = LearnerConfig(learn_every=2, filter_every=1, admission=AdmissionConfig(glitch_share=0.1))
#: 20 ms a block, and an answer from a snapshot of at least 40 ms before it.
_BLOCKS = BlockConfig(block=4, delay_blocks=3)


def _learning(
    result: Identified, test: Stretch, dt_s: float, gain: float, range_um: float, progress: Progress
) -> Identified | None:
    """The same model learning along the test recording; None if it has no learning form here."""
    names = {"bouc_wen": "bouc_wen_online", "mpi": "mpi_online", "lssvm_adaptive": "lssvm_adaptive_online"}
    if result.model is None or result.name not in names:
        return None
    progress(f"measured stack: replaying with {result.name} learning")
    model = result.model
    online = Learner.from_model(model, _LEARNER) if isinstance(model, LssvmInverse) else learner_of(model)
    start = time.perf_counter()
    error = replay(online, test.motion, test.u_V, test.y_um, dt_s, _BLOCKS) - test.u_V
    error[: max(1, round(SETTLE_SHARE * len(test)))] = np.nan
    error[~test.valid] = np.nan
    score = score_of(error, gain, range_um)
    return Identified(names[result.name], online.snapshot(), score, error, time.perf_counter() - start)


# --- Compute everything that the report needs, with progress messages. No picture is drawn and no file written.

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
    seconds: float

    def model(self, key: str) -> ForwardRun:
        """The forward model of that key; raises KeyError."""
        for run in self.forward:
            if run.key == key:
                return run
        raise KeyError(key)


@dataclass(frozen=True, slots=True)
class Study:
    """The whole study. ``stack`` is None without its data; ``machine`` is text for the report."""

    config: StudyConfig
    presets: tuple[PresetStudy, ...]
    stack: Stack | None
    seconds: float
    machine: str


def run_study(config: StudyConfig, progress: Progress = lambda _: None) -> Study:
    """Run the study. Raises InputError for an unknown preset, ModuleNotFoundError for swarms without torch."""
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
        taken = time.perf_counter() - start
        studies.append(PresetStudy(name, data, character, tuple(forward), control, taken))
    folder = config.data or data_folder()
    stack = run_stack(folder / "picma_stack", progress) if config.measured else None
    if stack is None and config.measured:
        progress("no measured data 'picma_stack': set DEHYST_DATA to the folder that holds it; left out")
    machine = f"{platform.machine()}, Python {platform.python_version()}, one BLAS thread"
    return Study(config, tuple(studies), stack, time.perf_counter() - begin, machine)
