"""Table 2.5, Figs. 2.17 to 2.20: feedforward, feedback and both at T = 1 ms, with frozen and with learning models."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.identification import identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.smoothing import SmootherConfig, smooth_recording
from dehyst.adaptive.types import FloatArray, InverseModel, OnlineModel, Sample
from dehyst.baselines import fit_bouc_wen, fit_mpi
from dehyst.baselines.competition.competition import online_form
from dehyst.sim.chapter.experiments import DT_S, Experiments, Record, Score
from dehyst.sim.effects import effect
from dehyst.sim.signals.references import Reference, Sequenced, Tones, demo_reference, strokes
from dehyst.sim.signals.voltages import sample_times
from dehyst.sim.stage.closed_loop import CHAPTER_GAINS, PID, BlockConfig, Run, UltimateGain, track, ultimate_gain
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage


def replay(
    online: OnlineModel,
    motion: FloatArray,
    u_V: FloatArray,
    y_um: FloatArray,
    dt_s: float,
    config: BlockConfig | None = None,
) -> FloatArray:
    """Voltages (n,) V that a learning model would have given for a recorded motion, learning from it block by block.

    ``motion`` (n, 3) is smoothed displacement, velocity and acceleration; ``u_V``, ``y_um`` (n,) are the applied
    voltages and the readings. A block is answered by a snapshot that has seen neither it nor the ``delay_blocks - 1``
    blocks before. ``online`` is advanced. Raises InputError on bad shapes.
    """
    config = config or BlockConfig()
    n = u_V.size
    if motion.shape != (n, 3) or y_um.shape != (n,):
        raise InputError(f"motion, y_um: got {motion.shape}, {y_um.shape}, expected ({n}, 3) and ({n},)")
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    snapshots: deque[InverseModel] = deque([online.snapshot()], maxlen=config.delay_blocks)
    memory = snapshots[0].rest_memory(float(y[0]))
    out = np.empty(n)
    for start in range(0, n, config.block):
        part = slice(start, min(n, start + config.block))
        model = snapshots[0]
        out[part] = model.feedforward(y[part], v[part], a[part], memory).u_V
        memory = model.track(y[part], v[part], a[part], u_V[part], memory)
        for k in range(part.start, part.stop):
            online.handle(Sample(k, k * dt_s, float(u_V[k]), float(y_um[k])))
        snapshots.append(online.snapshot())
    return out


# --- References for the controllers: the response to (2.45), and a family that the chapter lacks.

#: Top of the references as a share of the motion range, so that they stay within the identified range.
_TOP = 0.9


def answered_reference(record: Record) -> Reference:
    """The displacement of the stage in a record, smoothed with zero phase, which is within its reach."""
    motion = smooth_recording(record.y_um, SmootherConfig.for_rate(DT_S))
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    return Reference(record.t_s, y, v, a)


def control_references(data: Experiments, quick: bool = False) -> dict[str, Reference]:
    """References by name; the first is that of Table 2.5, the last two are the family that the chapter lacks.

    The chapter only draws the reference of Fig. 2.17a. The first one here is the response of the stage to (2.45): it
    leaves rest and returns as the stage does. ``quick`` shortens the others.
    """
    end_s, top_um = 2.0 if quick else 4.0, _TOP * data.range_um
    sine = Sequenced(((1.0, Tones(0.0)), (end_s, strokes(0.0, 0.8 * data.range_um, 5.0, 1.0))))
    return {
        "answer to (2.45)": answered_reference(data.generalisation),
        "sine 5 Hz": sine.at(sample_times(end_s, DT_S)),
        "tones, minor loops, holds": demo_reference(7.0 if quick else 20.0, DT_S, (0.0, top_um), seed=3),
    }


# --- Controllers.

Progress = Callable[[str], None]
Clock = Callable[[], float]

#: Frozen inverse models, in the order of the tables.
FROZEN = {
    "bouc_wen": "Bouc-Wen",
    "mpi": "MPI",
    "mpi_lag": "MPI with a lag",
    "lssvm": "LSSVM (y, dy/dt)",
    "lssvm_memory": "LSSVM with memory",
}
#: Learning models: label, and the frozen model that each starts from.
LEARNING = {
    "bouc_wen_online": ("Bouc-Wen, tracking filter", "bouc_wen"),
    "mpi_online": ("MPI, recursive least squares", "mpi"),
    "mpi_lag_online": ("MPI with a lag, recursive", "mpi_lag"),
    "lssvm_adaptive": ("LSSVM with memory, adaptive", "lssvm_memory"),
}
#: Relative change of the gain in the test of adaptation, and its time, s.
GAIN_CHANGE = -0.06
CHANGE_S = 5.0


@dataclass(frozen=True, slots=True)
class Inverse:
    """An identified inverse model and the duration of its identification, s."""

    model: InverseModel
    seconds: float


@dataclass(frozen=True, slots=True)
class Loop:
    """One run: its model ("none" for feedback alone), controller (FF, FB, FF+FB), reference, and score."""

    model: str
    controller: str
    reference: str
    run: Run
    score: Score


@dataclass(frozen=True, slots=True)
class Control:
    """The results of section 2.5.

    Attributes
    ----------
    ultimate, pid : ultimate gain of the stage, and the Ziegler-Nichols PI gains from it, which the runs use.
    chapter_gains_stable : whether the chapter's K_p is below the ultimate gain.
    inverses : the frozen models. loops : all runs. changed : runs on the stage whose gain drops.
    range_um : motion range, which percentages refer to.
    """

    ultimate: UltimateGain
    pid: PID
    chapter_gains_stable: bool
    inverses: dict[str, Inverse]
    loops: tuple[Loop, ...]
    changed: tuple[Loop, ...]
    range_um: float

    def loop(self, model: str, controller: str, reference: str) -> Loop:
        """The run of that name. Raises InputError where there is none."""
        for loop in self.loops:
            if (loop.model, loop.controller, loop.reference) == (model, controller, reference):
                return loop
        raise InputError(f"loop: no run of {model!r} with {controller!r} on {reference!r}")


def identify_inverses(
    data: Experiments, clock: Clock = lambda: 0.0, progress: Progress = lambda _: None
) -> dict[str, Inverse]:
    """All frozen inverse models from the training record at 1 ms; keys as in `FROZEN`. ``clock`` : time in s."""
    u, y = data.training.u_V, data.training.y_um
    makers: dict[str, Callable[[], InverseModel]] = {
        "bouc_wen": lambda: fit_bouc_wen(u, y, DT_S)[0],
        "mpi": lambda: fit_mpi(u, y, DT_S)[0],
        "mpi_lag": lambda: fit_mpi(u, y, DT_S, fit_lag=True)[0],
        "lssvm": lambda: identify_lssvm(u, y, DT_S, inputs="two")[0],
        "lssvm_memory": lambda: identify_lssvm(u, y, DT_S, inputs="memory")[0],
    }
    found = {}
    for key, make in makers.items():
        progress(f"identifying the inverse of {FROZEN[key]}")
        start = clock()
        model = make()
        found[key] = Inverse(model, clock() - start)
    return found


def learner_of(model: InverseModel) -> OnlineModel:
    """The learning form of a frozen model. Raises InputError for a model that has none."""
    online = Learner.from_model(model) if isinstance(model, LssvmInverse) else online_form(model)
    if online is None:
        raise InputError(f"model: got {type(model).__name__}, expected an LSSVM, a linear, Bouc-Wen or MPI inverse")
    return online


def changing(config: StageConfig, at_s: float, gain: float = GAIN_CHANGE) -> StageConfig:
    """The stage with a relative change of the gain by ``gain`` at ``at_s``, s."""
    if "gain_drift" not in config.effects:
        config = replace(config, effects=config.effects + effect("gain_drift", ramp_per_min=0.0))
    return replace(config, changes=((at_s, {"gain_drift.gain": gain}),))


def run_control(
    data: Experiments, *, quick: bool = False, clock: Clock = lambda: 0.0, progress: Progress = lambda _: None
) -> Control:
    """Identify the inverses, find the gains of the stage, and run every model with every controller.

    ``quick``: fewer and shorter references, and learning models with feedback on the first reference only. ``clock``
    gives the time, s, with which identifications are measured.
    """
    stage = Stage(data.config)
    inverses = identify_inverses(data, clock, progress)
    progress("searching the ultimate gain on the stage")
    ultimate = ultimate_gain(stage)
    pid = ultimate.pi_gains(DT_S)
    references = control_references(data, quick)
    loops = []
    first = next(iter(references))

    def add(model: str, controller: str, name: str, run: Run) -> None:
        loops.append(Loop(model, controller, name, run, Score.of(run.error_um, data.range_um)))

    for name, reference in references.items():
        progress(f"following {name}")
        add("none", "FB", name, track(stage, reference, pid=pid))
        for key in FROZEN:
            model = inverses[key].model
            add(key, "FF", name, track(stage, reference, model=model))
            add(key, "FF+FB", name, track(stage, reference, model=model, pid=pid))
        for key, (_, base) in LEARNING.items():
            hybrid = [("FF+FB", pid)] if name == first or not quick else []
            for controller, gains in (("FF", None), *hybrid):
                add(key, controller, name, track(stage, reference, online=learner_of(inverses[base].model), pid=gains))
    stable = CHAPTER_GAINS.k_p < ultimate.gain_V_per_um
    if stable:
        run = track(stage, references[first], model=inverses["lssvm_memory"].model, pid=CHAPTER_GAINS)
        add("lssvm_memory", "FF+FB, chapter's gains", first, run)
    changed = _changed(data, inverses, list(references.items())[-1], progress)
    return Control(ultimate, pid, stable, inverses, tuple(loops), changed, data.range_um)


def _changed(
    data: Experiments, inverses: dict[str, Inverse], named: tuple[str, Reference], progress: Progress
) -> tuple[Loop, ...]:
    """Feedforward with frozen and with learning models on the stage whose gain drops during the run."""
    name, reference = named
    progress(f"following {name} while the gain drops by {-100 * GAIN_CHANGE:g} %")
    stage = Stage(changing(data.config, CHANGE_S))
    after = round((CHANGE_S + 1.0) / DT_S)
    loops = []
    for key in FROZEN:
        run = track(stage, reference, model=inverses[key].model)
        loops.append(Loop(key, "FF", name, run, Score.of(run.error_um[after:], data.range_um)))
    for key, (_, base) in LEARNING.items():
        run = track(stage, reference, online=learner_of(inverses[base].model))
        loops.append(Loop(key, "FF", name, run, Score.of(run.error_um[after:], data.range_um)))
    return tuple(loops)


def moving_mae(error_um: FloatArray, range_um: float, span_s: float = 0.5) -> FloatArray:
    """(n,) MAE over the last ``span_s``, percent of ``range_um``; fewer samples at the start."""
    n = max(1, round(span_s / DT_S))
    total = np.concatenate([[0.0], np.cumsum(np.abs(error_um))])
    at = np.arange(1, error_um.size + 1)
    since = np.maximum(at - n, 0)
    return np.asarray((total[at] - total[since]) / (at - since) * (100.0 / range_um), dtype=np.float64)
