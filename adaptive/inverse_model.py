"""The served inverse LSSVM: an immutable model, evaluated over a whole trajectory by one compiled loop.

    u = beta' basis(x) + sum_i alpha_i K(x, x_i)

with basis and kernel inputs from a ``FeatureMap``. The linear part carries the model on where the kernel has no
samples. The standard deviation comes from the nearest sample alone: given one sample of covariance k to the point, a
Gaussian process of unit variance has the variance 1 - k²/(1 + 1/gamma), an upper bound of that given all samples, at no
cost beyond the mean. The learner calibrates its scale on its own prediction errors.
"""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass, field, replace
from typing import Annotated

import numpy as np

from dehyst.adaptive.compiled import all_finite, compiled, compiled_reassociating, dot, in_numpy
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureArrays, FeatureMap, advance, fill, rbf_column, weigh
from dehyst.adaptive.state import Entry, Kinded, load, save
from dehyst.adaptive.types import BoolArray, Feedforward, FloatArray, IntArray, StateDict

# --- The compiled loops: voltages and standard deviations of a trajectory, and its memory.


def _spread(covariance: FloatArray, basis: FloatArray) -> float:
    return float(basis @ covariance @ basis) if covariance.size else 0.0


@in_numpy(_spread)
@compiled_reassociating
def spread(covariance: FloatArray, basis: FloatArray) -> float:  # pragma: no cover - compiled
    """basis' covariance basis, V², (p, p) and (p,); 0 for a covariance of no size. Half of a point's time, in order."""
    p, total, j = covariance.shape[0], 0.0, 0
    # Four rows at a time: the end of each sum costs as much as a row.
    while j + 3 < p:
        r0, r1, r2, r3 = covariance[j], covariance[j + 1], covariance[j + 2], covariance[j + 3]
        b0, b1, b2, b3 = basis[j], basis[j + 1], basis[j + 2], basis[j + 3]
        for i in range(p):
            total += (r0[i] * b0 + r1[i] * b1 + r2[i] * b2 + r3[i] * b3) * basis[i]
        j += 4
    while j < p:
        row, bj = covariance[j], basis[j]
        for i in range(p):
            total += row[i] * bj * basis[i]
        j += 1
    return total


@compiled
def unpacked(
    constants: FloatArray, counts: IntArray
) -> tuple[FeatureArrays, FloatArray, FloatArray, FloatArray, FloatArray, int]:  # pragma: no cover - compiled
    """(feature map, beta (p,), 1/widths (d,), alpha (n,), scaled support (d, n), place of what follows); views."""
    K, A, M, p, d, n = counts[0], counts[1], counts[2], counts[3], counts[4], counts[5]
    at = 17
    thresholds = constants[at : at + K]
    at += K
    arcs = constants[at : at + A]
    at += A
    retain = constants[at : at + M]
    at += M
    beta = constants[at : at + p]
    at += p
    inverse_widths = constants[at : at + d]
    at += d
    alpha = constants[at : at + n]
    at += n
    scaled = constants[at : at + d * n].reshape(d, n)
    at += d * n
    m = FeatureArrays(thresholds, arcs, retain, constants[13:17], counts[10:], counts[7:9], constants[0:3])
    return m, beta, inverse_widths, alpha, scaled, at


@compiled
def evaluate_packed(
    y: FloatArray, v: FloatArray, a: FloatArray, memory: FloatArray, constants: FloatArray, counts: IntArray,
    u: FloatArray, std: FloatArray, inside: BoolArray,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Voltages, deviations and domain flags of n points; ``memory`` advances in place.

    The whole model is in two arrays, as `LssvmInverse` packs it: to hand over twenty costs more than to evaluate a
    point. Its anchor (p,) or (0,) is the linear part from which the voltage may differ by at most ``allowed``, V.
    """
    m, beta, inverse_widths, alpha, scaled, at = unpacked(constants, counts)
    c, p, d, count = counts[6], beta.shape[0], scaled.shape[0], scaled.shape[1]
    covariance = constants[at : at + c * c].reshape(c, c)
    at += c * c
    anchor = constants[at : at + counts[9] * p]
    noise_variance, kernel_variance, shrink, allowed = constants[3], constants[4], constants[5], constants[6]
    domain = constants[7:13]
    basis, x, k, bits = np.empty(p), np.empty(d), np.empty(count), np.empty(count)
    for i in range(y.shape[0]):
        advance(y[i], memory, m)
        fill(y[i], v[i], a[i], memory, m, basis, x)
        mean = dot(beta, basis, p)
        variance = noise_variance + spread(covariance, basis)
        nearest = 0.0
        if count > 0:
            for j in range(d):
                x[j] *= inverse_widths[j]
            rbf_column(scaled, count, x, k, bits)
            kernel_part, nearest = weigh(k, alpha)
            mean += kernel_part
        if anchor.shape[0] > 0:
            known = dot(anchor, basis, p)
            mean = min(max(mean, known - allowed), known + allowed)
        u[i] = mean
        std[i] = np.sqrt(max(variance + kernel_variance * (1.0 - shrink * nearest * nearest), 0.0))
        inside[i] = domain[0] <= y[i] <= domain[1] and domain[2] <= v[i] <= domain[3] and domain[4] <= a[i] <= domain[5]


@compiled
def voltage_of(
    y: float,
    v: float,
    a: float,
    memory: FloatArray,
    scratch: FloatArray,
    m: FeatureArrays,
    beta: FloatArray,
    scaled: FloatArray,
    alpha: FloatArray,
    inverse_widths: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Voltage at a trial point after ``memory`` (m,), which stays; ``scratch`` (m,) is written to."""
    scratch[:] = memory
    advance(y, scratch, m)
    basis, kernel = np.empty(beta.shape[0]), np.empty(inverse_widths.shape[0])
    fill(y, v, a, scratch, m, basis, kernel)
    return mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)


@compiled
def evaluate_point(
    y: float, v: float, a: float, memory: FloatArray, constants: FloatArray, counts: IntArray
) -> tuple[float, float, bool]:  # pragma: no cover - compiled
    """`evaluate_packed` of one point with plain numbers: an array costs as much to hand over as five of them."""
    five, inside = np.empty(5), np.empty(1, dtype=np.bool_)
    five[0], five[1], five[2] = y, v, a
    evaluate_packed(five[0:1], five[1:2], five[2:3], memory, constants, counts, five[3:4], five[4:5], inside)
    return five[3], five[4], inside[0]


@compiled
def track_memory(y: FloatArray, memory: FloatArray, m: FeatureArrays) -> None:  # pragma: no cover - compiled
    """Advance ``memory`` (m,) in place by (n,) measured displacements."""
    for i in range(y.shape[0]):
        advance(y[i], memory, m)


@compiled
def mean_of(
    basis: FloatArray,
    kernel: FloatArray,
    beta: FloatArray,
    scaled: FloatArray,
    alpha: FloatArray,
    inverse_widths: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Mean at one point whose inputs are known."""
    count = alpha.shape[0]
    mean = dot(beta, basis, beta.shape[0])
    if count > 0:
        k = np.empty(count)
        rbf_column(scaled, count, kernel * inverse_widths, k, np.empty(count))
        for j in range(count):
            mean += alpha[j] * k[j]
    return mean


#: Share of the learnt range by which a point may lie outside and still count as inside.
DOMAIN_MARGIN = 0.05
_OUTWARDS = np.array([-1.0, 1.0] * 3)


def _with_margins(domain: FloatArray) -> FloatArray:
    """(6,) bounds inside which a point of a model with ``domain`` (6,) counts as inside."""
    spans = np.repeat(domain[1::2] - domain[::2], 2) * DOMAIN_MARGIN
    bounds: FloatArray = domain + spans * _OUTWARDS
    return bounds


@dataclass(frozen=True)
class LssvmInverse(Kinded):
    """Immutable inverse LSSVM; implements ``adaptive.types.InverseModel``.

    ``anchor`` and ``allowed_V``: whatever was learnt, no answer is further from the identified model.
    """

    KIND = "lssvm"

    name: Annotated[str, Entry("by which it is served", most=1000)]
    features: Annotated[FeatureMap, Entry("map from motion to inputs; its sample time is the model's")]
    beta: Annotated[FloatArray, Entry("linear part, per normalised input", "V", "p")]
    support: Annotated[FloatArray, Entry("kernel inputs of the samples", "", "samples,d")]
    alpha: Annotated[FloatArray, Entry("their weights", "V", "samples")]
    widths: Annotated[FloatArray, Entry("kernel widths", "", "d")]
    gamma: Annotated[float, Entry("regularisation")]
    domain: Annotated[FloatArray, Entry("learnt range [y0, y1, v0, v1, a0, a1]", "µm, µm/s, µm/s²", "6")]
    noise_variance: Annotated[float, Entry("of one prediction at a sample", "V²")] = 0.0
    kernel_variance: Annotated[float, Entry("of the kernel part away from samples", "V²")] = 0.0
    beta_covariance: Annotated[FloatArray, Entry("of the linear part, empty where unknown", "V²", "p,p|0,0")] = field(
        default_factory=lambda: np.empty((0, 0))
    )
    span_V: Annotated[float, Entry("voltage range of the recording it was identified from", "V")] = 1.0
    seq: Annotated[int, Entry("the last sample that it has seen", low=-1)] = -1
    valid: Annotated[bool, Entry("whether the learner declares it valid")] = True
    anchor: Annotated[FloatArray, Entry("linear part of the identified model, or empty", "V", "p|0")] = field(
        default_factory=lambda: np.empty(0)
    )
    allowed_V: Annotated[float, Entry("largest difference from the identified linear part, 0 for any", "V")] = 0.0
    #: A model from which only frame, linear part, domain and noise differ: the rest is shared with it unchecked.
    like: InitVar[LssvmInverse | None] = None
    _scaled: FloatArray = field(init=False, repr=False, compare=False)
    _inverse_widths: FloatArray = field(init=False, repr=False, compare=False)
    #: All that `evaluate_packed` needs.
    _constants: FloatArray = field(init=False, repr=False, compare=False)
    _counts: IntArray = field(init=False, repr=False, compare=False)

    def __post_init__(self, like: LssvmInverse | None) -> None:
        if like is not None:
            for shared, value in self._shared_with(like).items():
                object.__setattr__(self, shared, value)
            return
        p, d, n = self.features.basis_size, self.features.kernel_size, self.support.shape[0]
        shapes: dict[str, tuple[tuple[int, ...], ...]] = {
            "beta": ((p,),), "support": ((n, d),), "alpha": ((n,),), "widths": ((d,),), "domain": ((6,),),
            "anchor": ((p,), (0,)), "beta_covariance": ((p, p), (0, 0)),
        }  # fmt: skip
        for name, allowed in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape not in allowed or not np.all(np.isfinite(value)):
                expected = " or ".join(map(str, allowed))
                raise InputError(f"{name}: got shape {value.shape}, expected {expected} finite numbers")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        # What is stated as a deviation is the root of these.
        positive = ("gamma", "span_V")
        for name in (*positive, "noise_variance", "kernel_variance", "allowed_V"):
            number = float(getattr(self, name))
            if not math.isfinite(number) or number < 0.0 or (number == 0.0 and name in positive):
                expected = "above" if name in positive else "of at least"
                raise InputError(f"{name}: got {number}, expected a finite number {expected} 0")
        scaled = np.ascontiguousarray((self.support / self.widths).T)
        scaled.flags.writeable = False
        object.__setattr__(self, "_scaled", scaled)
        object.__setattr__(self, "_inverse_widths", 1.0 / self.widths)
        margins = _with_margins(self.domain)
        m = self.features.arrays
        scalars = (self.noise_variance, self.kernel_variance, 1.0 / (1.0 + 1.0 / self.gamma), self.allowed_V)
        parts = (m.frame, scalars, margins, m.scale, m.thresholds, m.arcs, m.retain, self.beta, 1.0 / self.widths,
                 self.alpha, scaled.ravel(), self.beta_covariance.ravel(), self.anchor)  # fmt: skip
        object.__setattr__(self, "_constants", np.concatenate(parts))
        sizes = [m.thresholds.size, m.arcs.size, m.retain.size, p, d, n, self.beta_covariance.shape[0]]
        object.__setattr__(
            self, "_counts", np.array([*sizes, *m.flags, self.anchor.size > 0, *m.kernel_plays], dtype=np.int64)
        )

    def _shared_with(self, like: LssvmInverse) -> dict[str, FloatArray | IntArray]:
        """What the constructor makes, for a model that shares the kernel part of ``like``. Raises InputError."""
        for name, value, size in (("beta", self.beta, like.beta.size), ("domain", self.domain, 6)):
            if value.shape != (size,) or not all_finite(value):
                raise InputError(f"{name}: got shape {value.shape}, expected ({size},) finite numbers")
        if not (math.isfinite(self.noise_variance) and self.noise_variance >= 0.0):
            raise InputError(f"noise_variance: got {self.noise_variance}, expected a finite number of at least 0")
        m, constants = self.features.arrays, like._constants.copy()
        constants[0:3], constants[3], constants[7:13] = m.frame, self.noise_variance, _with_margins(self.domain)
        at = 17 + m.thresholds.size + m.arcs.size + m.retain.size
        constants[at : at + self.beta.size] = self.beta
        return {
            "_scaled": like._scaled, "_inverse_widths": like._inverse_widths, "_counts": like._counts,
            "_constants": constants,
        }  # fmt: skip

    @property
    def dt_s(self) -> float:
        return self.features.dt_s

    @property
    def memory_size(self) -> int:
        return self.features.memory_size

    def rest_memory(self, y_um: float) -> FloatArray:
        """(m,) memory, µm, of a stage that has come to rest at ``y_um`` from its rest position."""
        return self.features.rest_memory(y_um)

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """Voltages for (n,) desired points; pure. Raises InputError on shapes that do not fit together."""
        y, v, a = self._points(y_um, v_um_per_s, a_um_per_s2)
        after = self._memory(memory)
        n = y.size
        u, std, inside = np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_)
        evaluate_packed(y, v, a, after, self._constants, self._counts, u, std, inside)
        return Feedforward(u, std, inside, after)

    def moved(
        self, frame: tuple[float, float], beta: FloatArray, domain: FloatArray, noise_variance: float
    ) -> LssvmInverse:
        """The same model with another frame (gain, offset µm), linear part, domain and noise, at little cost.

        The kernel part is shared, so that a follower can make hundreds a second. Raises InputError as the class does.
        """
        return replace(
            self, features=self.features.in_frame(*frame), beta=beta, domain=domain, noise_variance=noise_variance,
            like=self,
        )  # fmt: skip

    @property
    def packed(self) -> tuple[FloatArray, IntArray]:
        """The whole model as two arrays, as `snapshot_loops.evaluate_point` takes it; not to be changed."""
        return self._constants, self._counts

    def evaluate_point(
        self, y_um: float, v_um_per_s: float, a_um_per_s2: float, memory: FloatArray
    ) -> tuple[float, float, bool]:
        """``feedforward`` of one point, (voltage, deviation, inside), without its checks: three floats and no others.

        ``memory`` (m,), contiguous doubles, is advanced in place. For callers that ask point by point.
        """
        u_V, std_V, inside = evaluate_point(y_um, v_um_per_s, a_um_per_s2, memory, self._constants, self._counts)
        return u_V, std_V, inside

    def at_bound(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray, u_V: FloatArray
    ) -> BoolArray:
        """(n,) whether the voltages, (n,) V, that ``feedforward`` gave for (n,) points are held by ``allowed_V``."""
        if not self.anchor.size:
            return np.zeros(u_V.size, dtype=np.bool_)
        basis, _, _ = self.features.run(y_um, v_um_per_s, a_um_per_s2, memory)
        held: BoolArray = np.abs(u_V - basis @ self.anchor) >= (1.0 - 1e-9) * self.allowed_V
        return held

    def track(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, u_V: FloatArray, memory: FloatArray
    ) -> FloatArray:
        """(m,) memory after (n,) measured points. This model's memory is of displacement: the voltage is not used."""
        y, _, _ = self._points(y_um, v_um_per_s, a_um_per_s2)
        after = self._memory(memory)
        track_memory(y, after, self.features.arrays)
        return after

    def carry(self, y_um: FloatArray, u_V: FloatArray, memory: FloatArray) -> None:
        """``track`` in place and without its checks: (n,) contiguous displacements, µm; the voltages are not used."""
        track_memory(y_um, memory, self.features.arrays)

    def _points(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        y = np.ascontiguousarray(y_um, dtype=np.float64)
        v = np.ascontiguousarray(v_um_per_s, dtype=np.float64)
        a = np.ascontiguousarray(a_um_per_s2, dtype=np.float64)
        if y.ndim != 1 or not y.shape == v.shape == a.shape:
            raise InputError(
                f"y_um, v_um_per_s, a_um_per_s2: got shapes {[x.shape for x in (y, v, a)]}, expected three of equal "
                "(n,)"
            )
        return y, v, a

    def _memory(self, memory: FloatArray) -> FloatArray:
        after = np.array(memory, dtype=np.float64)
        if after.shape != (self.memory_size,):
            raise InputError(
                f"memory: got shape {after.shape}, expected ({self.memory_size},);"
                " start from rest_memory() or bring back the memory of the last reply"
            )
        return after

    def state_dict(self) -> StateDict:
        """Flat names to arrays and JSON scalars; ``from_state`` builds an equal model."""
        return save(self)

    @classmethod
    def from_state(cls, state: StateDict) -> LssvmInverse:
        """Inverse of ``state_dict``. Raises ModelFileError on missing or misshapen entries."""
        return load(cls, state)
