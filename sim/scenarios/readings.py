"""What a sensor's glitches make of its readings: single spikes, runs of wrong readings, readings that are none."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray


@dataclass(frozen=True, slots=True)
class Readings:
    """Wrong readings: ``runs`` are (first sample, how many, what is added in µm; NaN for no reading at all)."""

    runs: tuple[tuple[int, int, float], ...] = ()

    def __post_init__(self) -> None:
        for first, count, _ in self.runs:
            if first < 0 or count < 1:
                raise InputError(f"runs: got {count} samples from {first} on, expected at least one, from 0 on")

    def spoil(self, start: int, y_um: FloatArray) -> FloatArray:
        """(n,) readings of the samples from ``start`` on as the learner gets them, µm. The input is not changed."""
        spoilt = y_um.copy()
        stop = start + y_um.shape[0]
        for first, count, added in self.runs:
            a, b = max(first, start), min(first + count, stop)
            if a < b:
                spoilt[a - start : b - start] += added
        return spoilt


def glitch_burst(
    start: int, stop: int, rate: float, longest: int, size_um: tuple[float, float], rng: np.random.Generator
) -> Readings:
    """Glitches between two samples: each sample begins one with probability ``rate``; they never overlap.

    Lengths are even from 1 to ``longest`` samples; sizes, either sign, are even in log between the two of
    ``size_um``; one in ten is no reading at all.
    """
    runs: list[tuple[int, int, float]] = []
    at = start
    while True:
        at += int(rng.geometric(rate))
        count = int(rng.integers(1, longest + 1))
        if at + count > stop:
            return Readings(tuple(runs))
        size = math.exp(rng.uniform(*np.log(size_um))) * (1.0 if rng.random() < 0.5 else -1.0)
        runs.append((at, count, math.nan if rng.random() < 0.1 else size))
        at += count
