"""From motion to the inputs of a model: normalised motion, play operators, arc and slow states.

Displacement and velocity do not determine the voltage: hysteresis has memory. Three kinds of operators hold it.
Play operators on the displacement (the inverse of a Prandtl-Ishlinskii model is a Prandtl-Ishlinskii model of the
displacement); *arc states*, which relax towards y over the path travelled and not over time (the Duhem model's way:
smooth loops without return points); and *slow states*, leaky integrals with log-spaced time constants, for creep.
They form the flat ``memory`` that travels with the caller, in µm:
``[play_1 .. play_K, arc_1 .. arc_A, slow_1 .. slow_M, end of the path]``, the last entry only where there are arcs.

Two vectors come out of a point:

- ``basis`` (p,): inputs of the model's linear part, normalised:
  ``[1, y, v, a, y², y³, (y - play_r)/r .., y (y - play_r)/r .., (y - arc_rho)/rho .., y - slow_m ..]``,
  where the products with y let the two branches of a loop differ in shape (asymmetry);
- ``kernel`` (d,): inputs of its kernel part, ``[y, v, (y - play_r)/r for the chosen r]``.

All operators and inputs see the displacement in the *frame* of the identified stage, (y - offset)/gain: a stage
whose gain has dropped passes the same states at other readings, and its memory does not see the drop as motion.

The chapter's two-input model is the special case without memory: basis ``[1]``, kernel ``[y, v]``.
"""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field, replace
from math import isfinite
from typing import Annotated, Any, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import compiled, compiled_contracting, compiled_reassociating, in_numpy
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray

# --- The compiled loops: the memory after a point, and the inputs of a model at that point.


#: basis columns ahead of the plays when the linear part is on: 1, y, v, a, y², y³
MOTION_COLUMNS = 6
VELOCITY, ACCELERATION = 2, 3


class FeatureArrays(NamedTuple):
    """A feature map as arrays for the compiled loops; read only.

    thresholds (K,), arc lengths (A,), both µm; retain (M,) = exp(-dt/tau) of the slow states; scale
    [y0, 1/y, 1/v, 1/a]; kernel_plays (d - 2,) indices; flags [linear, asymmetric];
    frame [offset, 1/gain, dead band of the arcs].
    """

    thresholds: FloatArray
    arcs: FloatArray
    retain: FloatArray
    scale: FloatArray
    kernel_plays: Any
    flags: Any
    frame: FloatArray


@compiled
def advance(y_um: float, memory: FloatArray, m: FeatureArrays) -> None:  # pragma: no cover - compiled
    """Memory after one point at ``y_um``, in place.

    A play follows y at the distance of its threshold; an arc state relaxes towards y, by exp(-path/rho); a slow
    state by exp(-dt/tau). The path is counted behind a dead band: the noise of a stage at rest would otherwise relax
    the arcs within seconds.
    """
    y = (y_um - m.frame[0]) * m.frame[1]
    n = m.thresholds.shape[0]
    arcs = m.arcs.shape[0]
    for i in range(m.retain.shape[0]):
        memory[n + arcs + i] = y + (memory[n + arcs + i] - y) * m.retain[i]
    for i in range(n):
        r = m.thresholds[i]
        memory[i] = max(y - r, min(y + r, memory[i]))
    if arcs > 0:
        last = memory.shape[0] - 1
        before = memory[last]
        memory[last] = max(y - m.frame[2], min(y + m.frame[2], before))
        path = abs(memory[last] - before)
        for i in range(arcs):
            memory[n + i] = y + (memory[n + i] - y) * np.exp(-path / m.arcs[i])


@compiled
def fill(
    y_um: float, v: float, a: float, memory: FloatArray, m: FeatureArrays, basis: FloatArray, kernel: FloatArray
) -> None:  # pragma: no cover - compiled
    """Basis and kernel inputs of one point, from the memory *after* it."""
    y = (y_um - m.frame[0]) * m.frame[1]
    yn = (y - m.scale[0]) * m.scale[1]
    vn = v * m.frame[1] * m.scale[2]
    kernel[0] = yn
    kernel[1] = vn
    for i in range(m.kernel_plays.shape[0]):
        j = m.kernel_plays[i]
        kernel[2 + i] = (y - memory[j]) / m.thresholds[j]
    basis[0] = 1.0
    if not m.flags[0]:
        return
    basis[1] = yn
    basis[2] = vn
    basis[3] = a * m.frame[1] * m.scale[3]
    basis[4] = yn * yn
    basis[5] = yn * yn * yn
    at = 6
    n = m.thresholds.shape[0]
    for i in range(n):
        basis[at + i] = (y - memory[i]) / m.thresholds[i]
    at += n
    if m.flags[1]:
        for i in range(n):
            basis[at + i] = basis[at - n + i] * yn
        at += n
    for i in range(m.arcs.shape[0]):
        basis[at + i] = (y - memory[n + i]) / m.arcs[i]
    at += m.arcs.shape[0]
    n += m.arcs.shape[0]
    for i in range(m.retain.shape[0]):
        basis[at + i] = (y - memory[n + i]) * m.scale[1]


@compiled
def _run_features(
    y: FloatArray,
    v: FloatArray,
    a: FloatArray,
    memory: FloatArray,
    m: FeatureArrays,
    basis: FloatArray,
    kernel: FloatArray,
) -> None:  # pragma: no cover - compiled
    """``advance`` and ``fill`` over n points, into basis (n, p) and kernel (n, d)."""
    for i in range(y.shape[0]):
        advance(y[i], memory, m)
        fill(y[i], v[i], a[i], memory, m, basis[i], kernel[i])


@dataclass(frozen=True)
class FeatureMap:
    """Frozen map from motion to model inputs.

    The frame: a reading y means the displacement (y - offset_um)/gain of the identified stage.
    """

    dt_s: Annotated[float, Entry("sample time", "s")]
    y_min_um: Annotated[float, Entry("lower end of the range, which (2.42) maps to -1", "µm")]
    y_max_um: Annotated[float, Entry("upper end, mapped to 1", "µm")]
    v_scale_um_per_s: Annotated[float, Entry("velocity that counts as 1", "µm/s")]
    a_scale_um_per_s2: Annotated[float, Entry("acceleration that counts as 1", "µm/s²")]
    thresholds_um: Annotated[tuple[float, ...], Entry("play thresholds, ascending", "µm", "plays")] = ()
    arc_lengths_um: Annotated[tuple[float, ...], Entry("of the arc states, ascending", "µm", "arcs")] = ()
    time_constants_s: Annotated[tuple[float, ...], Entry("of the slow states, ascending", "s", "slow")] = ()
    kernel_plays: Annotated[tuple[int, ...], Entry("plays that the kernel sees, by index", "", "kernel_plays")] = ()
    linear: Annotated[bool, Entry("whether the basis holds more than the constant")] = True
    asymmetric: Annotated[bool, Entry("whether it holds the plays times y")] = False
    y_rest_um: Annotated[float, Entry("where the plays rest, in the frame", "µm")] = 0.0
    gain: Annotated[float, Entry("gain of the frame", low=1e-6)] = 1.0
    offset_um: Annotated[float, Entry("offset of the frame", "µm")] = 0.0
    dead_um: Annotated[float, Entry("dead band of the arcs' path, some deviations of the motion's noise", "µm")] = 0.0

    #: A map from which only the frame differs: all else is taken from it unchecked.
    like: InitVar[FeatureMap | None] = None
    _arrays: FeatureArrays = field(init=False, repr=False, compare=False)

    def __post_init__(self, like: FeatureMap | None) -> None:
        if like is not None:
            if not (isfinite(self.gain) and self.gain > 0.0 and isfinite(self.offset_um)):
                raise InputError(f"gain, offset_um: got {self.gain}, {self.offset_um}, expected finite, gain above 0")
            frame = np.array([self.offset_um, 1.0 / self.gain, self.dead_um])
            frame.flags.writeable = False
            object.__setattr__(self, "_arrays", like.arrays._replace(frame=frame))
            return
        for name in ("dt_s", "v_scale_um_per_s", "a_scale_um_per_s2", "gain"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name}: got {value}, expected a positive finite number")
        if not (np.isfinite(self.y_min_um) and np.isfinite(self.y_max_um) and self.y_min_um < self.y_max_um):
            raise InputError(f"y_min_um, y_max_um: got {self.y_min_um}, {self.y_max_um}, expected a range in µm")
        if not (np.isfinite(self.dead_um) and self.dead_um >= 0.0):
            raise InputError(f"dead_um: got {self.dead_um}, expected a dead band in µm, not negative")
        for name in ("thresholds_um", "arc_lengths_um", "time_constants_s"):
            values = getattr(self, name)
            if any(not (np.isfinite(x) and x > 0.0) for x in values) or list(values) != sorted(set(values)):
                raise InputError(f"{name}: got {values}, expected positive values in ascending order")
        if any(not 0 <= k < len(self.thresholds_um) for k in self.kernel_plays):
            raise InputError(f"kernel_plays: got {self.kernel_plays}, expected indices below {len(self.thresholds_um)}")
        half = 0.5 * (self.y_max_um - self.y_min_um)
        scale = np.array(
            [
                self.y_min_um + half,
                1.0 / half,
                1.0 / self.v_scale_um_per_s,
                1.0 / self.a_scale_um_per_s2,
            ]
        )
        arrays = FeatureArrays(
            np.array(self.thresholds_um, dtype=np.float64),
            np.array(self.arc_lengths_um, dtype=np.float64),
            np.exp(-self.dt_s / np.array(self.time_constants_s, dtype=np.float64)),
            scale,
            np.array(self.kernel_plays, dtype=np.int64),
            np.array([self.linear, self.asymmetric], dtype=np.bool_),
            np.array([self.offset_um, 1.0 / self.gain, self.dead_um]),
        )
        for array in arrays:
            array.flags.writeable = False
        object.__setattr__(self, "_arrays", arrays)

    @property
    def memory_size(self) -> int:
        arcs = len(self.arc_lengths_um)
        return len(self.thresholds_um) + arcs + len(self.time_constants_s) + (arcs > 0)

    @property
    def basis_size(self) -> int:
        if not self.linear:
            return 1
        plays = len(self.thresholds_um) * (1 + self.asymmetric)
        return MOTION_COLUMNS + plays + len(self.arc_lengths_um) + len(self.time_constants_s)

    @property
    def kernel_size(self) -> int:
        return 2 + len(self.kernel_plays)

    @property
    def arrays(self) -> FeatureArrays:
        """The map as arrays for the compiled loops; read only."""
        return self._arrays

    def rest_memory(self, y_um: float) -> FloatArray:
        """Memory of a stage that moved from its rest position to ``y_um`` in one stroke and has settled there."""
        r, rho = self._arrays.thresholds, self._arrays.arcs
        y = (y_um - self.offset_um) / self.gain
        slow = np.full(len(self.time_constants_s), y)
        plays = np.clip(np.full(r.size, self.y_rest_um), y - r, y + r)
        arcs = y + (self.y_rest_um - y) * np.exp(-abs(y - self.y_rest_um) / rho)
        return np.concatenate([plays, arcs, slow, np.full(1 if rho.size else 0, y)])

    def memory_in(self, other: FeatureMap, memory: FloatArray) -> FloatArray:
        """(m,) memory converted to the frame of another map for the same readings; every entry is a displacement."""
        if other == self:
            return memory.copy()
        carried: FloatArray = (self.offset_um + self.gain * memory - other.offset_um) / other.gain
        return carried

    def in_frame(self, gain: float, offset_um: float) -> FeatureMap:
        """The same map in another frame, at little cost. Raises InputError where the frame is none."""
        return replace(self, gain=gain, offset_um=offset_um, like=self)

    def advance(self, y_um: float, memory: FloatArray) -> None:
        """Memory after one point, in place."""
        advance(y_um, memory, self._arrays)

    def fill(
        self,
        y_um: float,
        v_um_per_s: float,
        a_um_per_s2: float,
        memory: FloatArray,
        basis: FloatArray,
        kernel: FloatArray,
    ) -> None:
        """Write basis (p,) and kernel (d,) inputs of a point whose memory has been advanced."""
        fill(y_um, v_um_per_s, a_um_per_s2, memory, self._arrays, basis, kernel)

    def motion_of(self, kernel: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement µm and velocity µm/s, (n,) each, of kernel inputs (n, d), for display."""
        m = self._arrays
        y_um = (kernel[:, 0] / m.scale[1] + m.scale[0]) / m.frame[1] + m.frame[0]
        return y_um, kernel[:, 1] / (m.scale[2] * m.frame[1])

    def run(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) points to basis (n, p), kernel inputs (n, d) and the memory after the last. Inputs are not changed."""
        n = y_um.shape[0]
        after = memory.copy()
        basis = np.empty((n, self.basis_size))
        kernel = np.empty((n, self.kernel_size))
        _run_features(y_um, v_um_per_s, a_um_per_s2, after, self._arrays, basis, kernel)
        return basis, kernel, after

    @property
    def sizes(self) -> dict[str, int]:
        """Names of the dimensions of what belongs to this map; see `adaptive.state`."""
        plays, arcs, slow = self.thresholds_um, self.arc_lengths_um, self.time_constants_s
        named = {"plays": plays, "arcs": arcs, "slow": slow, "kernel_plays": self.kernel_plays}
        sizes = {name: len(values) for name, values in named.items()}
        return sizes | {"p": self.basis_size, "d": self.kernel_size, "m": self.memory_size}

    def check_like(self, base: FeatureMap) -> None:
        """Raise ValueError where arrays that belong to ``base`` would not fit this map."""
        if self.sizes != base.sizes:
            raise ValueError(f"features: sizes {self.sizes}, the model has {base.sizes}")


# --- The radial kernel with one width per feature, (2.31): for one pair, a column and a Gram matrix.
#
# K(x, x') = exp(-sum_j (x_j - x'_j)² / sigma_j²). Features are dimensionless (normalised), so are the widths. The
# compiled column takes *scaled* features x_j / sigma_j, stored as (d, N) so that its loops run over contiguous
# samples, and has its own exponential, which vectorises where a call into the C library does not.


_LOG2_E = 1.4426950408889634
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
#: Adding 1.5 * 2^52 leaves the nearest integer in the low bits of the double.
_ROUND = 6755399441055744.0
#: Below this the result is set to zero: exp(-708) is 3e-308, the smallest normal double is near.
_UNDERFLOW = -708.0
#: Elements of a Gram matrix per block: 256 KiB, and as much scratch.
_GRAM_BLOCK = 32768


def as_widths(widths: object, dimension: int) -> FloatArray:
    """One width for all features or one each, as (d,) float64.

    Raises
    ------
    InputError : wrong length, or a width that is not positive and finite.
    """
    given = np.asarray(widths, dtype=np.float64)
    if given.ndim == 0:
        given = np.full(dimension, float(given))
    if given.shape != (dimension,) or not np.all(np.isfinite(given)) or not np.all(given > 0):
        raise InputError(
            f"widths: got {widths!r}, expected one positive number or {dimension} of them, one per feature; "
            "give the kernel width sigma of each normalised feature"
        )
    return given.copy()


def column(X: FloatArray, x: FloatArray, widths: FloatArray) -> FloatArray:
    """K of every row of ``X`` (N, d) with ``x`` (d,): (N,)."""
    return np.asarray(np.exp(-np.sum(((X - x) / widths) ** 2, axis=1)), dtype=np.float64)


def gram(X: FloatArray, other: FloatArray | None, widths: FloatArray) -> FloatArray:
    """K of every row of ``X`` (N, d) with every row of ``other`` (M, d), or of ``X`` itself: (N, M).

    Distances are summed feature by feature, not expanded into scalar products: near-duplicates would lose
    all their digits to cancellation there.
    """
    right = X if other is None else other
    count, columns = right.shape[0], np.ascontiguousarray(right.T)
    K = np.empty((X.shape[0], count))
    # In blocks of rows with one scratch: they stay in the cache.
    block = max(1, _GRAM_BLOCK // max(count, 1))
    scratch = np.empty((min(block, X.shape[0]), count))
    for start in range(0, X.shape[0], block):
        squared = K[start : start + block]
        part = scratch[: squared.shape[0]]
        squared[...] = 0.0
        for j in range(X.shape[1]):
            np.subtract(X[start : start + block, j, None], columns[j], out=part)
            part /= widths[j]
            part *= part
            squared += part
        np.negative(squared, out=squared)
        np.exp(squared, out=squared)
    return K


@compiled_contracting
def exp_negative(t: FloatArray, bits: FloatArray) -> None:
    """exp(t) in place for t <= 0, to 2 units in the last place; below -708 exactly 0. ``bits`` (N,) is scratch.

    Reduction by multiples of ln 2 and a Taylor polynomial of degree 12 on [-ln2/2, ln2/2]; every line is a
    loop without branches or calls, so that the compiler vectorises it. NaN stays NaN.
    """
    n = t.shape[0]
    integers = bits.view(np.int64)
    for j in range(n):
        bits[j] = max(t[j], _UNDERFLOW) * _LOG2_E + _ROUND
    for j in range(n):
        k = bits[j] - _ROUND
        integers[j] = (integers[j] + 1023) << 52
        r = (max(t[j], _UNDERFLOW) - k * _LN2_HIGH) - k * _LN2_LOW
        s = 2.08767569878681e-09
        s = s * r + 2.505210838544172e-08
        s = s * r + 2.755731922398589e-07
        s = s * r + 2.7557319223985893e-06
        s = s * r + 2.48015873015873e-05
        s = s * r + 1.984126984126984e-04
        s = s * r + 1.3888888888888889e-03
        s = s * r + 8.333333333333333e-03
        s = s * r + 4.1666666666666664e-02
        s = s * r + 1.6666666666666666e-01
        s = s * r + 0.5
        value = (r * r) * s + r + 1.0
        value = value * bits[j]
        if t[j] < _UNDERFLOW:
            value = 0.0
        if t[j] != t[j]:
            value = t[j]
        t[j] = value


def _rbf_column(scaled: FloatArray, count: int, x_scaled: FloatArray, out: FloatArray, bits: FloatArray) -> None:
    apart = scaled[:, :count] - x_scaled[:, None]
    np.exp(-np.einsum("dn,dn->n", apart, apart), out=out[:count])


@in_numpy(_rbf_column)
@compiled_contracting
def rbf_column(scaled: FloatArray, count: int, x_scaled: FloatArray, out: FloatArray, bits: FloatArray) -> None:
    """K of the first ``count`` samples with one point into ``out[:count]``.

    ``scaled`` (d, N) and ``x_scaled`` (d,) are features divided by their widths; ``bits`` (N,) is scratch.
    """
    target = out[:count]
    i = scaled.shape[0] % 2
    if i == 1:
        row, xi = scaled[0], x_scaled[0]
        for j in range(count):
            difference = row[j] - xi
            target[j] = -(difference * difference)
    else:
        for j in range(count):
            target[j] = 0.0
    # Two features at a time: one more pass over the samples costs as much as the arithmetic.
    while i < scaled.shape[0]:
        row, other, xi, yi = scaled[i], scaled[i + 1], x_scaled[i], x_scaled[i + 1]
        for j in range(count):
            difference, second = row[j] - xi, other[j] - yi
            target[j] -= difference * difference + second * second
        i += 2
    exp_negative(target, bits[:count])


def _weigh(k: FloatArray, alpha: FloatArray) -> tuple[float, float]:
    return float(alpha @ k), float(max(k.max(initial=0.0), 0.0))


@in_numpy(_weigh)
@compiled_reassociating
def weigh(k: FloatArray, alpha: FloatArray) -> tuple[float, float]:
    """(sum of alpha k, largest k) of a kernel column (N,); 0 and 0 where it is empty."""
    n = k.shape[0]
    total = 0.0
    for j in range(n):
        total += alpha[j] * k[j]
    # Four maxima side by side: a single one would be a chain of dependent operations.
    m0, m1, m2, m3 = 0.0, 0.0, 0.0, 0.0
    for j in range(n // 4):
        m0 = max(m0, k[4 * j])
        m1 = max(m1, k[4 * j + 1])
        m2 = max(m2, k[4 * j + 2])
        m3 = max(m3, k[4 * j + 3])
    for j in range(n - n % 4, n):
        m0 = max(m0, k[j])
    return total, max(max(m0, m1), max(m2, m3))
