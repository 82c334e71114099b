"""Counter-based noise: the value of sample k depends on the seed and on k alone.

Stepwise and batch runs, and stages with the same seed, therefore have identical noise. The integer hash is splitmix64
(Steele, Lea, Flood 2014); normal deviates follow Box and Muller.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from dehyst.adaptive.compiled import compiled

_STEP = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@compiled
def uniform(seed: float, index: int) -> float:
    """Uniform in (0, 1), never 0: the hash of (seed, index). ``seed`` holds an integer below 2^53."""
    z = np.uint64(seed) * _M2 + np.uint64(index) * _STEP + _STEP
    z = (z ^ (z >> _S30)) * _M1
    z = (z ^ (z >> _S27)) * _M2
    z = z ^ (z >> _S31)
    return (float(z >> _S11) + 0.5) / 9007199254740992.0


@compiled
def normal(seed: float, index: int) -> float:
    """Standard normal deviate number ``index``."""
    radius = math.sqrt(-2.0 * math.log(uniform(seed, 2 * index)))
    return radius * math.cos(2.0 * math.pi * uniform(seed, 2 * index + 1))


def stream(seed: int, axis: int, label: str) -> int:
    """A 53-bit seed of its own for the effect ``label`` of axis ``axis`` of the stage with ``seed``."""
    digest = hashlib.blake2b(f"{seed}/{axis}/{label}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 11
