"""The voltage that a sample shows, beside the one that was commanded for it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dehyst.service.intake.command_witness import DIFFERS_FROM, CommandWitness
from dehyst.service.protocol.query import Pending

SPAN_V = 10.0
#: Samples after which a controller that moves the stage is believed.
BELIEVED = 60


def commanded_V(seq: int) -> float:
    return 5.0 + 4.0 * math.sin(0.1 * seq)


def ask(witness: CommandWitness, begin: int, n: int = 5, known: int = 5) -> None:
    """What a controller asks at ``begin``: ``known`` samples are under way, ``n`` are answered."""
    first = begin - known
    u_V = np.array([commanded_V(k) for k in range(first, begin + n)])
    y_um = 10.0 * u_V
    witness.note(Pending(first, y_um[:known], u_V[:known]), y_um[known:], u_V[known:])


def believed(to: int = BELIEVED) -> CommandWitness:
    """A witness that has seen ``to`` right samples."""
    witness = CommandWitness(SPAN_V)
    for seq in range(to):
        if seq % 5 == 0:
            ask(witness, seq + 5)
        assert witness.take(seq, commanded_V(seq)) is None
    return witness


@pytest.mark.parametrize("lie", [lambda u: 1e3 * u, lambda u: -u, lambda u: 0.5, lambda u: u + 0.6])
def test_wrong_samples_are_replaced_by_what_was_commanded_and_the_tenth_is_named(lie: Callable[[float], float]) -> None:
    witness = believed()
    for i in range(40):
        seq = BELIEVED + i
        if seq % 5 == 0:
            ask(witness, seq + 5)
        stood_in = witness.take(seq, lie(commanded_V(seq)))
        assert stood_in is not None
        assert bool(witness.why) == (i + 1 >= DIFFERS_FROM)
    assert stood_in == pytest.approx((commanded_V(seq), 10.0 * commanded_V(seq)))
    assert f"{commanded_V(seq):.6g} V were commanded" in witness.why
    # Right samples are taken as they are, and end it.
    for i in range(40, 80):
        seq = BELIEVED + i
        if seq % 5 == 0:
            ask(witness, seq + 5)
        stood_in = witness.take(seq, commanded_V(seq))
    assert stood_in is None
    assert witness.why == ""


def test_a_voltage_that_is_held_is_believed() -> None:
    """A stage that missed a command holds the voltage before: what it shows is right."""
    witness = believed()
    for seq in range(BELIEVED, BELIEVED + 100):
        if seq % 5 == 0:
            ask(witness, seq + 5)
        # Every fourth command is missed, for five samples.
        missed = seq % 20 < 5
        shown_V = commanded_V(seq - seq % 20 - 1) if missed else commanded_V(seq)
        assert witness.take(seq, shown_V) is None
        assert not witness.why


def slow_V(seq: int) -> float:
    """A slow motion, and rest from sample 4000 on."""
    return 5.0 + 0.5 * math.sin(0.01 * min(seq, 4000))


def follow_slowly(shown_V: Callable[[int], float], n: int) -> list[int]:
    """The samples of ``n`` for which what was commanded stands in."""
    witness, found = CommandWitness(SPAN_V), []
    for seq in range(n):
        if seq % 5 == 0:
            u_V = np.array([slow_V(k) for k in range(seq, seq + 10)])
            witness.note(Pending(seq, u_V[:5], u_V[:5]), u_V[5:], u_V[5:])
        if witness.take(seq, shown_V(seq)) is not None:
            found.append(seq)
    return found


def test_where_voltages_agree_to_the_last_bit_a_small_difference_is_seen() -> None:
    """Each sample that is believed teaches the wrong."""
    found = follow_slowly(lambda seq: slow_V(seq) + (0.002 * SPAN_V if seq >= 3310 else 0.0), 3400)
    assert found == list(range(3310, 3400))


def test_a_noisy_voltage_that_is_read_back_is_believed_in_motion_and_at_rest() -> None:
    noise_V = 0.002 * SPAN_V * np.random.default_rng(0).normal(size=8000)
    assert len(follow_slowly(lambda seq: slow_V(seq) + noise_V[seq], 8000)) <= 8
    # So is a converter of 12 bits.
    step_V = SPAN_V / 4096
    assert not follow_slowly(lambda seq: step_V * round(slow_V(seq) / step_V), 8000)


def test_who_has_never_agreed_in_motion_is_not_believed() -> None:
    """A query may say anything: a stranger that asks, or a voltage read back by another scale, stops no learning."""
    witness = CommandWitness(SPAN_V)
    for seq in range(300):
        if seq % 5 == 0:
            ask(witness, seq + 5)
        # A stage that holds its place agrees with everybody who asked for that place, and says nothing.
        shown_V = commanded_V(0) if seq < 100 else 1.3 * commanded_V(seq) + 1.0
        assert witness.take(seq, shown_V) is None


def test_what_nobody_commands_any_more_ends_the_doubt() -> None:
    witness = believed()
    ask(witness, BELIEVED, n=20)
    for seq in range(BELIEVED, BELIEVED + 20):
        witness.take(seq, -1.0)
    assert witness.why
    for seq in range(BELIEVED + 20, BELIEVED + 60):
        assert witness.take(seq, -1.0) is None
    assert witness.why == ""


@given(st.lists(st.tuples(st.integers(0, 2**62), st.floats(allow_nan=True, allow_infinity=True)), max_size=60))
def test_without_a_controller_every_sample_is_taken_as_it_is(samples: list[tuple[int, float]]) -> None:
    witness = CommandWitness(SPAN_V)
    assert [witness.take(seq, u_V) for seq, u_V in samples] == [None] * len(samples)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_no_voltage_raises(u_V: float) -> None:
    witness = believed()
    ask(witness, BELIEVED, n=20)
    for seq in range(BELIEVED, BELIEVED + 20):
        witness.take(seq, u_V)
    assert math.isfinite(u_V) or witness.why
