"""Malformed payloads from valid ones, reproducibly and without a fuzzer."""

from __future__ import annotations

import struct

import numpy as np

#: Numbers at which lengths, counts and conversions tend to fail.
_EDGES = (0, 1, -1, 2, 7, 255, 256, 4095, 4096, 4097, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1)
_DOUBLES = (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, 0.0, -0.0)


def mutated(payload: bytes, rng: np.random.Generator, most_bytes: int = 8192) -> bytes:
    """``payload`` with one to four changes: bytes, extreme numbers, cuts, repetitions, noise."""
    data = bytearray(payload)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, len(data) + 1))
        kind = int(rng.integers(0, 8))
        if kind == 0 and data:
            data[min(at, len(data) - 1)] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1 and data:
            data[min(at, len(data) - 1)] = int(rng.integers(0, 256))
        elif kind == 2:
            data[at : at + 4] = struct.pack("<I", _EDGES[int(rng.integers(len(_EDGES)))] % 2**32)
        elif kind == 3:
            at -= at % 8
            data[at : at + 8] = struct.pack("<d", _DOUBLES[int(rng.integers(len(_DOUBLES)))])
        elif kind == 4:
            del data[at:]
        elif kind == 5:
            data += data[at:]
        elif kind == 6:
            data[at:at] = rng.bytes(int(rng.integers(1, 40)))
        else:
            data = bytearray(rng.bytes(int(rng.integers(0, 200))))
    return bytes(data[:most_bytes])
