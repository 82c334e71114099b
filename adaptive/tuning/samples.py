"""What is taken out of the learner's window to tune it elsewhere, and what comes back: samples, hyper-parameters."""

from __future__ import annotations

from dataclasses import dataclass

from adaptive.types import FloatArray


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """gamma : regularisation, positive. widths : (d,) kernel widths, one an input, dimensionless, positive."""

    gamma: float
    widths: tuple[float, ...]


@dataclass(frozen=True)
class WindowData:
    """A copy of what the window holds, for tuning it elsewhere.

    Attributes
    ----------
    kernel : (n, d) kernel inputs, dimensionless. targets_V : (n,) voltage less the linear part, V.
    weights : (n,) noise weights. age : (n,) steps of the window since each sample came, 0 for the newest.
    hyper : what the window works with.
    """

    kernel: FloatArray
    targets_V: FloatArray
    weights: FloatArray
    age: FloatArray
    hyper: Hyperparameters
