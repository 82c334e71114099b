"""The served models of all axes, immutable, and their evaluation at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.fleet.state import Fixed, Rows
from dehyst.adaptive.fleet.windows import Threads
from dehyst.adaptive.inverse_model import DOMAIN_MARGIN, LssvmInverse, evaluate_packed, unpacked
from dehyst.adaptive.types import BoolArray, Feedforward, FloatArray, IntArray
from dehyst.adaptive.window.arrays import ALPHA, BETA, COUNT, GAMMA


@compiled
def _evaluate(
    lo: int, hi: int, axes: IntArray, packed: FloatArray, counts: IntArray, motion: FloatArray, memory: FloatArray,
    u: FloatArray, std: FloatArray, inside: BoolArray,
) -> None:  # fmt: skip
    for k in range(lo, hi):
        y, v, a, b = motion[0, k], motion[1, k], motion[2, k], axes[k]
        evaluate_packed(y, v, a, memory[k], packed[b], counts[b], u[k], std[k], inside[k])


@dataclass(frozen=True)
class FleetSnapshot:
    """B models. seq (B,) : last sample that each has seen. valid (B,) : whether its learner vouches for it.

    linear : (B, 2 + p) gain and offset (µm) of each axis' frame, and its linear part, V.
    packed (B, L), counts (B, C) : the models as `LssvmInverse.packed` has them.
    """

    bases: tuple[LssvmInverse, ...]
    seq: IntArray
    valid: BoolArray
    linear: FloatArray
    packed: FloatArray
    counts: IntArray
    threads: Threads

    def rest_memory(self) -> FloatArray:
        """(B, m) memory of stages that have always been at rest."""
        return np.array([base.rest_memory(base.features.y_rest_um) for base in self.bases])

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray,
        axes: IntArray | None = None,
    ) -> Feedforward:  # fmt: skip
        """Voltages (B, n) and memory (B, m) of all axes, or of B ``axes``, at (B, n) points, one sample time apart.

        Raises InputError on shapes that do not fit together.
        """
        at = np.arange(len(self.bases)) if axes is None else axes
        B, given = at.size, [np.asarray(part, dtype=np.float64) for part in (y_um, v_um_per_s, a_um_per_s2)]
        shapes = [part.shape for part in given]
        if len(shapes[0]) != 2 or shapes[0][0] != B or len(set(shapes)) != 1:
            raise InputError(f"y_um, v_um_per_s, a_um_per_s2: got shapes {shapes}, expected three of equal ({B}, n)")
        if np.shape(memory) != (B, self.bases[0].memory_size):
            raise InputError(f"memory: got shape {np.shape(memory)}, expected ({B}, {self.bases[0].memory_size})")
        after, (u, std) = np.array(memory, dtype=np.float64), np.empty((2, *shapes[0]))
        inside = np.empty(shapes[0], dtype=np.bool_)
        self.threads.share(B, _evaluate, at, self.packed, self.counts, np.array(given), after, u, std, inside)
        return Feedforward(u, std, inside, after)


@compiled
def _pack(
    lo: int, hi: int, s: Rows, c: Fixed, V: FloatArray, F: FloatArray, C: IntArray, support: FloatArray,
    widths: FloatArray, margin: float, packed: FloatArray, counts: IntArray, linear: FloatArray,
) -> None:  # fmt: skip
    """The learnt models of all axes in the layout of `LssvmInverse.packed`, with ``linear`` as of `FleetSnapshot`."""
    for b in range(lo, hi):
        out, r, f, n = packed[b], s.numbers[b], c.axis[b], C[b, COUNT]
        j, span, bounded = r.judgement, s.domain[b, 1::2] - s.domain[b, ::2], f.allowed_V > 0.0
        counts[b] = c.sizes[f.model]
        counts[b, 5], counts[b, 6], counts[b, 9] = n, 0, bounded
        m, beta, inverse_widths, alpha, scaled, at = unpacked(out, counts[b])
        m.frame[:], m.scale[:] = s.frames[b], c.features.scale[b]
        m.thresholds[:], m.arcs[:], m.retain[:] = c.features.thresholds[b], c.features.arcs[b], c.features.retain[b]
        out[3] = max(j.long_V2, j.short_V2) + j.doubt_V2
        out[4], out[5], out[6] = r.window.kernel_variance, 1.0 / (1.0 + 1.0 / F[b, GAMMA]), f.allowed_V
        out[7:13:2] = s.domain[b, ::2] - margin * span
        out[8:13:2] = s.domain[b, 1::2] + margin * span
        share = r.window.share
        beta[:], inverse_widths[:], alpha[:] = s.beta[b], widths[b], share * V[b, ALPHA, :n]
        beta[0] += share * F[b, BETA]
        scaled[:] = support[b, :, :n]
        if bounded:
            out[at : at + beta.size] = c.beta[b]
        linear[b, 0], linear[b, 1], linear[b, 2:] = r.front.track.served.gain, s.frames[b, 0], beta


def snapshot_of(
    bases: tuple[LssvmInverse, ...], s: Rows, c: Fixed, windows: dict[str, FloatArray], apart: dict[int, LssvmInverse],
    threads: Threads,
) -> FleetSnapshot:  # fmt: skip
    """Copies of what is served now; ``apart`` : models of the axes that are not in the batch, or frozen."""
    B, p = s.beta.shape
    d, most = windows["scaled"].shape[1:]
    length = max(17 + int(c.sizes[0, :3].sum()) + 2 * p + d + (1 + d) * most, c.models.shape[1])
    packed, counts = np.empty((B, length)), np.empty((B, c.sizes.shape[1]), dtype=np.int64)
    linear, parts = np.empty((B, 2 + p)), (windows[name] for name in ("V", "F", "C", "scaled", "inverse_widths"))
    threads.share(B, _pack, s, c, *parts, DOMAIN_MARGIN, packed, counts, linear)
    seq, valid = s.numbers["front"]["gates"]["seq"].copy(), s.numbers["judgement"]["valid"].copy()
    fallen = [axis for axis in np.flatnonzero(s.numbers["judgement"]["fallback"]).tolist() if axis not in apart]
    for axis, model in (apart | {axis: bases[axis] for axis in fallen}).items():
        row, sizes = model.packed
        packed[axis, : row.size], counts[axis] = row, sizes
        linear[axis] = model.features.gain, model.features.offset_um, *model.beta
    # The fourth number of a packed model is the variance of its noise.
    packed[fallen, 3] = s.numbers["judgement"]["frozen_short_V2"][fallen]
    for axis, model in apart.items():
        seq[axis], valid[axis] = model.seq, model.valid
    return FleetSnapshot(bases, seq, valid, linear, packed, counts, threads)
