"""The loop that turns an adapter into a stage: limits, lateness, what is published, and a real service that learns."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.adapters import AdapterError, StageLoop, adapter, excitation, record, write_recording
from dehyst.service.adapters.adapter import Ticks
from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client
from dehyst.service.protocol.samples import encode_command
from dehyst.sim.recordings import ColumnMap, read
from tests.service.conftest import Clock
from tests.service.living import eventually


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Clock:
    """The loop's clock, except in tests with real processes."""
    clock = Clock()
    if request.node.get_closest_marker("e2e") is None:
        monkeypatch.setattr(adapter, "time", clock)
    return clock


class PlainStage:
    """1 µm/V, without hysteresis; `on_read` is called at each reading with its number from 1 on."""

    def __init__(self, rate_Hz: float = 1000.0, u_max_V: float = 100.0) -> None:
        self.rate_Hz, self.u_min_V, self.u_max_V = rate_Hz, 0.0, u_max_V
        self.u_V = 0.0
        self.written: list[float] = []
        self.reads = 0
        self.on_read: Callable[[int], None] = lambda _: None

    def read_um(self) -> float:
        self.reads += 1
        self.on_read(self.reads)
        return self.u_V

    def write_V(self, u_V: float) -> None:
        self.u_V = u_V
        self.written.append(u_V)

    def applied_V(self) -> float:
        return self.u_V

    def close(self) -> None: ...


class QuietClient:
    """What the loop needs of a client, without a network."""

    def __init__(self, dt_s: float, limits: Limits, seq: int = -1) -> None:
        self.dt_s, self.limits, self.seq = dt_s, limits, seq
        self.rows: list[FloatArray] = []
        self.receive: Callable[[bytes], None] = lambda _: None

    def status(self) -> dict[str, Any]:
        return {"seq": self.seq}

    def samples(self, *columns: Any) -> None:
        self.rows.append(np.array([np.asarray(c, dtype=np.float64) for c in columns]))

    def subscribe_commands(self, receive: Callable[[bytes], None]) -> Any:
        self.receive = receive
        return SimpleNamespace(undeclare=lambda: None, foreign=0)


WIDE = Limits(0.0, 100.0, 1e9, -10.0, 110.0)


def make(stage: PlainStage, limits: Limits = WIDE, seq: int = -1, **options: Any) -> tuple[StageLoop, QuietClient]:
    client = QuietClient(1.0 / stage.rate_Hz, limits, seq)
    return StageLoop(stage, client, **options), client  # type: ignore[arg-type]


def test_samples_hold_the_applied_voltage_and_the_reading_before_it() -> None:
    stage = PlainStage(200.0)
    loop, client = make(stage, seq=41)
    summary = loop.run(lambda seq, y_um: float(seq - 40), samples=40)
    assert loop.first == 42
    seq, t_s, u_V, y_um = np.concatenate(client.rows, axis=1)
    assert (summary.samples, summary.published, summary.late, summary.lost) == (40, 40, 0, 0)
    np.testing.assert_array_equal(seq, np.arange(42, 82))
    np.testing.assert_array_equal(u_V, seq - 40)
    # Read before the voltage of the same sample is applied.
    np.testing.assert_array_equal(y_um, [0.0, *u_V[:-1]])
    np.testing.assert_allclose(t_s, seq * loop.dt_s, atol=1e-9)
    kept = loop.measured(60)
    np.testing.assert_array_equal(kept[0], seq[seq >= 60])
    np.testing.assert_array_equal(kept[1], u_V[seq >= 60])


def test_voltages_keep_both_limits_and_the_slew_limit_from_the_one_before_the_run() -> None:
    stage = PlainStage(500.0, u_max_V=60.0)
    stage.u_V = 90.0
    loop, _ = make(stage, Limits(10.0, 100.0, 5000.0, -10.0, 110.0))
    # Down from outside the range by 10 V a sample, then held at a voltage that is not a number, then at a limit.
    wishes = iter([0.0] * 12 + [np.nan] * 3 + [1000.0] * 12)
    summary = loop.run(lambda *_: next(wishes, 1000.0), samples=27)
    assert stage.written[:3] == [80.0, 70.0, 60.0]
    assert min(stage.written) == 10.0
    assert max(stage.written[8:]) == 60.0
    assert np.abs(np.diff([90.0, *stage.written])).max() <= 10.0 + 1e-12
    assert summary.limited >= 15


def test_a_late_reading_is_no_sample_and_missed_times_are_left_out(clock: Clock) -> None:
    stage = PlainStage(100.0)
    # The fifth reading takes 34 ms: two sample times are missed, the next one begins 4 ms late, and then all is well.
    stage.on_read = lambda k: clock.sleep(0.034 if k == 5 else 0.001)
    loop, client = make(stage)
    summary = loop.run(lambda *_: 1.0, samples=20)
    seq, t_s, *_ = np.concatenate(client.rows, axis=1)
    assert seq.tolist() == [0, 1, 2, 3, 4, *range(8, 20)]
    assert (summary.samples, summary.late, stage.reads) == (17, 3, 18)
    np.testing.assert_allclose(t_s, seq * 0.01, atol=1e-9)
    # The sixth was due 24 ms before the fifth had ended.
    assert summary.worst_late_ms == pytest.approx(24.0, abs=1e-6)


def test_commands_of_the_wire_are_applied_by_their_number_and_the_last_one_is_held() -> None:
    stage = PlainStage(200.0)
    stage.u_V = 3.0
    loop, client = make(stage, seq=9)

    def arrive(k: int) -> None:
        if k == 5:
            client.receive(encode_command(40, [20.0, 21.0, 22.0]))
            client.receive(b"no command")
        if k == 45:  # too late for 50, in time for the others
            client.receive(encode_command(50, np.arange(10.0) + 50.0))

    stage.on_read = arrive
    summary = loop.run(samples=60)
    u_V = np.concatenate(client.rows, axis=1)[2]
    # Until the first command is due, the voltage stays what it was; where none came in time, the last one is held.
    expected = [3.0] * 30 + [20.0, 21.0] + [22.0] * 12 + [*np.arange(54.0, 60.0)] + [59.0] * 10
    np.testing.assert_array_equal(u_V, expected)
    assert summary.missing > 0


def test_an_instrument_that_fails_ends_the_run_and_nothing_taken_is_lost() -> None:
    stage = PlainStage(200.0)

    def fail(k: int) -> None:
        if k == 10:
            raise OSError("the cable is out")

    stage.on_read = fail
    loop, client = make(stage)
    with pytest.raises(AdapterError, match=r"read_um: OSError: the cable is out"):
        loop.run(lambda *_: 1.0)
    assert sum(block.shape[1] for block in client.rows) == loop.measured(0)[0].size == 9


def test_an_adapter_that_does_not_fit_the_model_is_refused() -> None:
    client = QuietClient(1e-3, Limits(0.0, 10.0, 1e3, 0.0, 90.0))
    with pytest.raises(InputError, match=r"rate_Hz: got 500 Hz, expected 1000 Hz"):
        StageLoop(PlainStage(500.0), client)  # type: ignore[arg-type]
    high = PlainStage()
    high.u_min_V, high.u_max_V = 20.0, 40.0
    with pytest.raises(InputError, match="overlaps 0 to 10 V"):
        StageLoop(high, client)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"rate_Hz: got 0\.0"):
        Ticks(0.0)
    high.u_max_V = np.nan
    with pytest.raises(InputError, match="two finite voltages"):
        StageLoop(high, client)  # type: ignore[arg-type]


def test_a_recording_is_read_again_as_it_was_taken(tmp_path: Any) -> None:
    stage = PlainStage(500.0, u_max_V=50.0)
    voltage = excitation(5.0, 45.0, 500.0, duration_s=1.0)
    assert (voltage.min(), voltage.max(), voltage.size) == (5.0, 45.0, 500)
    told: list[str] = []
    recording = record(stage, voltage, told.append)
    assert recording.t_s.size + recording.late == 500
    k = np.rint(recording.t_s * 500.0).astype(int)
    np.testing.assert_array_equal(recording.u_V, voltage[k])
    write_recording(tmp_path / "recording.csv", recording)
    again = read(tmp_path / "recording.csv", ColumnMap())
    np.testing.assert_allclose(again.u_V, recording.u_V, rtol=1e-8)
    np.testing.assert_allclose(again.y_um, recording.y_um, rtol=1e-8)
    with pytest.raises(InputError, match="5 to 60 V, expected 0 to 50 V"):
        record(stage, [5.0, 60.0])


@pytest.mark.e2e
def test_a_service_learns_from_an_adapter_and_its_voltages_are_applied(shared_service: Any) -> None:
    stage = PlainStage(1000.0, u_max_V=10.0)
    with Client.connect(shared_service.endpoint, axis="y", timeout_s=5.0) as client:
        loop = StageLoop(stage, client)
        received = client.status()["samples"]["received"]
        control = threading.Thread(target=loop.run, kwargs={"samples": 3000})
        control.start()
        y_um = 40.0 + 0.01 * np.arange(200)
        answer = client.trajectory(y_um, begin=loop.first + 2500)
        client.command(loop.first + 2500, answer.u_V)
        control.join()
        assert loop.measured(0)[0].size > 0
        eventually(lambda: client.status()["samples"]["received"] - received == loop.measured(0)[0].size)
    seq, u_V, _ = loop.measured(loop.first + 2500)
    # The first ones are reached by the slew limit, from 0 V on.
    applied = (seq >= loop.first + 2510) & (seq < loop.first + 2700)
    assert applied.any()
    np.testing.assert_allclose(u_V[applied], answer.u_V[seq[applied] - loop.first - 2500], atol=1e-9)
