"""What the solver benchmarks share: the stream of samples, and times of single calls, in µs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.types import FloatArray

#: Features of a sample: displacement, velocity and three play operators.
DIMENSION = 5
WIDTH = 1.0
GAMMA = 100.0


def stream(count: int, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    """Normalised X (count, d), y (count,) along a smooth random trajectory; 0.2 % noise, a fifth near-duplicates."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) * 0.02
    tones = rng.uniform(0.2, 3.0, (DIMENSION, 3)), rng.uniform(0, 2 * np.pi, (DIMENSION, 3))
    X = np.stack([np.mean(0.5 + 0.5 * np.sin(np.outer(t, f) + p), axis=1) for f, p in zip(*tones, strict=True)], axis=1)
    for k in np.flatnonzero(rng.random(count) < 0.2).tolist():
        X[k] = X[max(k - 1 - int(rng.integers(50)), 0)] + 1e-7 * rng.standard_normal(DIMENSION)
    y = np.sin(3 * X[:, 0]) + X[:, 1] * X[:, 2] + 0.3 * np.abs(X[:, 3] - 0.5) + 0.1 * X[:, 4]
    return np.ascontiguousarray(X), y + 0.002 * rng.standard_normal(count)


@dataclass(frozen=True, slots=True)
class Times:
    """Wall times of single calls, µs."""

    samples: FloatArray

    @property
    def median(self) -> float:
        return float(np.median(self.samples))

    @property
    def p99(self) -> float:
        return float(np.percentile(self.samples, 99))


def times(call: Callable[[], object], repeats: int, warm: int = 3) -> Times:
    """Time ``repeats`` calls one by one, after ``warm`` calls that do not count."""
    for _ in range(warm):
        call()
    taken = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter_ns()
        call()
        taken[i] = time.perf_counter_ns() - start
    return Times(taken / 1e3)


def interleaved(calls: dict[str, Callable[[], object]], repeats: int, block: int = 25) -> dict[str, Times]:
    """Time several calls in turns of ``block``, so that changes of clock frequency or load affect all alike."""
    parts: dict[str, list[FloatArray]] = {name: [] for name in calls}
    for _ in range(max(1, repeats // block)):
        for name, call in calls.items():
            parts[name].append(times(call, min(block, repeats), warm=1).samples)
    return {name: Times(np.concatenate(part)) for name, part in parts.items()}
