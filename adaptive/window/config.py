"""What a window is and how it is solved, checked where it is said.

`WindowConfig` is the whole of it; `SolverConfig` is the part of it that a learner's settings may choose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from adaptive import kernels, lssvm
from adaptive.errors import InputError
from adaptive.window import arrays as ws

Form = Literal["inverse", "cholesky", "auto"]
Backend = Literal["compiled", "plain"]


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """How the window is solved: ``form``, ``backend``, ``accuracy`` as of `WindowConfig`.

    Raises InputError where they are not known, not positive, or do not go together (plain has no Cholesky form).
    """

    form: Form = "auto"
    backend: Backend = "compiled"
    accuracy: float = 1e-8

    def __post_init__(self) -> None:
        if self.form not in ("inverse", "cholesky", "auto"):
            raise InputError(f"form: got {self.form!r}, expected 'inverse', 'cholesky' or 'auto'")
        if self.backend not in ("compiled", "plain"):
            raise InputError(f"backend: got {self.backend!r}, expected 'compiled' or 'plain'")
        if self.backend == "plain" and self.form == "cholesky":
            raise InputError("form: the plain backend has the inverse form only; take backend='compiled'")
        if not self.accuracy > 0:
            raise InputError(f"accuracy: got {self.accuracy!r}, expected a positive number, 1e-8 say")


_SOLVER: Final = SolverConfig()


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """What a window is. Features and targets are normalised (dimensionless, of order 1).

    Attributes
    ----------
    capacity : N, the number of slots.
    widths : kernel width of each of the d features, (2.31).
    gamma : regularisation, > 0; the noise variance of sample i is 1/(gamma w_i) of the kernel's.
    linear : features that enter an unpenalised linear part beside the bias.
    form : ``inverse`` is the fastest, its error grows with cond(R)²; ``cholesky`` takes about twice the time, its
        error grows with cond(R); ``auto`` takes the one that ``accuracy`` and the condition of the samples call
        for, each time the window is made from samples or healed (an empty one starts as ``inverse``).
    backend : ``compiled``, or ``plain`` numpy and scipy (inverse form only).
    accuracy : relative error of alpha to be kept. A step whose checked row shows more than a quarter of it (other
        rows may be worse) is followed by a step of refinement, some six products long. Infinite: never.
    """

    capacity: int
    widths: tuple[float, ...]
    gamma: float
    linear: tuple[int, ...] = ()
    form: Form = _SOLVER.form
    backend: Backend = _SOLVER.backend
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
                f"gamma: got {self.gamma!r}, expected {ws.LEAST_PRECISION:g} to {ws.MOST_PRECISION:g}: beyond, double "
                "precision does not tell a sample's noise from the kernel"
            )
        object.__setattr__(self, "linear", lssvm.check_linear(self.linear, len(self.widths)))
        SolverConfig(self.form, self.backend, self.accuracy)  # which says what it does not take

    @property
    def dimension(self) -> int:
        """Number of features d."""
        return len(self.widths)
