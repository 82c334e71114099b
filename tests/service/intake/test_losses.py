"""Samples that come and are lost have a name within two seconds; what is usual has none."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.health import (
    SAMPLES_DROPPED,
    SAMPLES_LOST,
    SAMPLES_MALFORMED,
    SAMPLES_OUT_OF_ORDER,
    TWO_STAGES,
    Arrivals,
    SampleLosses,
)
from tests.service.storage.test_stored_files import make_axis, recording

#: Pause between two looks of the publishing thread, s, and samples in it at 1 kHz.
LOOK_S, EACH = 0.02, 20


def judged(come: Callable[[float], Arrivals], duration_s: float) -> list[tuple[float, str]]:
    """(time, name) of each change, where ``come`` gives the arrivals of the look at a time."""
    losses, total, changes = SampleLosses(), Arrivals(), []
    for k in range(round(duration_s / LOOK_S)):
        t_s = k * LOOK_S
        total = Arrivals(*(a + b for a, b in zip(total, come(t_s), strict=True)))
        if losses.look(100.0 + t_s, total):
            changes.append((t_s, losses.trouble))
    return changes


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        (Arrivals(dropped=EACH), SAMPLES_DROPPED),
        (Arrivals(received=EACH - 6, dropped=6), SAMPLES_DROPPED),
        (Arrivals(received=EACH, refused=EACH), SAMPLES_OUT_OF_ORDER),
        (Arrivals(received=2 * EACH, refused=EACH, foreign=EACH), TWO_STAGES),
        (Arrivals(received=EACH + EACH // 5, refused=EACH // 5, foreign=EACH // 5), TWO_STAGES),
        (Arrivals(malformed=1), SAMPLES_MALFORMED),
        (Arrivals(received=EACH // 2, lost=EACH // 2, malformed=1), SAMPLES_MALFORMED),
        (Arrivals(received=EACH // 2, lost=EACH // 2), SAMPLES_LOST),
        (Arrivals(received=1, lost=EACH - 1), SAMPLES_LOST),
        (Arrivals(received=EACH - EACH // 5, lost=EACH // 5), SAMPLES_LOST),
    ],
)
def test_each_way_of_losing_samples_has_a_name_within_two_seconds_and_loses_it(bad: Arrivals, name: str) -> None:
    good = Arrivals(received=EACH)
    changes = judged(lambda t_s: bad if 3.0 <= t_s < 8.0 else good, 12.0)
    assert [changed for _, changed in changes] == [name, ""]
    assert 3.0 < changes[0][0] <= 5.0
    assert 8.0 < changes[1][0] <= 10.0


@pytest.mark.parametrize(
    "usual",
    [
        Arrivals(received=EACH),
        Arrivals(received=2 * EACH, refused=EACH),  # every message twice
        Arrivals(received=EACH, dropped=1),
        Arrivals(),
        Arrivals(received=EACH, malformed=5),
    ],
)
def test_what_is_usual_has_no_name(usual: Arrivals) -> None:
    assert judged(lambda _: usual, 10.0) == []


@pytest.mark.parametrize("outage_s", [0.1, 0.4, 3.0])
def test_an_outage_that_is_over_has_no_name(outage_s: float) -> None:
    """The numbers of the time without samples are missing all at once when they come again."""

    def come(t_s: float) -> Arrivals:
        if 3.0 <= t_s < 3.0 + outage_s:
            return Arrivals()
        back = 0.0 <= t_s - 3.0 - outage_s < 0.5 * EACH * 1e-3
        return Arrivals(received=EACH, lost=round(outage_s * 1e3) if back else 0)

    assert judged(come, 9.0) == []


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(0.0, 3.0, allow_nan=False), st.integers(0, 60), st.booleans()), min_size=1, max_size=30
    )
)
def test_samples_that_all_arrive_never_have_a_name_however_they_are_bunched(
    looks: list[tuple[float, int, bool]],
) -> None:
    """``looks``: pause before each look, samples since the one before it, and whether they come twice."""
    axis, losses = make_axis(), SampleLosses()
    now_s, first = 100.0, 0
    for pause_s, n, twice in looks:
        now_s += pause_s
        if n:
            batch = recording(first, n)
            for _ in range(1 + twice):
                axis.handle(batch)
            first += n
        counts = axis.counts
        lost = axis.sequence.lost
        losses.look(now_s, Arrivals(counts.samples["received"], counts.refused, counts.foreign, lost=lost))
        assert losses.trouble == ""


def test_a_stage_that_restarts_its_count_has_no_name() -> None:
    restart = Arrivals(received=EACH, refused=EACH, foreign=EACH)
    assert judged(lambda t_s: restart if 3.0 <= t_s < 3.2 else Arrivals(received=EACH), 8.0) == []
    # Also where nothing came for a second before.
    quiet = {True: Arrivals(), False: Arrivals(received=EACH)}
    assert judged(lambda t_s: restart if 4.0 <= t_s < 4.2 else quiet[2.0 <= t_s < 4.0], 8.0) == []


def test_two_stages_with_the_same_numbers_on_one_key_are_told() -> None:
    axis, losses = make_axis(), SampleLosses()
    told = ""
    for first in range(0, 3000, EACH):
        one = recording(first, EACH)
        axis.handle(one)
        if first >= 1000:
            axis.handle(SampleBatch(one.seq, one.t_s, one.u_V, one.y_um[::-1] + 3.0))
        told = arrived(axis, losses, first) or told
        assert (told == "") or first > 1000
    assert told == TWO_STAGES
    assert "two stages send on one key" in losses.why


def arrived(axis: Axis, losses: SampleLosses, tick: int) -> str:
    counts = axis.counts
    losses.look(tick * 1e-3, Arrivals(counts.samples["received"], counts.refused, counts.foreign))
    return losses.trouble
