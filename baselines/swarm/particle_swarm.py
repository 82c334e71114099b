"""Particle swarm with all particles as one batch in torch, which is imported only when a swarm starts."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from adaptive.errors import DehystError, InputError
from adaptive.types import FloatArray

#: Called after each epoch with its number, from 1, and the best cost so far. Returning False stops the swarm.
Progress = Callable[[int, float], bool | None]


class MissingTorchError(DehystError, ImportError):
    """torch is not installed; the message says how to install it."""


def torch_module() -> Any:
    """The torch module. Raises MissingTorchError where it cannot be imported."""
    try:
        return importlib.import_module("torch")
    except ImportError as error:
        raise MissingTorchError(
            f"torch: {error}; identification by swarm needs it: pip install 'dehyst[torch]', or use the least-squares "
            "identification, which does not need it"
        ) from error


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
    device : device name for torch.
    """

    particles: int = 40
    epochs: int = 1500
    seed: int = 0
    inertia_first: float = 0.9
    inertia_last: float = 0.4
    pull: float = 2.0
    step_limit: float = 0.2
    device: str = "cpu"

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
    progress: Progress | None = None,
) -> SwarmResult:
    """Minimise ``cost`` over the box from ``lower`` to ``upper`` (dimensions,).

    ``cost`` maps a (particles, dimensions) float64 tensor on ``config.device`` to a (particles,) tensor; a value that
    is not finite counts as infinite. The result is deterministic for a seed. Raises MissingTorchError, and InputError
    where no particle ever has a finite cost.
    """
    torch = torch_module()
    generator = torch.Generator(device="cpu").manual_seed(config.seed)
    low = torch.as_tensor(np.asarray(lower, dtype=np.float64), device=config.device)
    high = torch.as_tensor(np.asarray(upper, dtype=np.float64), device=config.device)
    size = (config.particles, int(low.numel()))

    def draw() -> Any:
        return torch.rand(size, generator=generator, dtype=torch.float64).to(config.device)

    def finite(values: Any) -> Any:
        return torch.where(torch.isfinite(values), values, torch.full_like(values, float("inf")))

    with torch.no_grad():
        limit = config.step_limit * (high - low)
        position = low + (high - low) * draw()
        speed = 0.5 * (high - low) * (draw() - 0.5)
        own, own_cost = position.clone(), finite(cost(position))
        history = np.empty(config.epochs)
        epoch = 0
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
            if progress is not None and progress(epoch, float(history[epoch - 1])) is False:
                break
        winner = int(torch.argmin(own_cost))
        result = own[winner].cpu().numpy().astype(np.float64)
        final = float(own_cost[winner])
    if not np.isfinite(final):
        raise InputError("lower, upper: no particle had a finite cost; widen or move the search space")
    return SwarmResult(result, final, history[:epoch], config.particles * (epoch + 1))
