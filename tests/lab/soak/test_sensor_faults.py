"""Faults that lie without being impossible: what the stage sends, and what the judge makes of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dehyst.lab.soak.controller import STRAY, ControlTask, SoakReference
from dehyst.lab.soak.judge import judge_sensor_fault, stage_gain
from dehyst.lab.soak.observed import FaultRecord, SampleTracker
from dehyst.service.protocol.samples import MAX_SEQ, SampleBatch
from dehyst.service.stage_node.faults import Fault, Injector
from tests.lab.soak.soaked import broken, healthy, verdict

CONTROL = ControlTask(1e-3, 4.0, 80.0, 3, -2.0, 10.0, 4000.0)
Y_UM = 40.0 + 10.0 * np.sin(0.05 * np.arange(400))


def read(kind: str, value: float = 0.0) -> np.ndarray:
    """Readings of `Y_UM` with a fault from sample 100 to 300."""
    injector = Injector(1e-3, lambda _: None)
    read_um = []
    for k, y_um in enumerate(Y_UM.tolist()):
        if k == 100:
            injector.add(Fault(kind, 0.2, value))
        read_um.append(injector.reading(k, y_um))
    return np.array(read_um)


@pytest.mark.parametrize(("kind", "value"), [("stuck_noisy", 1e-6), ("sensor_gain", 0.3), ("sign", 0.0)])
def test_a_lying_sensor_goes_on_from_its_last_reading_and_is_sound_before_and_after(kind: str, value: float) -> None:
    shown = read(kind, value)
    np.testing.assert_array_equal(shown[:100], Y_UM[:100])
    np.testing.assert_array_equal(shown[300:], Y_UM[300:])
    moved = Y_UM[100:300] - Y_UM[100]
    lie = shown[100:300] - Y_UM[99]
    if kind == "stuck_noisy":
        assert 0.3e-6 < lie.std() < 3e-6
        assert np.unique(lie).size == 200, "no two readings are equal"
    else:
        np.testing.assert_allclose(lie, (0.3 if kind == "sensor_gain" else -1.0) * moved, atol=1e-12)


def test_the_readings_of_another_stage_have_nothing_to_do_with_this_one() -> None:
    shown = read("other_stage", 80.0)[100:300]
    assert 0.0 < shown.min() < shown.max() < 80.0
    assert abs(np.corrcoef(shown, Y_UM[100:300])[0, 1]) < 0.9
    np.testing.assert_array_equal(shown, read("other_stage", 80.0)[100:300])


def delivered(kind: str, value: float) -> tuple[list[int], Injector]:
    injector = Injector(1e-3, lambda _: None)
    injector.add(Fault(kind, 0.4, value))
    for k in range(500, 1000):
        injector.reading(k, 0.0)
    sent: list[int] = []
    for first in range(450, 1000, 5):
        seq = np.arange(first, first + 5)
        for message in injector.deliver((seq, seq * 1e-3, seq * 0.0, seq * 0.0)):
            sent += message[0].tolist()
    return sent, injector


@pytest.mark.parametrize("value", [1e5, float(2**62)])
def test_one_sample_has_a_number_far_ahead(value: float) -> None:
    sent, injector = delivered("seq_jump", value)
    expected = list(range(450, 1000))
    expected[50] = min(500 + int(value), MAX_SEQ)
    assert sent == expected
    assert injector.counts["seq_jump"] == 1


# ---- the judge


class Run:
    """A stage that follows the soak's reference off by ``off_um``, as the monitor sees it."""

    def __init__(self, off_um: float = 0.0, held: bool = False, still: bool = False) -> None:
        self.now_s = 0.0
        self.track = SampleTracker(CONTROL, lambda: self.now_s)
        reference = SoakReference(CONTROL.dt_s, CONTROL.low_um, CONTROL.high_um, CONTROL.seed)
        for first in range(0, 6000, 20):
            self.now_s = first * CONTROL.dt_s
            seq = np.arange(first, first + 20)
            y_um = np.full(20, 40.0) if still else reference.rows(first + 5000, 20)[0]
            self.track.want(first, y_um)
            self.track.command(first, np.ones(20))
            bad = off_um if 2000 <= first < 5000 else 0.02
            u_V = np.full(20, 1.5 if held else 1.0)
            self.track.take_sound(SampleBatch(seq, seq * CONTROL.dt_s, u_V, y_um + bad))

    def judged(self, *troubles: tuple[int, str], gain: float = 1.0) -> FaultRecord:
        fault = FaultRecord("sign", 2.0, 5.0, begin_seq=2000)
        judge_sensor_fault(fault, self.track, troubles, 4999, gain)
        return fault


def test_a_stage_that_has_changed_may_be_off_as_the_frozen_model_is() -> None:
    run = Run(2.0)  # 2.6 % of the range
    named = (2200, "sensor_sign")
    assert "allowed 1 %" in run.judged(named).breaches[0]
    assert "allowed 1 %" in run.judged(named, gain=0.995).breaches[0]
    assert run.judged(named, gain=0.95).breaches == []
    faults = [FaultRecord("gain", 3.0, value=-0.05), FaultRecord("sign", 4.0), FaultRecord("gain", 9.0, value=0.0)]
    assert [stage_gain(faults, at_s) for at_s in (2.0, 4.0, 10.0)] == [1.0, 0.95, 1.0]


@pytest.mark.parametrize(
    ("off_um", "troubles", "words"),
    [
        (0.5, [], "not named within"),
        (0.5, [(2200, "stale")], "not named within"),
        (0.5, [(4500, "sensor_stuck")], "named after"),
        (2.0, [(2200, "sensor_stuck")], "error 2.63 % of range"),
    ],
)
def test_each_part_of_it_can_be_broken(off_um: float, troubles: list[tuple[int, str]], words: str) -> None:
    fault = Run(off_um).judged(*troubles)
    (breach,) = fault.breaches
    assert words in breach
    observed = healthy()
    observed.faults[0].breaches = fault.breaches
    found = verdict(observed)
    assert broken(found) == {"faults_held"}
    assert words in found["invariants"]["faults_held"]["text"]
    assert found["faults"]["gap"]["breaches"] == [breach]


def test_a_stage_at_rest_names_nothing_and_held_voltages_say_nothing_of_the_model() -> None:
    assert "moved for 0.00 s only" in Run(still=True).judged().unjudged[0]
    fault = Run(5.0, held=True).judged((2200, "sensor_sign"))
    assert fault.breaches == []
    assert "every voltage came in time" in fault.unjudged[0]
    assert math.isnan(fault.error_pct)


def test_a_wrong_number_does_not_blind_the_soak_itself() -> None:
    track = SampleTracker(CONTROL, lambda: 1.0)

    def take(*numbers: int) -> None:
        seq = np.array(numbers, dtype=np.int64)
        track.take(SampleBatch(seq, seq * 1e-3, np.ones(seq.size), np.ones(seq.size)))

    take(1, 2, 3)
    for stray in (100_003, 2**62):
        take(4, stray)
        take(stray)
        assert track.newest == 4
    assert (track.received, track.seconds[-1].seq) == (9, 4)
    take(5, 4 + STRAY)
    assert track.newest == 4 + STRAY


# ---- strangers and folders
