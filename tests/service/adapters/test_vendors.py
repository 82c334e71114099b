"""The ready adapters against instruments that speak the vendor's documented commands. None of it is hardware."""

from __future__ import annotations

import importlib.util
import inspect
import re
import subprocess
import sys
import types
from collections.abc import Iterator
from typing import Any

import pytest

from dehyst.adaptive.errors import InputError
from dehyst.service.adapters.adapter import AdapterError, StageAdapter, Stated
from dehyst.service.adapters.jena import Nv200Stage
from dehyst.service.adapters.ni import NiStage
from dehyst.service.adapters.pi import PiStage
from tests.service.adapters.simulated_nv200 import SimulatedNv200

needs_pipython = pytest.mark.skipif(
    importlib.util.find_spec("pipython") is None, reason="pipython is not installed (extra 'hardware')"
)
needs_nv200 = pytest.mark.skipif(
    importlib.util.find_spec("nv200") is None, reason="nv200 is not installed (extra 'hardware', Python 3.12 or newer)"
)
#: nv200 1.6 closes its reader in a way that telnetlib3 no longer likes.
old_close = pytest.mark.filterwarnings("ignore:close\\(\\) is deprecated:DeprecationWarning")


def at_its_limits(stage: StageAdapter) -> None:
    """Any adapter reads after it wrote, and knows what it applied."""
    stage.write_V(10.0)
    assert stage.applied_V() == pytest.approx(10.0)
    assert isinstance(stage.read_um(), float)


@pytest.fixture(scope="module")
def pi_port() -> Iterator[int]:
    """The port of the simulated PI controller."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dehyst.service.adapters.simulated_pi", "--port", "0"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    found = re.search(r"port (\d+)", process.stdout.readline())
    assert found
    yield int(found[1])
    process.kill()
    process.stdout.close()
    process.wait(10)


@needs_pipython
def test_a_pi_controller_is_read_and_driven_by_gcs(pi_port: int) -> None:
    # Twice: a device that was closed must not stand in the way of the next connection.
    for check_errors in (True, False):
        with PiStage("127.0.0.1", port=pi_port, rate_Hz=100.0, check_errors=check_errors) as stage:
            assert "E-709" in stage.identity
            assert (stage.rate_Hz, stage.u_min_V, stage.u_max_V) == (100.0, -20.0, 100.0)
            assert stage.stated() == Stated(False, "um", 100.0)
            at_its_limits(stage)
            before_um = stage.read_um()
            stage.write_V(60.0)
            for _ in range(200):
                if (after_um := stage.read_um()) > before_um + 10.0:
                    break
            assert after_um > before_um + 10.0
            stage.write_V(0.0)


@needs_pipython
def test_a_refused_voltage_of_a_pi_controller_is_an_error(pi_port: int) -> None:
    with PiStage("127.0.0.1", port=pi_port) as stage:
        with pytest.raises(Exception, match="302"):
            stage.write_V(500.0)
        assert stage.applied_V() == 0.0


@needs_pipython
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pipython leaves its socket open
def test_where_no_pi_controller_answers_the_address_is_named(free_port: int) -> None:
    with pytest.raises(AdapterError, match=f"port {free_port}: no controller"):
        PiStage("127.0.0.1", port=free_port)


@needs_nv200
@old_close
def test_an_nv200_is_read_and_driven_over_telnet() -> None:
    with SimulatedNv200() as device, Nv200Stage("127.0.0.1", port=device.port, adjust=False) as stage:
        # Open loop, set by commands.
        assert (device.values["cl"], device.values["modsrc"]) == ("0", "0")
        assert (stage.u_min_V, stage.u_max_V) == (-20.0, 130.0)
        at_its_limits(stage)
        assert stage.read_um() == pytest.approx(8.0)


@needs_nv200
@old_close
def test_an_nv200_that_measures_angles_is_refused() -> None:
    with SimulatedNv200("mrad") as device, pytest.raises(AdapterError, match="'mrad', expected µm"):
        Nv200Stage("127.0.0.1", port=device.port, adjust=False)


class Channels:
    def __init__(self) -> None:
        self.added: list[tuple[str, float, float]] = []

    def add_ao_voltage_chan(self, physical_channel: str, *, min_val: float, max_val: float) -> None:
        self.added.append((physical_channel, min_val, max_val))

    add_ai_voltage_chan = add_ao_voltage_chan


class Card:
    """A stand-in for `nidaqmx`: an output of ± 10 V that is wired to the input."""

    def __init__(self) -> None:
        self.tasks: list[Any] = []
        self.output_V = 0.0
        card = self

        class Task:
            def __init__(self) -> None:
                self.ao_channels, self.ai_channels, self.closed = Channels(), Channels(), False
                card.tasks.append(self)

            def start(self) -> None: ...

            def read(self) -> float:
                return card.output_V

            def write(self, data: float, *, auto_start: bool) -> None:
                low_V, high_V = self.ao_channels.added[0][1:]
                if not low_V <= data <= high_V:
                    raise ValueError("DaqError -200077")
                card.output_V = data

            def close(self) -> None:
                self.closed = True

        self.module = types.SimpleNamespace(Task=Task)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Card:
    card = Card()
    monkeypatch.setitem(sys.modules, "nidaqmx", card.module)  # type: ignore[arg-type]
    return card


def test_a_card_drives_the_amplifier_and_reads_the_sensor(card: Card) -> None:
    with NiStage(
        "Dev1/ao0", "Dev1/ai0", amplifier_gain=10.0, um_per_V=6.0, um_at_0V=1.0, u_min_V=-20.0, u_max_V=90.0
    ) as stage:
        output, inp = card.tasks
        assert output.ao_channels.added == [("Dev1/ao0", -2.0, 9.0)]
        assert inp.ai_channels.added == [("Dev1/ai0", -10.0, 10.0)]
        at_its_limits(stage)
        assert card.output_V == pytest.approx(1.0)
        assert stage.read_um() == pytest.approx(7.0)
        with pytest.raises(ValueError, match="200077"):
            stage.write_V(200.0)
        assert stage.applied_V() == 10.0
    assert output.closed
    assert inp.closed


def test_a_card_without_its_driver_is_an_error_with_the_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise OSError("Could not find an installation of NI-DAQmx")

    monkeypatch.setitem(sys.modules, "nidaqmx", types.SimpleNamespace(Task=missing))  # type: ignore[arg-type]
    with pytest.raises(AdapterError, match=r"Dev1/ao0, Dev1/ai0: OSError: Could not find"):
        NiStage("Dev1/ao0", "Dev1/ai0", amplifier_gain=10.0, um_per_V=6.0, u_min_V=0.0, u_max_V=90.0)
    with pytest.raises(InputError, match="amplifier_gain"):
        NiStage("Dev1/ao0", "Dev1/ai0", amplifier_gain=0.0, um_per_V=6.0, u_min_V=0.0, u_max_V=90.0)


@pytest.mark.skipif(importlib.util.find_spec("nidaqmx") is None, reason="nidaqmx is not installed (extra 'hardware')")
def test_the_stand_in_for_the_card_has_the_signatures_of_the_real_library() -> None:
    from nidaqmx.task import Task
    from nidaqmx.task.collections import AIChannelCollection, AOChannelCollection

    inspect.signature(Task.__init__).bind(None)
    inspect.signature(Task.start).bind(None)
    inspect.signature(Task.read).bind(None)
    inspect.signature(Task.write).bind(None, 1.0, auto_start=True)
    inspect.signature(Task.close).bind(None)
    inspect.signature(AOChannelCollection.add_ao_voltage_chan).bind(None, "Dev1/ao0", min_val=0.0, max_val=1.0)
    inspect.signature(AIChannelCollection.add_ai_voltage_chan).bind(None, "Dev1/ai0", min_val=0.0, max_val=1.0)


@pytest.mark.parametrize("module", ["pipython", "nv200.nv200_device", "nidaqmx"])
def test_a_missing_library_is_named_with_the_way_to_get_it(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # type: ignore[arg-type]
    makes = {
        "pipython": lambda: PiStage("127.0.0.1"),
        "nv200.nv200_device": lambda: Nv200Stage("127.0.0.1"),
        "nidaqmx": lambda: NiStage("a", "b", amplifier_gain=1.0, um_per_V=1.0, u_min_V=0.0, u_max_V=1.0),
    }
    with pytest.raises(AdapterError, match=rf"{module}: not installed .* the extra 'hardware'"):
        makes[module]()
