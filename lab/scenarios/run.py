"""Runs one scenario: adapting and not adapting on twin stages, through the service's own axis with its delays.

Both twins have the same stage, noise and reference, and both models begin as the one that was identified from the
chapter's training signal. The axis answers in blocks, queried ahead, from snapshots of a certain age, as for a
controller in the network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive.identification import identify_lssvm
from adaptive.inverse_model import LssvmInverse
from adaptive.types import FloatArray
from service.answers.guard import Limits
from service.client.client import PendingCommands
from service.config.settings import AxisConfig
from service.protocol.query import FeedforwardQuery
from service.protocol.samples import SampleBatch
from service.server.axis_loading import load_axis
from service.storage.model_file import Bundle, BundleMeta
from sim.scenarios import Scenario
from sim.signals.voltages import training_input
from sim.stage.config import StageConfig
from sim.stage.stage import Stage

ADAPTIVE: Final = "lssvm_adaptive"
FROZEN: Final = "lssvm_memory"
MODELS: Final = (ADAPTIVE, FROZEN)
#: Points per query, samples that it is asked ahead, and samples that its snapshot is older still.
BLOCK, LEAD, MARGIN = 20, 40, 20
SLEW_V_PER_S: Final = 4000.0
IDENTIFY_S: Final = 10.0
#: Length of the readings at rest that give the noise floor, s.
FLOOR_S: Final = 2.0

#: Called with the simulated time done, s.
Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class ScenarioRecord:
    """One scenario as it went; arrays of (n,) samples, µm.

    Attributes
    ----------
    wanted_um : the reference. error_um : by model, reference minus reading without glitches.
    floor_um : rms noise of a reading at rest, of the stage at that sample.
    verdicts : counts of the learner's verdicts on samples. counters : of the learner, at the end.
    gate : (n,) index into ``gates`` of the learner's verdict on each sample.
    """

    scenario: Scenario
    wanted_um: FloatArray
    error_um: dict[str, FloatArray]
    floor_um: FloatArray
    verdicts: dict[str, int]
    counters: dict[str, int]
    gates: tuple[str, ...] = ()
    gate: Any = field(default=None, repr=False)


@lru_cache(maxsize=64)
def identified(stage: StageConfig) -> LssvmInverse:
    """The model of a stage at rest, from the chapter's training signal (2.37) at the stage's sample time."""
    rested = Stage(stage)
    u_V = training_input(stage.dt_s, IDENTIFY_S)[1]
    y_um, _ = rested.run(rested.initial_state(), u_V)
    return identify_lssvm(u_V, y_um, stage.dt_s, inputs="memory", name=ADAPTIVE)[0]


def noise_floor_um(stage: StageConfig) -> float:
    """Standard deviation, µm, of the readings of a stage at rest, without slow drift."""
    rested = Stage(replace(stage, changes=()))
    n = round(FLOOR_S / stage.dt_s)
    y_um, _ = rested.run(rested.initial_state(), np.zeros(n))
    line = np.polynomial.Polynomial.fit(np.arange(n), y_um, 1)
    return float(np.std(y_um - line(np.arange(n))))


def run_scenario(
    scenario: Scenario, settings: dict[str, Any] | None = None, progress: Progress = lambda _: None
) -> ScenarioRecord:
    """Run a scenario. ``settings``: as in a table ``[axis.learner]``. Raises InputError on wrong settings."""
    model = identified(scenario.stage)
    dt = scenario.stage.dt_s
    limits = Limits(scenario.stage.u_min_V, scenario.stage.u_max_V, SLEW_V_PER_S)
    config = AxisConfig(
        "x", Path("identified"), limits, learn=ADAPTIVE, snapshot_every=BLOCK, learner=dict(settings or {})
    )
    bundle = Bundle({ADAPTIVE: model, FROZEN: replace(model, name=FROZEN)}, BundleMeta("scenario", "x", dt))
    axis = load_axis("scenario", config, bundle=bundle)
    stage = Stage(scenario.changing_stage())
    states = {name: stage.initial_state() for name in MODELS}
    wanted = scenario.reference()
    n = wanted.y_um.size // BLOCK * BLOCK
    u_V = {name: np.zeros(n) for name in MODELS}
    y_um = {name: np.zeros(n) for name in MODELS}
    commanded = PendingCommands()
    memory: FloatArray | None = None
    last_V = dict.fromkeys(MODELS, float("nan"))
    names: dict[str, int] = {}
    gate = np.zeros(n, dtype=np.int16)
    ahead = LEAD // BLOCK
    for block in range(n // BLOCK + ahead + 1):
        done = (block - ahead - 1) * BLOCK
        if done >= 0:
            part = slice(done, done + BLOCK)
            for name in MODELS:
                y_um[name][part] = stage.run(states[name], u_V[name][part])[0]
            seq = np.arange(part.start, part.stop)
            t_s: FloatArray = (seq * dt).astype(np.float64)
            read = scenario.glitches.applied(done, y_um[ADAPTIVE][part])
            for k, verdict in zip(seq, axis.handle(SampleBatch(seq, t_s, u_V[ADAPTIVE][part], read)), strict=True):
                gate[k] = names.setdefault(verdict, len(names))
            if (done + BLOCK) % 1000 == 0:
                progress((done + BLOCK) * dt)
        if block * BLOCK >= n:
            continue
        part = slice(block * BLOCK, (block + 1) * BLOCK)
        as_of = max(-1, part.start - LEAD - MARGIN)
        for name in MODELS:
            points = (wanted.y_um[part], wanted.v_um_per_s[part], wanted.a_um_per_s2[part])
            # The axis tracks the adaptive twin's stage; the other twin sends its memory along.
            mine = name == ADAPTIVE
            pending = commanded.before(part.start) if mine else None
            query = FeedforwardQuery(*points, None if mine else memory, name, as_of, last_V[name], pending)
            reply = axis.answer(query)
            u_V[name][part], last_V[name] = reply.u_V, float(reply.u_V[-1])
            if mine:
                commanded.take(part.start, wanted.y_um[part], reply)
            else:
                memory = reply.memory
    learner = axis.learner
    return ScenarioRecord(
        scenario=scenario,
        wanted_um=wanted.y_um[:n],
        error_um={name: wanted.y_um[:n] - y_um[name] for name in MODELS},
        floor_um=_floor(scenario, n),
        verdicts=axis.gates,
        counters=learner.counters() if learner is not None else {},
        gates=tuple(names),
        gate=gate,
    )


def _floor(scenario: Scenario, n: int) -> FloatArray:
    """The noise floor at every sample; a change of the sensor's noise changes it."""
    floor = np.full(n, noise_floor_um(scenario.stage))
    chain = scenario.stage.effects
    for t_s, values in scenario.changes:
        chain = chain.replace(values)
        if any(path.startswith("sensor_noise.") for path in values):
            floor[round(t_s / scenario.stage.dt_s) :] = noise_floor_um(replace(scenario.stage, effects=chain))
    return floor
