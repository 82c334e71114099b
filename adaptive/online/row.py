"""The row of an axis: all arrays of its state and its constants, for compiled code.

The numbers of an axis are in one structured array (`adaptive.state.Numbers`), its arrays in a `Row`. A row is handed
over as its handle (`adaptive.window.arrays`): forty arrays would cost more to hand over than an ordinary sample does.
"""

from __future__ import annotations

from typing import NamedTuple

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.adaptive.window.arrays import integers_of, matrix_of, vector_of


class Row(NamedTuple):
    """Arrays of one axis. What is not explained is declared where it is part of a state.

    motion : (3,) smoothed instant. basis (p,) : of the instant to learn. mark_covariance (2 p, p). walks, bursts (p,) :
    variances of the filter, V². model, sizes : the identified model, as `LssvmInverse.packed` has it. transition, gain,
    lag_gains, scale : of the smoother.
    """

    x: FloatArray
    ring: FloatArray
    drive_x: FloatArray
    drive_ring: FloatArray
    voltages: FloatArray
    readings: FloatArray
    good: IntArray
    motion: FloatArray
    rates: FloatArray
    known: FloatArray
    memory: FloatArray
    frozen_memory: FloatArray
    frames: FloatArray
    beta: FloatArray
    covariance: FloatArray
    mark_beta: FloatArray
    mark_covariance: FloatArray
    references: FloatArray
    delay: FloatArray
    domain: FloatArray
    basis: FloatArray
    point: FloatArray
    born: IntArray
    past_motion: FloatArray
    past_V: FloatArray
    past_um: FloatArray
    past_memory: FloatArray
    past_ring: FloatArray
    past_from: IntArray
    counters: IntArray
    walks: FloatArray
    bursts: FloatArray
    model: FloatArray
    sizes: IntArray
    transition: FloatArray
    gain: FloatArray
    lag_gains: FloatArray
    scale: FloatArray


@compiled
def row_of(h: IntArray) -> Row:  # pragma: no cover - compiled
    """The row behind a handle."""
    return Row(
        vector_of(h, 0), matrix_of(h, 1), vector_of(h, 2), matrix_of(h, 3), vector_of(h, 4), vector_of(h, 5),
        integers_of(h, 6), vector_of(h, 7), vector_of(h, 8), matrix_of(h, 9), vector_of(h, 10), vector_of(h, 11),
        matrix_of(h, 12), vector_of(h, 13), matrix_of(h, 14), matrix_of(h, 15), matrix_of(h, 16), matrix_of(h, 17),
        matrix_of(h, 18), vector_of(h, 19), vector_of(h, 20), vector_of(h, 21), integers_of(h, 22), matrix_of(h, 23),
        matrix_of(h, 24), matrix_of(h, 25), matrix_of(h, 26), vector_of(h, 27), integers_of(h, 28), integers_of(h, 29),
        vector_of(h, 30), vector_of(h, 31), vector_of(h, 32), integers_of(h, 33), matrix_of(h, 34), vector_of(h, 35),
        matrix_of(h, 36), vector_of(h, 37),
    )  # fmt: skip
