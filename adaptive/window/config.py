"""Configuration of a window: `WindowConfig` is all of it, `SolverConfig` the part that a learner's settings choose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from adaptive import kernels, lssvm
from adaptive.errors import InputError
from adaptive.window import arrays as ws

Form = Literal["inverse", "cholesky", "auto"]


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """How the window is solved: ``form`` and ``accuracy`` as of `WindowConfig`. Raises InputError on other values."""

    form: Form = "auto"
    accuracy: float = 1e-8

    def __post_init__(self) -> None:
        if self.form not in ("inverse", "cholesky", "auto"):
            raise InputError(f"form: got {self.form!r}, expected 'inverse', 'cholesky' or 'auto'")
        if not self.accuracy > 0:
            raise InputError(f"accuracy: got {self.accuracy!r}, expected a positive number, 1e-8 say")


_SOLVER: Final = SolverConfig()


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Configuration of a window. Features and targets are normalised (dimensionless, of order 1).

    Attributes
    ----------
    capacity : N, the number of slots.
    widths : kernel width of each of the d features, (2.31).
    gamma : regularisation, > 0; the noise variance of sample i is 1/(gamma w_i) of the kernel's.
    form : ``inverse`` is the fastest, its error grows with cond(R)²; ``cholesky`` takes about twice the time, its
        error grows with cond(R); ``auto`` takes the one that ``accuracy`` and the condition of the samples require,
        each time the window is made from samples or healed. An empty window starts as ``inverse``.
    accuracy : relative error of alpha to be kept. A step whose checked row shows more than a quarter of it (other
        rows may be worse) is followed by a step of refinement, which takes some six products. Infinite: never.

    Raises InputError on values out of range.
    """

    capacity: int
    widths: tuple[float, ...]
    gamma: float
    form: Form = _SOLVER.form
    accuracy: float = _SOLVER.accuracy

    def __post_init__(self) -> None:
        if self.capacity < 1:
            raise InputError(f"capacity: got {self.capacity}, expected the number of samples to keep, at least 1")
        if len(self.widths) < 1:
            raise InputError("widths: got none, expected one kernel width a feature")
        object.__setattr__(self, "widths", tuple(map(float, kernels.as_widths(self.widths, len(self.widths)))))
        object.__setattr__(self, "gamma", lssvm.check_gamma(self.gamma))
        if not ws.LEAST_PRECISION <= self.gamma <= ws.MOST_PRECISION:
            raise InputError(
                f"gamma: got {self.gamma!r}, expected {ws.LEAST_PRECISION:g} to {ws.MOST_PRECISION:g}: outside, double "
                "precision cannot tell a sample's noise from the kernel"
            )
        SolverConfig(self.form, self.accuracy)  # Raises on wrong values.

    @property
    def dimension(self) -> int:
        """Number of features d."""
        return len(self.widths)
