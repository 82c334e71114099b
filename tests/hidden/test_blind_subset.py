"""A few of the blind cases (`make blind` runs them all): what is hidden is named, what is healthy is left alone."""

from __future__ import annotations

import pytest

from tests.hidden.blind import judge, run_case
from tests.hidden.cases import healthy, pair, single


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("single", 8), ("single", 10), ("healthy", 8), ("healthy", 11)])
def test_the_truth_is_found(kind: str, seed: int) -> None:
    outcome = run_case(kind, seed)
    assert outcome.right, outcome
    # The truth is in the library here: what is left is noise.
    assert outcome.over_floor < 1.5


def test_a_wrong_name_is_not_taken_for_right() -> None:
    assert judge("single", single(8), "effects", (("saturation",),))
    assert not judge("single", single(8), "effects", (("creep",),))
    assert not judge("healthy", healthy(1), "effects", (("creep",),))
    one, two = pair(1).effects
    assert not judge("pair", pair(1), "effects", ((one,),))
    assert judge("pair", pair(1), "effects", ((two,), (one,)))
