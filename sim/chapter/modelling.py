"""Tables 2.1 to 2.4, Figs. 2.8 to 2.15: every forward model identified on (2.37), scored on (2.45) and further records.

All are identified from the chapter's 500 displacements at 0.02 s. Models with memory run on the voltage commanded at
1 ms. Errors are compared at the 0.02 s samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from baselines.bouc_wen.identify import identify_bouc_wen
from baselines.bouc_wen.model import BoucWenParameters
from baselines.prandtl_ishlinskii.identify import identify_mpi
from baselines.prandtl_ishlinskii.model import MpiParameters
from baselines.swarm.identification import swarm_bouc_wen, swarm_mpi
from baselines.swarm.particle_swarm import SwarmConfig
from sim.chapter import published
from sim.chapter.experiments import DT_S, EVERY, Experiments, Record, Score
from sim.chapter.forward_lssvm import MemoryLssvm, TwoInputLssvm, fit_memory, fit_two_inputs
from sim.chapter.refine import refine_bouc_wen

Forward = BoucWenParameters | MpiParameters | TwoInputLssvm | MemoryLssvm
Progress = Callable[[str], None]
Clock = Callable[[], float]


@dataclass(frozen=True, slots=True)
class ForwardRun:
    """One identified model and its scores.

    Attributes
    ----------
    key, label, route : short name, name for people, and method of identification.
    parameters : number of identified parameters. seconds : duration of the identification, s.
    training, generalisation : scores on (2.37) and (2.45). third : by record of the third family.
    training_um, generalisation_um : model outputs at the 0.02 s samples, µm.
    """

    key: str
    label: str
    route: str
    model: Forward
    parameters: int
    seconds: float
    training: Score
    generalisation: Score
    third: dict[str, Score]
    training_um: FloatArray
    generalisation_um: FloatArray

    @property
    def third_mae_pct(self) -> float:
        """Mean of the MAE over the records of the third family."""
        return float(np.mean([score.mae_pct for score in self.third.values()]))


def predict(model: Forward, u_V: FloatArray) -> FloatArray:
    """Displacement µm at every `EVERY`-th of the voltages (n,), 1 ms apart, from rest."""
    if isinstance(model, TwoInputLssvm | MemoryLssvm):
        return model.predict(u_V)
    return model.simulate(u_V, DT_S)[::EVERY]


def judge(
    key: str, label: str, route: str, model: Forward, parameters: int, seconds: float, data: Experiments
) -> ForwardRun:
    """Score a model on all records."""

    def of(record: Record) -> tuple[Score, FloatArray]:
        out = predict(model, record.u_V)
        return Score.of(out - record.coarse_y_um, data.range_um), out

    training, training_um = of(data.training)
    generalisation, generalisation_um = of(data.generalisation)
    third = {record.name: of(record)[0] for record in data.third}
    return ForwardRun(
        key,
        label,
        route,
        model,
        parameters,
        seconds,
        training,
        generalisation,
        third,
        training_um,
        generalisation_um,
    )


def identify_forward(
    data: Experiments,
    *,
    pso: bool = True,
    epochs: int = 1500,
    clock: Clock = lambda: 0.0,
    progress: Progress = lambda _: None,
) -> list[ForwardRun]:
    """All forward models. ``pso`` adds the chapter's swarms over ``epochs`` epochs, which need torch.

    ``clock`` gives the time, s, with which the durations are measured.
    """
    u, y, dt_s = data.training.coarse_u_V, data.training.coarse_y_um, DT_S * EVERY
    runs = []

    def add(key: str, label: str, route: str, count: int, make: Callable[[], Forward]) -> None:
        progress(f"identifying {label} by {route}")
        start = clock()
        model = make()
        runs.append(judge(key, label, route, model, count, clock() - start, data))

    def bouc_wen() -> Forward:
        found = identify_bouc_wen(u, y, dt_s)[0]
        return refine_bouc_wen(found, data.training.u_V, y, DT_S, EVERY)[0]

    if pso:
        swarm = SwarmConfig(epochs=epochs)
        add("bouc_wen_pso", "Bouc-Wen", f"PSO, {epochs} epochs", 7, lambda: swarm_bouc_wen(u, y, dt_s, swarm)[0])
    add("bouc_wen", "Bouc-Wen", "least squares", 7, bouc_wen)
    if pso:
        add("mpi_pso", "MPI", f"PSO, {epochs} epochs", 20, lambda: swarm_mpi(u, y, dt_s, swarm)[0])
    add("mpi", "MPI", "non-negative least squares", 20, lambda: identify_mpi(u, y, dt_s)[0])
    add(
        "mpi_lag", "MPI with a lag", "non-negative least squares", 21, lambda: identify_mpi(u, y, dt_s, fit_lag=True)[0]
    )
    add("lssvm", "LSSVM (u, du/dt)", "three-level inference", 2, lambda: fit_two_inputs(u, y))
    given = published.FORWARD_HYPER
    text = f"gamma {given[0]:g}, sigma {given[1]:g} given"
    add("lssvm_given", "LSSVM (u, du/dt)", text, 2, lambda: fit_two_inputs(u, y, given))
    add("lssvm_memory", "LSSVM with memory", "prior and evidence", 6, lambda: fit_memory(data.training.u_V, y))
    return runs
