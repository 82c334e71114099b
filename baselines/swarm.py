"""Particle swarm as one batch in torch, and identification by it as in the chapter: Table 2.1, 1500 epochs."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.model import BoucWenParameters
from dehyst.baselines.bouc_wen.step import hysteresis_step, poles, run_stage
from dehyst.baselines.bounded_least_squares import SLOPE_FLOOR
from dehyst.baselines.common import FitReport, checked_recording
from dehyst.baselines.prandtl_ishlinskii.identify import PLAYS, ZONES, MpiGrid
from dehyst.baselines.prandtl_ishlinskii.model import MpiParameters, from_inverse_saturation
from dehyst.baselines.prandtl_ishlinskii.operators import dead_zone, play_run, play_start

# --- Particle swarm with all particles as one batch in torch, which is imported only when a swarm starts.


@dataclass(frozen=True, slots=True)
class SwarmConfig:
    """Settings of a swarm.

    Attributes
    ----------
    particles, epochs, seed : size, duration, and seed of the random numbers.
    inertia_first, inertia_last : the inertia falls linearly from the first to the last over three quarters of the
        epochs, so that the swarm explores first and then settles.
    pull : towards a particle's own best position and towards the best of the swarm.
    step_limit : largest step of a particle as a share of the box.
    """

    particles: int = 40
    epochs: int = 1500
    seed: int = 0
    inertia_first: float = 0.9
    inertia_last: float = 0.4
    pull: float = 2.0
    step_limit: float = 0.2

    def __post_init__(self) -> None:
        if self.particles < 2 or self.epochs < 1:
            raise InputError(
                f"particles, epochs: got {self.particles}, {self.epochs}, expected at least 2 particles and 1 epoch"
            )


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """Best position (dimensions,), its cost, the best cost after each epoch, and the number of evaluations."""

    position: FloatArray
    cost: float
    history: FloatArray
    evaluations: int


def minimise(
    cost: Callable[[Any], Any],
    lower: FloatArray,
    upper: FloatArray,
    config: SwarmConfig,
) -> SwarmResult:
    """Minimise ``cost`` over the box from ``lower`` to ``upper`` (dimensions,).

    ``cost`` maps a (particles, dimensions) float64 tensor to a (particles,) tensor; a value that is not finite counts
    as infinite. The result is deterministic for a seed. Raises ModuleNotFoundError without torch, InputError where no
    particle ever has a finite cost.
    """
    torch: Any = importlib.import_module("torch")
    generator = torch.Generator().manual_seed(config.seed)
    low = torch.as_tensor(np.asarray(lower, dtype=np.float64))
    high = torch.as_tensor(np.asarray(upper, dtype=np.float64))
    size = (config.particles, int(low.numel()))

    def draw() -> Any:
        return torch.rand(size, generator=generator, dtype=torch.float64)

    def finite(values: Any) -> Any:
        return torch.where(torch.isfinite(values), values, torch.full_like(values, float("inf")))

    with torch.no_grad():
        limit = config.step_limit * (high - low)
        position = low + (high - low) * draw()
        speed = 0.5 * (high - low) * (draw() - 0.5)
        own, own_cost = position.clone(), finite(cost(position))
        history = np.empty(config.epochs)
        for epoch in range(1, config.epochs + 1):
            best = own[torch.argmin(own_cost)]
            done = min(1.0, epoch / (0.75 * config.epochs))
            inertia = config.inertia_first + (config.inertia_last - config.inertia_first) * done
            pull = draw() * (own - position) + draw() * (best - position)
            speed = torch.minimum(torch.maximum(inertia * speed + config.pull * pull, -limit), limit)
            moved = position + speed
            position = torch.minimum(torch.maximum(moved, low), high)
            speed = torch.where(moved == position, speed, -0.5 * speed)  # a wall reflects half of the speed
            now = finite(cost(position))
            better = now < own_cost
            own = torch.where(better[:, None], position, own)
            own_cost = torch.where(better, now, own_cost)
            history[epoch - 1] = float(own_cost.min())
        winner = int(torch.argmin(own_cost))
        result = own[winner].numpy().astype(np.float64)
        final = float(own_cost[winner])
    if not np.isfinite(final):
        raise InputError("lower, upper: no particle had a finite cost; widen or move the search space")
    return SwarmResult(result, final, history, config.particles * (config.epochs + 1))


# --- Identification by particle swarm, as in the chapter: the search space of Table 2.1, 1500 epochs.
#
# It serves as the comparison in error and in time for ``identify_bouc_wen`` and ``identify_mpi``.

#: Search space of Table 2.1: m kg, b N s/m, k N/m, d µm/V (0 to 0.1 m/V), alpha, beta 1/V, gamma 1/V.
TABLE_2_1_LOWER = np.array([0.0, 1e2, 1e3, 0.0, 0.0, 0.0, 0.0])
TABLE_2_1_UPPER = np.array([1.0, 1e6, 1e9, 1e5, 1.0, 1.0, 1.0])
#: Least values of parameters that must be positive, in place of the zeros of the table.
_LEAST = np.array([1e-9, 1e2, 1e3, 1e-1, 0.0, 1e-9, 0.0])


@compiled
def bouc_wen_costs(theta: FloatArray, u_V: FloatArray, y_um: FloatArray, dt_s: float) -> FloatArray:
    """Mean squared error (2.3), µm², of each row of ``theta`` (particles, 7), with the best offset; (particles,).

    Infinite where displacement would not rise with voltage, because such a model has no inverse.
    """
    costs = np.empty(theta.shape[0])
    out = np.empty((u_V.size, 3))
    state = np.empty(6)
    for i in range(theta.shape[0]):
        m, b, k, d, alpha, beta, gamma = theta[i]
        if not (alpha < 1.0 and 2.0 * alpha * beta < beta + gamma):
            costs[i] = np.inf
            continue
        g = hysteresis_step(0.0, u_V[0], alpha, beta, gamma)
        state[:] = 0.0
        state[0], state[1], state[2], state[4] = u_V[0], g, u_V[0] - g, u_V[0] - g
        p1, p2 = poles(b / k, m / k)
        run_stage(u_V, dt_s, p1, p2, theta[i, 4:], True, state, out)
        mean, square = 0.0, 0.0
        for j in range(u_V.size):
            error = y_um[j] - d * out[j, 0]
            mean += error
            square += error * error
        mean /= u_V.size
        costs[i] = square / u_V.size - mean * mean
    return costs


def swarm_bouc_wen(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, config: SwarmConfig | None = None
) -> tuple[BoucWenParameters, FitReport]:
    """Bouc-Wen stage by swarm over (2.3) in the search space of Table 2.1.

    Takes and returns what ``identify_bouc_wen`` does. The offset of the displacement, which the chapter's model lacks,
    is solved for within the cost. The swarm is a batch in torch; a compiled loop simulates its stages, because 500
    dependent samples give a tensor library nothing to do in parallel. Raises as `minimise`.
    """
    u, y, dt = checked_recording(u_V, y_um, dt_s, 20)
    setup = config or SwarmConfig()
    torch: Any = importlib.import_module("torch")

    def cost(theta: Any) -> Any:
        return torch.as_tensor(bouc_wen_costs(theta.numpy(), u, y, dt))

    found = minimise(cost, np.maximum(TABLE_2_1_LOWER, _LEAST), TABLE_2_1_UPPER, setup)
    bare = BoucWenParameters(*found.position.tolist())
    offset = float(np.mean(y - bare.simulate(u, dt, bare.at_rest(float(u[0])))))
    parameters = bare.with_gain(bare.d_um_per_V, offset)
    model = parameters.simulate(u, dt, parameters.at_rest(float(u[0])))
    method = f"swarm of {setup.particles} over {found.history.size} epochs, Table 2.1's search space"
    return parameters, FitReport.of("bouc_wen", method, y, model, dt, found.evaluations, True)


def swarm_mpi(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, config: SwarmConfig | None = None
) -> tuple[MpiParameters, FitReport]:
    """MPI model by swarm over (2.40), with weights within [0, 1] as in the chapter.

    The residual is measured after all weights are scaled so that the inverse saturation maps the recorded stroke onto
    itself, the scale constraint of ``identify_mpi``; all weights zero then cost infinitely much. The offset of x is
    solved for within the cost. The whole swarm is evaluated in torch as one batch of quadratic forms. Raises as
    `minimise`.
    """
    u, y, dt = checked_recording(u_V, y_um, dt_s, PLAYS + ZONES + 4)
    setup = config or SwarmConfig()
    torch: Any = importlib.import_module("torch")
    grid = MpiGrid.of(u, y)
    plays = play_run(u, grid.r_V, play_start(float(u[0]), grid.r_V))
    columns = np.hstack([plays, -dead_zone(y - grid.y_ref_um, grid.d_star_um)])
    means = columns.mean(axis=0)
    gram = torch.as_tensor((columns - means).T @ (columns - means) / u.size)
    at_stroke = np.zeros(columns.shape[1])
    at_stroke[PLAYS + 1 :] = dead_zone(np.array([grid.stroke_um]), grid.d_star_um)[0] / grid.stroke_um
    scale = torch.as_tensor(at_stroke)

    def cost(theta: Any) -> Any:
        return ((theta @ gram) * theta).sum(dim=1) / (theta @ scale) ** 2

    lower, upper = np.zeros(columns.shape[1]), np.ones(columns.shape[1])
    lower[0] = lower[PLAYS + 1] = SLOPE_FLOOR * float(np.ptp(u)) / grid.stroke_um  # both first slopes above zero
    found = minimise(cost, lower, upper, setup)
    weights = found.position / float(at_stroke @ found.position)
    offset = -float(means @ weights)
    parameters = from_inverse_saturation(
        grid.r_V, weights[: PLAYS + 1], grid.d_star_um, weights[PLAYS + 1 :], offset, grid.y_ref_um
    )
    method = f"swarm of {setup.particles} over {found.history.size} epochs on (2.40), weights in [0, 1]"
    notes = ("scale: the inverse saturation maps the recorded stroke onto itself",)
    model = parameters.simulate(u, dt)
    return parameters, FitReport.of("mpi", method, y, model, dt, found.evaluations, True, notes)
