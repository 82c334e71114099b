"""Tables 2.1 to 2.4, Figs. 2.8 to 2.15: every forward model identified on (2.37), scored on (2.45) and further records.

All are identified from the chapter's 500 displacements at 0.02 s. Models with memory run on the voltage commanded at
1 ms. Errors are compared at the 0.02 s samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.identify import identify_bouc_wen, independent_samples
from dehyst.baselines.bouc_wen.model import BoucWenParameters
from dehyst.baselines.prandtl_ishlinskii.identify import identify_mpi
from dehyst.baselines.prandtl_ishlinskii.model import MpiParameters
from dehyst.baselines.swarm import SwarmConfig, swarm_bouc_wen, swarm_mpi
from dehyst.sim.chapter.experiments import DT_S, EVERY, Experiments, Record, Score
from dehyst.sim.chapter.forward_lssvm import MemoryLssvm, TwoInputLssvm, fit_memory, fit_two_inputs

# --- Bouc-Wen stage identified from 500 displacements with the voltage known between them.
#
# At 0.02 s the 3 Hz turns of the input lie between samples, and a line through the sampled voltages cuts them off by up
# to 0.07 V. Where the voltage is known at 1 ms, the model runs on that and is compared where there are displacements.

#: A negligible m/k, s².
_NEGLIGIBLE_INERTIA = 1e-9
#: Least decrease of the cost, in units of its value per independent sample, for which m/k is kept.
_SIGNIFICANT = 10.0


def _model(x: FloatArray, base: BoucWenParameters) -> BoucWenParameters:
    """x: alpha, log(beta + gamma), beta/(beta + gamma), log b/k, log m/k."""
    rate, share = math.exp(x[1]), float(x[2])
    k = base.k_N_per_m
    return replace(
        base,
        alpha=float(x[0]),
        beta_per_V=share * rate,
        gamma_per_V=(1.0 - share) * rate,
        b_N_s_per_m=math.exp(x[3]) * k,
        m_kg=math.exp(x[4]) * k,
        d_um_per_V=1.0,
        offset_um=0.0,
    )


def refine_bouc_wen(
    start: BoucWenParameters, u_fine_V: FloatArray, y_um: FloatArray, dt_s: float, every: int
) -> tuple[BoucWenParameters, int]:
    """Least squares from ``start`` on voltages (m,) V, ``dt_s`` s apart, and displacements at each ``every``-th one.

    Gain and offset are solved for within the cost; m/k is negligible unless the data show it. Returns the parameters
    and the number of evaluations. Raises InputError on lengths that do not fit together.
    """
    if y_um.shape != u_fine_V[::every].shape:
        raise InputError(f"y_um: got {y_um.shape}, expected {u_fine_V[::every].shape}: one for {every} of u_fine_V")
    evaluations = 0

    def linear(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        nonlocal evaluations
        evaluations += 1
        bare = _model(x, start).simulate(u_fine_V, dt_s)[::every]
        columns = np.column_stack([bare, np.ones(bare.size)])
        coefficients = np.asarray(np.linalg.lstsq(columns, y_um, rcond=None)[0], dtype=np.float64)
        return columns @ coefficients - y_um, coefficients

    low = np.array([0.0, math.log(1e-2), 0.02, math.log(1e-6), math.log(1e-10)])
    high = np.array([0.95, math.log(1e2), 0.98, math.log(1.0), math.log(1e-2)])
    rate = start.beta_per_V + start.gamma_per_V
    shape = [start.alpha, math.log(rate), start.beta_per_V / rate, math.log(start.lag_s)]

    def solve(inertia_s2: float, free: int) -> tuple[float, FloatArray]:
        """Cost µm² and parameters; m/k, the last, is fixed where only four are ``free``."""
        first = np.clip(np.array([*shape, math.log(inertia_s2)]), low + 1e-9, high - 1e-9)
        # 2 alpha beta < beta + gamma keeps the model invertible
        first[0] = min(first[0], 0.49 / first[2])

        def whole(x: FloatArray) -> FloatArray:
            return np.concatenate([x, first[free:]])

        def residual(x: FloatArray) -> FloatArray:
            return linear(whole(x))[0] if 2.0 * x[0] * x[2] < 1.0 else np.full(y_um.size, 1e3)

        found = least_squares(
            residual,
            first[:free],
            bounds=(low[:free], high[:free]),
            x_scale=np.array([0.1, 0.3, 0.1, 0.3, 1.0])[:free],
            diff_step=1e-6,
            max_nfev=30,
        )
        return float(found.cost), whole(found.x)

    fixed = solve(_NEGLIGIBLE_INERTIA, 4)
    free = min((solve(inertia, 5) for inertia in (start.inertia_s2, _NEGLIGIBLE_INERTIA)), key=lambda entry: entry[0])
    gained = (fixed[0] - free[0]) * independent_samples(linear(free[1])[0])
    best = fixed[1] if gained < _SIGNIFICANT * free[0] else free[1]
    gain, offset = linear(best)[1]
    return _model(best, start).with_gain(float(gain), float(offset)), evaluations


# --- Forward models on the records.

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
    generalisation_um : model outputs on (2.45) at the 0.02 s samples, µm.
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

    training, _ = of(data.training)
    generalisation, generalisation_um = of(data.generalisation)
    third = {record.name: of(record)[0] for record in data.third}
    identified = key, label, route, model, parameters, seconds
    return ForwardRun(*identified, training, generalisation, third, generalisation_um)


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
    add("lssvm_memory", "LSSVM with memory", "prior and evidence", 6, lambda: fit_memory(data.training.u_V, y))
    return runs
