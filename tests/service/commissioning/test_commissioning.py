"""Commissioning: the faults of simulated controllers by real sockets, and what it does in virtual time."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.service.adapters import adapter, simulated_pi
from dehyst.service.adapters.adapter import AdapterError, Stated
from dehyst.service.adapters.pi import PiStage
from dehyst.service.adapters.simulated_pi import FAULTS, SimulatedPi
from dehyst.service.answers.guard import Limits
from dehyst.service.commissioning import commission as rounds
from dehyst.service.commissioning import mover
from dehyst.service.commissioning.commission import commission, response
from dehyst.service.commissioning.mover import Order, Piece, StageFault
from dehyst.service.config.settings import read_config
from dehyst.service.storage.model_file import read_bundle
from tests.service.conftest import Clock, unused_port

ROOT = Path(__file__).resolve().parents[3]
LIMITS = Limits(0.0, 80.0, 400.0)
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
needs_pipython = pytest.mark.skipif(
    importlib.util.find_spec("pipython") is None, reason="pipython is not installed (extra 'hardware')"
)


# --- A simulated controller in a process of its own, the real adapter, and sockets between them.


@contextmanager
def controller(*words: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """(the process of a simulated PI controller, its port)."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dehyst.service.adapters.simulated_pi", "--port", "0", *words],
        stdout=subprocess.PIPE, text=True, cwd=ROOT, env=ENVIRONMENT,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        found = re.search(r"port (\d+)", process.stdout.readline())
        assert found
        yield process, int(found[1])
    finally:
        process.kill()
        process.communicate(timeout=20)


class Witness(PiStage):
    """The real adapter, with all voltages that it was asked to write."""

    written: list[float]

    def write_V(self, u_V: float) -> None:
        super().write_V(u_V)
        self.written.append(u_V)


def opener(port: int, written: list[float], check_errors: bool = True) -> Callable[[], Witness]:
    def open_stage() -> Witness:
        stage = Witness("127.0.0.1", port=port, rate_Hz=50.0, check_errors=check_errors)
        stage.written = written
        return stage

    return open_stage


def kept_within(written: list[float], limits: Limits, rate_Hz: float, rest_V: float = 0.0) -> None:
    """No voltage outside the envelope, no step faster than the slew rate, and the last one is that of the rest."""
    u_V = np.array([rest_V, *written])
    assert limits.u_min_V <= u_V.min()
    assert u_V.max() <= limits.u_max_V
    assert np.abs(np.diff(u_V)).max() <= limits.slew_V_per_s / rate_Hz + 1e-9
    assert u_V[-1] == rest_V


@needs_pipython
@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "kind", "words", "highest_V"),
    [
        ("servo", "servo", "its servo is on", 0.0),
        ("disconnect", "failed", "PiStage.read_um", 80.0),
    ],
)
def test_a_fault_is_named_and_the_stage_goes_back_to_rest(
    fault: str, kind: str, words: str, highest_V: float, tmp_path: Path
) -> None:
    written: list[float] = []
    with controller("--fault", fault) as (_, port):
        report = commission(opener(port, written), Order(LIMITS), tmp_path)
        assert report["fault"]["kind"] == kind, report
        assert words in report["fault"]["message"]
        assert "NOT" not in report["fault"]["rest"]
        with PiStage("127.0.0.1", port=port) as stage:
            assert stage.applied_V() == 0.0
    if written:
        kept_within(written, LIMITS, 50.0)
        assert max(written) <= highest_V
    assert (fault == "servo") == (not written)
    assert not (tmp_path / "stage.npz").exists()
    assert json.loads((tmp_path / "report.json").read_text())["fault"] == report["fault"]


@needs_pipython
@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(400)
def test_noise_fifty_times_too_large_stands_in_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, shorter_s in (("_TRAIN_S", 8.0), ("_SWEEP_S", 2.0), ("_HELD_S", 6.0)):
        monkeypatch.setattr(rounds, name, shorter_s)
    written: list[float] = []
    with controller("--fault", "noise") as (_, port):
        report = commission(opener(port, written), Order(LIMITS, duration_s=300.0), tmp_path)
    assert report["fault"] is None, report
    assert 0.2 < report["noise_um"] < 0.4
    assert report["in_the_way"][0].startswith("noise: a reading has 0.")
    assert report["rounds"] == 1
    assert read_bundle(tmp_path / "stage.npz").models
    kept_within(written, LIMITS, 50.0)


def stage_file(folder: Path, port: int) -> list[str]:
    """Arguments of the command for a stage at this port, whose file it writes."""
    stage = f"PiStage('127.0.0.1', port={port}, rate_Hz=50.0)"
    program = f"from dehyst.service.adapters.pi import PiStage\ndef open_stage():\n    return {stage}\n"
    (folder / "mine.py").write_text(program)
    return ["--adapter", "mine.py:open_stage", "--u-min", "0", "--u-max", "80", "--slew", "400", "--out", "out"]


@needs_pipython
@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(400)
def test_the_command_takes_three_minutes_at_most_and_its_model_is_served(tmp_path: Path) -> None:
    """With a target that a loaded machine reaches, where many samples come late."""
    with controller() as (_, port):
        done = subprocess.run(
            [sys.executable, "-m", "dehyst.service.cli", "commission", *stage_file(tmp_path, port), "--target", "2"],
            cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=300,
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^sign, unit \+, µm; checked by the controller's travel$", done.stdout, re.M)
    assert re.search(r"^hysteresis 1\d\.?\d* % of the motion$", done.stdout, re.M)
    out = tmp_path / "out"
    assert json.loads((out / "report.json").read_text())["seconds"] <= 180.0
    config = out / "serve.toml"
    config.write_text(config.read_text().replace("7447", str(unused_port())))
    with subprocess.Popen(
        [sys.executable, "-m", "dehyst.service.cli", "serve", "--config", str(config)],
        cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True,
    ) as service:  # fmt: skip
        assert service.stdout is not None
        assert service.stdout.readline().startswith("ready")
        service.send_signal(signal.SIGINT)
        assert service.wait(60) == 0


@needs_pipython
@pytest.mark.e2e
@pytest.mark.slow
def test_ctrl_c_ramps_the_stage_back_and_keeps_the_recording(tmp_path: Path) -> None:
    with controller() as (_, port):
        with subprocess.Popen(
            [sys.executable, "-m", "dehyst.service.cli", "commission", *stage_file(tmp_path, port)],
            cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True,
        ) as process:  # fmt: skip
            assert process.stderr is not None
            said = ""
            while "motion seen" not in said:
                line = process.stderr.readline()
                assert line, said
                said += line
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(1.0)
            process.send_signal(signal.SIGINT)
            said += process.stderr.read()
            assert process.wait(30) == 130
        assert "stopped by SIGINT; the stage is back at rest, 0 V" in said
        assert "Traceback" not in said
        with PiStage("127.0.0.1", port=port) as stage:
            assert stage.applied_V() == 0.0
    assert len((tmp_path / "out" / "recording.csv").read_text().splitlines()) > 100


# --- In virtual time: numbers that do not depend on the load of the machine.


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in (adapter, rounds, mover, simulated_pi):
        monkeypatch.setattr(module, "time", clock)
    # The identification takes real time.
    hold = mover.Mover.hold

    def hold_until(self: mover.Mover, done: Callable[[], bool]) -> None:
        while not done():
            time.sleep(0.02)
        hold(self, done)

    monkeypatch.setattr(mover.Mover, "hold", hold_until)
    return clock


class Direct:
    """The simulated controller's commands without sockets."""

    def __init__(
        self, rate_Hz: float = 100.0, said: Stated | None = None, rest_V: float = 0.0, fault: str = ""
    ) -> None:
        self.rate_Hz, self.u_min_V, self.u_max_V = rate_Hz, -20.0, 100.0
        self.controller, self.said = SimulatedPi(fault=FAULTS.get(fault)), said
        self.controller.answer("SVO 1 0")
        self.written: list[float] = []
        self.closed = 0
        if rest_V:
            self.controller.answer(f"SVA 1 {rest_V}")

    def read_um(self) -> float:
        return self._number("POS? 1")

    def write_V(self, u_V: float) -> None:
        self.written.append(u_V)
        self.controller.answer(f"SVA 1 {u_V!r}")
        if (error := self.controller.answer("ERR?")) != "0":
            raise AdapterError(f"SVA: error {error}")

    def applied_V(self) -> float:
        return self._number("VOL? 1")

    def close(self) -> None:
        self.closed += 1

    def stated(self) -> Stated:
        return self.said or Stated(False, "UM", 100.0)

    def _number(self, query: str) -> float:
        reply = self.controller.answer(query)
        assert reply is not None
        return float(reply.partition("=")[2])


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_stage_is_identified_within_three_minutes_and_ready_to_serve(clock: Clock, tmp_path: Path) -> None:
    stage, said = Direct(), []
    report = commission(lambda: stage, Order(LIMITS, axis="y"), tmp_path, say=said.append)
    assert (report["fault"], report["in_the_way"]) == (None, []), report
    kept_within(stage.written, LIMITS, 100.0)
    assert stage.closed == 1
    # A round after 25 s of pulses; the three minutes leave as much for the identification.
    assert report["rounds"] == 1
    assert 60.0 < report["seconds"] < 90.0
    assert 0.9 < report["gain_um_per_V"] < 1.2
    assert 0.1 < report["hysteresis"] < 0.17
    assert 0.004 < report["noise_um"] < 0.009
    assert report["error_pct"] < 0.2
    assert report["checked"] == "the controller's travel"
    # The readings show the voltage of the sample before; sensor and amplifier add half a millisecond at most.
    assert 0.009 < report["lag_s"] < 0.0105
    assert report["mode_Hz"] is None
    # Motion was looked for from a few mV on, and seen before a tenth of a volt.
    tops = [b for a, b, c in zip(stage.written, stage.written[1:], stage.written[2:], strict=False) if a < b == c]
    assert [u for u in tops if u > 0.0][:2] == [0.0025, 0.005]
    assert re.search(r"^motion seen at \d\d mV", "\n".join(said), re.M)
    (axis,) = read_config(tmp_path / "serve.toml").axes
    assert (axis.name, axis.limits.u_max_V, axis.limits.slew_V_per_s) == ("y", 80.0, 400.0)
    bundle = read_bundle(tmp_path / "stage.npz")
    assert (bundle.meta.axis, bundle.meta.source) == ("y", "recording.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "recording.csv",
        "report.json",
        "serve.toml",
        "stage.npz",
    ]


def faulty(stage: Direct, tmp_path: Path, order: Order | None = None) -> dict[str, Any]:
    fault: dict[str, Any] = commission(lambda: stage, order or Order(LIMITS), tmp_path)["fault"]
    return fault


@pytest.mark.parametrize(
    ("fault", "kind", "words", "highest_V"),
    [
        ("sign", "sign", "expected about 0.833 by the controller's travel", 0.2),
        ("unit", "unit", "nm in place of µm", 0.2),
        ("limit", "limit", "state --u-max", 75.0),
        ("hidden-servo", "servo", "less than a piezo stage has in open loop", 80.0),
    ],
)
def test_a_fault_of_stage_or_sensor_is_named(
    fault: str, kind: str, words: str, highest_V: float, clock: Clock, tmp_path: Path
) -> None:
    stage = Direct(50.0, fault=fault)
    found = faulty(stage, tmp_path)
    assert found["kind"] == kind, found
    assert words in found["message"]
    assert found["rest"] == "back at rest, 0 V"
    kept_within(stage.written, LIMITS, 50.0)
    assert max(stage.written) <= highest_V
    assert not (tmp_path / "stage.npz").exists()


@pytest.mark.parametrize("rest_V", [0.0, 30.0, 80.0])
def test_every_voltage_keeps_the_envelope_from_wherever_the_stage_rests(
    rest_V: float, clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Up to the end of the first round, where the identification fails here."""
    stage, limits = Direct(50.0, rest_V=rest_V), Limits(0.0, 80.0, 60.0)

    def fails(*_: object) -> None:
        raise StageFault("failed", "no identification here")

    monkeypatch.setattr(rounds, "_identified", fails)
    fault = faulty(stage, tmp_path, Order(limits))
    assert fault["message"] == "no identification here"
    kept_within(stage.written, limits, 50.0, rest_V)
    assert min(stage.written) == 0.0
    assert max(stage.written) == 80.0
    steps = np.abs(np.diff([rest_V, *stage.written]))
    assert steps.max() > 0.9 * 60.0 / 50.0, "the drive uses what is stated"


def test_opening_writes_nothing_and_limits_that_do_not_fit_are_refused(clock: Clock, tmp_path: Path) -> None:
    for limits, rest_V, words in (
        (Limits(0.0, 120.0, 400.0), 0.0, "expected voltages within -20 to 100 V"),
        (Limits(0.0, 80.0, 400.0), -5.0, "applied_V: got -5 V, expected 0 to 80 V"),
    ):
        stage = Direct(rest_V=rest_V)
        with pytest.raises(InputError, match=re.escape(words)):
            commission(lambda stage=stage: stage, Order(limits), tmp_path)
        assert (stage.written, stage.closed) == ([], 1)
    with pytest.raises(InputError, match="expected a StageAdapter"):
        commission(lambda: 3, Order(LIMITS), tmp_path)  # type: ignore[arg-type,return-value]


def test_sign_and_unit_are_checked_against_what_is_stated(clock: Clock, tmp_path: Path) -> None:
    stage = Direct(said=Stated(False, "nm", 1e5))
    assert faulty(stage, tmp_path)["message"].startswith("the controller gives positions in 'nm', expected µm")
    assert not stage.written
    assert faulty(Direct(), tmp_path, Order(LIMITS, gain_um_per_V=-1.0))["kind"] == "sign"
    fault = faulty(Direct(said=Stated(False, "", math.nan)), tmp_path, Order(LIMITS, gain_um_per_V=1000.0))
    assert (fault["kind"], "mm in place of µm" in fault["message"]) == ("unit", True)


def test_a_stage_that_does_not_move_rings_or_has_no_reading_is_named(clock: Clock, tmp_path: Path) -> None:
    still = Direct()
    still.read_um = lambda: 5.0 + 0.005 * math.sin(1e6 * clock.now_s)  # type: ignore[method-assign]
    fault = faulty(still, tmp_path)
    assert fault["kind"] == "no_motion"
    kept_within(still.written, LIMITS, 100.0)

    ringing = Direct()
    read = ringing.read_um
    size = [0.0]

    def swings() -> float:
        size[0] = max(size[0], abs(ringing.applied_V()))
        return read() + (3.0 * size[0] * math.sin(50.0 * clock.now_s) if size[0] > 2.0 else 0.0)

    ringing.read_um = swings  # type: ignore[method-assign]
    assert faulty(ringing, tmp_path)["kind"] == "ringing"
    kept_within(ringing.written, LIMITS, 100.0)
    assert max(ringing.written) < 15.0

    blind = Direct()
    count = [0]

    def ends() -> float:
        count[0] += 1
        return read() if count[0] < 300 else math.nan

    blind.read_um = ends  # type: ignore[method-assign]
    assert faulty(blind, tmp_path)["kind"] == "no_reading"


def test_a_sweep_shows_lag_and_first_mode() -> None:
    from scipy.signal import cont2discrete

    rate_Hz, mode_Hz, late = 1000.0, 120.0, 4
    t = np.arange(6000) / rate_Hz
    u_V = 40.0 + 2.0 * np.sin(2.0 * np.pi * (0.5 * t + 299.5 / 12.0 * t**2))
    w = 2.0 * np.pi * mode_Hz
    system = ([[0.0, 1.0], [-(w**2), -2.0 * 0.05 * w]], [[0.0], [w**2]], [[1.0, 0.0]], [[0.0]])
    step, drive, *_ = cont2discrete(tuple(np.array(m) for m in system), 1.0 / rate_Hz)
    state, moved_um = np.zeros(2), np.zeros(t.size)
    for k in range(t.size):
        moved_um[k] = state[0]
        state = step @ state + drive[:, 0] * (u_V[k] - 40.0)
    y_um = -np.roll(moved_um, late) + np.random.default_rng(0).normal(0.0, 0.005, t.size)
    timely = np.random.default_rng(1).random(t.size) > 0.05
    piece = Piece(np.arange(t.size), u_V, y_um, timely)
    lag_s, mode = response(piece, slice(0, t.size), 1.0 / rate_Hz)
    assert mode == pytest.approx(mode_Hz, rel=0.03)
    # The delay, 2 zeta / omega of the mode, and half a sample time for which a voltage is held.
    assert lag_s == pytest.approx((late + 0.5) / rate_Hz + 0.1 / w, abs=2e-4)
    still = Piece(np.arange(t.size), u_V, np.random.default_rng(2).normal(0.0, 0.005, t.size), timely)
    assert response(still, slice(0, t.size), 1.0 / rate_Hz) == (None, None)


@needs_pipython
@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pipython leaves its socket open
def test_a_controller_that_is_gone_leaves_its_voltage_and_that_is_said(tmp_path: Path) -> None:
    written: list[float] = []
    with controller() as (process, port):
        open_stage = opener(port, written)

        def say(line: str) -> None:
            if line.startswith("motion seen"):
                process.kill()

        report = commission(open_stage, Order(LIMITS), tmp_path, say=say)
    assert report["fault"]["kind"] == "failed"
    assert report["fault"]["rest"].startswith("NOT at rest: ")
    assert "no controller answers there" in report["fault"]["rest"]
    assert "the voltage stays, last known at" in report["fault"]["rest"]


def test_a_refused_voltage_ends_it_and_the_stage_goes_back(clock: Clock, tmp_path: Path) -> None:
    stage = Direct()
    stage.controller._high_V = 50.0
    fault = faulty(stage, tmp_path)
    assert (fault["kind"], fault["rest"]) == ("failed", "back at rest, 0 V")
    assert "SVA: error 302" in fault["message"]
    assert stage.applied_V() == 0.0
