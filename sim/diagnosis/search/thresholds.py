"""What is asked of a cause before it is named."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rules:
    """What is asked of a cause before it is named. The values are those with which `docs/diagnosis.md` was scored."""

    #: Chance level of the null distribution, after correction for the number of candidates.
    level: float = 0.01
    #: Least share of the held-out squared error that a cause must remove.
    least_gain: float = 0.02
    #: The same, as a share of the noise floor's square: less is a quarter of the noise and no matter.
    least_of_floor: float = 0.08
    #: Least share of what stands above the noise floor that the first, and a further, cause must remove.
    least_excess_first: float = 0.1
    least_excess_next: float = 0.25
    #: A further cause that removes so much of it is accepted whatever the forms before it may have left behind.
    nearly_all: float = 0.85
    #: Cost of a number, as a share of the squared error: of two causes that do as well, the simpler.
    cost_per_number: float = 0.002
    #: How many of the linearised guesses are fitted in full.
    refits: int = 6
    most_causes: int = 5
    #: A substitute within this share of the gain, or within this many standard errors, is an alternative.
    close_share: float = 0.02
    close_sigmas: float = 2.5
