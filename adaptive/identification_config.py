"""What an identification is asked for."""

from __future__ import annotations

from dataclasses import dataclass

from adaptive.errors import InputError


@dataclass(frozen=True, slots=True)
class IdentifyConfig:
    """n: support vectors. plays, slow: number of play operators and of slow states (0.1 s and up, log-spaced).

    kernel_plays : how many plays the kernel sees. heldout : share of the recording, its end, that is kept for judging.
    cutoff_hz : of the smoother. tune : whether gamma and widths come from the evidence; else ``gamma``, ``width``.
    """

    n: int = 500
    plays: int = 24
    slow: int = 6
    slow_max_s: float = 100.0
    arcs: tuple[float, ...] = (0.05, 0.15, 0.45)
    asymmetric: bool = True
    kernel_plays: int = 3
    heldout: float = 0.25
    cutoff_hz: float = 80.0
    tune: bool = True
    gamma: float = 1e2
    width: float = 4.0

    def __post_init__(self) -> None:
        if self.n < 10:
            raise InputError(f"n: got {self.n}, expected at least 10 support vectors")
        if not 0.0 < self.heldout < 0.9:
            raise InputError(f"heldout: got {self.heldout}, expected a share between 0 and 0.9")
        if not 0 <= self.kernel_plays <= self.plays:
            raise InputError(f"kernel_plays: got {self.kernel_plays}, expected 0 to {self.plays}")
