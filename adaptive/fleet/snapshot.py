"""The served models of all axes, immutable, and their evaluation at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from adaptive.errors import InputError
from adaptive.fleet.in_torch import column_of
from adaptive.fleet.motion import advance, inputs
from adaptive.fleet.state import AxisConstants, BatchState
from adaptive.inverse_model import DOMAIN_MARGIN, LssvmInverse
from adaptive.online.learner import Learner
from adaptive.types import BoolArray, FloatArray, IntArray


class Answers(NamedTuple):
    """Voltages of B axes at n points each: ``u_V``, ``std_V``, ``inside`` (B, n) and ``memory`` (B, m), as of
    `adaptive.types.Feedforward`."""

    u_V: FloatArray
    std_V: FloatArray
    inside: BoolArray
    memory: FloatArray


class Samples(Protocol):
    """What holds the windows."""

    def samples(self) -> tuple[Tensor, ...]:
        """(B, d, N) scaled inputs, (B, N) dual weights, (B,) bias, counts, (B, d) inverse widths and (B,) gamma."""
        ...


@dataclass(frozen=True)
class FleetSnapshot:
    """B models. seq (B,) : last sample that each has seen. valid (B,) : whether its learner vouches for it.

    fallback (B,) : whether the identified model is served. gain, offset_um (B,) : frames.
    """

    constants: AxisConstants
    seq: IntArray
    valid: BoolArray
    fallback: BoolArray
    gain: Tensor
    offset_um: Tensor
    beta: Tensor
    scaled: Tensor
    alpha: Tensor
    inverse_widths: Tensor
    gamma: Tensor
    noise_V2: Tensor
    kernel_V2: Tensor
    domain: Tensor
    bounded: Tensor
    #: (p, p) covariance of the linear part, V², by axis: of the identified models that are served.
    covariances: dict[int, Tensor] = field(default_factory=dict)

    @property
    def memory_size(self) -> int:
        """m."""
        return self.constants.sizes["m"]

    def rest_memory(self) -> FloatArray:
        """(B, m) memory of stages that have always been at rest."""
        return np.array([base.rest_memory(base.features.y_rest_um) for base in self.constants.bases])

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Answers:
        """Voltages at (B, n) points, one sample time apart. Raises InputError on shapes that do not fit together."""
        c = self.constants
        B, device = c.axes, self.beta.device
        given = [np.asarray(part, dtype=np.float64) for part in (y_um, v_um_per_s, a_um_per_s2)]
        shapes = [part.shape for part in given]
        if len(shapes[0]) != 2 or shapes[0][0] != B or len(set(shapes)) != 1:
            raise InputError(f"y_um, v_um_per_s, a_um_per_s2: got shapes {shapes}, expected three of equal ({B}, n)")
        if np.shape(memory) != (B, self.memory_size):
            raise InputError(f"memory: got shape {np.shape(memory)}, expected ({B}, {self.memory_size})")
        motion = torch.as_tensor(np.stack(given, 2)).to(device)
        kept = torch.as_tensor(np.array(memory, dtype=np.float64)).to(device)
        axes = torch.arange(B, device=device)
        shrink = 1.0 / (1.0 + 1.0 / self.gamma)
        low, high = self.domain[:, ::2], self.domain[:, 1::2]
        margin = DOMAIN_MARGIN * (high - low)
        out: list[tuple[Tensor, Tensor, Tensor]] = []
        for k in range(motion.shape[1]):
            now = motion[:, k]
            kept = advance(c, now[:, 0], kept, self.gain, self.offset_um)
            basis, kernel = inputs(c, axes, now, kept, self.gain, self.offset_um)
            column = column_of(self.scaled, kernel * self.inverse_widths)
            mean = (self.beta * basis).sum(1) + (self.alpha * column).sum(1)
            known = (c.beta * basis).sum(1)
            held = torch.minimum(torch.maximum(mean, known - c.allowed_V), known + c.allowed_V)
            nearest = column.amax(1)
            variance = self.noise_V2 + self.kernel_V2 * (1.0 - shrink * nearest * nearest)
            for axis, covariance in self.covariances.items():
                variance[axis] += basis[axis] @ covariance @ basis[axis]
            within = ((now >= low - margin) & (now <= high + margin)).all(1)
            out.append((torch.where(self.bounded, held, mean), variance.clamp(min=0.0).sqrt(), within))
        u, std, inside = (torch.stack(part, 1).cpu().numpy() for part in zip(*out, strict=True))
        return Answers(u, std, inside, kept.cpu().numpy())

    def linear(self) -> FloatArray:
        """(B, 2 + p) gain and offset (µm) of each axis' frame, and its linear part, V. A copy."""
        parts = (self.gain[:, None], self.offset_um[:, None], self.beta)
        return np.asarray(torch.cat(parts, 1).cpu().numpy(), dtype=np.float64)

    def model(self, axis: int) -> dict[str, FloatArray]:
        """The arrays of one axis' model, by name: what those that follow it need."""
        names = ("beta", "scaled", "alpha", "inverse_widths", "domain")
        return {name: self._row(name, axis) for name in names}

    def _row(self, name: str, axis: int) -> FloatArray:
        rows: Tensor = {"beta": self.beta, "scaled": self.scaled, "alpha": self.alpha, "domain": self.domain,
                        "inverse_widths": self.inverse_widths}[name]  # fmt: skip
        return np.asarray(rows[axis].cpu().numpy(), dtype=np.float64)


def snapshot_of(c: AxisConstants, s: BatchState, matrices: Samples, apart: Mapping[int, Learner]) -> FleetSnapshot:
    """Copies of what is served now."""
    scaled, alpha, bias, counts, inverse_widths, gamma = matrices.samples()
    width = max(scaled.shape[2], c.model_scaled.shape[2])
    device = scaled.device
    unused = torch.arange(scaled.shape[2], device=device) >= counts[:, None]
    wide = torch.full((c.axes, c.sizes["d"], width), 1e9, dtype=torch.float64, device=device)
    weights = torch.zeros((c.axes, width), dtype=torch.float64, device=device)
    wide[:, :, : scaled.shape[2]] = torch.where(unused[:, None], 1e9, scaled)
    weights[:, : scaled.shape[2]] = torch.where(unused, 0.0, alpha)
    beta = s["filter.beta"].clone()
    beta[:, 0] += bias
    long, short = s["judgement.long_V2"], s["judgement.short_V2"]
    noise = torch.maximum(long, short) + s["judgement.doubt_V2"]
    fallback = s["judgement.fallback"].clone()
    made = FleetSnapshot(
        c, s["front.gates.seq"].cpu().numpy().copy(), s["judgement.valid"].cpu().numpy().copy(),
        fallback.cpu().numpy().copy(), s["front.track.served.gain"].clone(), s["front.track.served.offset_um"].clone(),
        beta, wide, weights, inverse_widths.clone(), gamma.clone(), noise, s["window.kernel_variance"].clone(),
        s["domain"].clone(), (c.allowed_V > 0.0) & ~fallback,
    )  # fmt: skip
    for axis in fallback.nonzero()[:, 0].tolist():
        if axis not in apart:
            made.noise_V2[axis] = s["judgement.frozen_short_V2"][axis]
            _fill(made, axis, c.bases[axis], keep_noise=True)
    for axis, learner in apart.items():
        model = learner.snapshot()
        made.seq[axis], made.valid[axis], made.fallback[axis] = model.seq, model.valid, not model.anchor.size
        made.bounded[axis] = bool(model.anchor.size)
        _fill(made, axis, model)
    return made


def _fill(made: FleetSnapshot, axis: int, model: LssvmInverse, keep_noise: bool = False) -> None:
    """Write a single model into its row."""
    n = model.alpha.size
    made.scaled[axis] = 1e9
    made.alpha[axis] = 0.0
    made.scaled[axis, :, :n] = torch.as_tensor((model.support / model.widths).T.copy())
    made.alpha[axis, :n] = torch.as_tensor(model.alpha.copy())
    made.beta[axis], made.domain[axis] = torch.as_tensor(model.beta.copy()), torch.as_tensor(model.domain.copy())
    made.inverse_widths[axis] = torch.as_tensor(1.0 / model.widths)
    made.gamma[axis], made.kernel_V2[axis] = model.gamma, model.kernel_variance
    made.gain[axis], made.offset_um[axis] = model.features.gain, model.features.offset_um
    if model.beta_covariance.size:
        made.covariances[axis] = torch.as_tensor(model.beta_covariance.copy()).to(made.beta.device)
    if not keep_noise:
        made.noise_V2[axis] = model.noise_variance
