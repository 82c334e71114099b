"""Learner and correction on one foreign stage: they do not work against each other."""

from __future__ import annotations

import pytest

from benchmarks.correction import course_of, figures, follow


@pytest.mark.slow
def test_the_model_takes_over_what_the_correction_carries_and_both_are_better_than_either() -> None:
    """A stage of plays that rings, readings one sample old, and a gain that changes by 6 % at 4 s."""
    course = course_of(3)
    alone, both, rival = (figures(course, follow(course, way, 1, "gain")) for way in ("alone", "corrected", "frozen+I"))
    assert both["before"] <= alone["before"]
    assert both["after"] <= alone["after"]
    assert both["before"] <= 0.9 * rival["before"]
    assert both["after"] <= 0.8 * rival["after"]
    assert both["carried"] <= 0.06 * rival["carried"]
    assert both["carried_after"] <= 0.004 * rival["carried_after"]
    assert both["trouble"] == ""
    assert both["large_s"] <= alone["large_s"] + 0.01
