"""An axis as EPICS process variables, read and written by a real PVAccess client on loopback."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from dehyst.lab.cli import main
from dehyst.service.adapters.epics import EpicsAxis
from dehyst.service.client.client import Client
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client
from tests.service.living import eventually

pytestmark = pytest.mark.e2e
p4p = pytest.importorskip("p4p.client.thread", reason="p4p is not installed (extra 'epics')")


@pytest.fixture
def variables(serve: Callable[..., Any]) -> Iterator[tuple[Any, EpicsAxis, Any, Any]]:
    """(context of an EPICS client, the axis, a client of the service, the service)."""
    service = serve()
    with (
        open_client(service.endpoint) as session,
        EpicsAxis(session, Keys("demo", "x"), "LAB:X", port=0, timeout_s=3.0) as axis,
        Client.connect(service.endpoint) as client,
    ):
        port = axis.configuration["EPICS_PVAS_SERVER_PORT"]
        conf = {
            "EPICS_PVA_NAME_SERVERS": f"127.0.0.1:{port}",
            "EPICS_PVA_AUTO_ADDR_LIST": "NO",
            "EPICS_PVA_ADDR_LIST": "",
        }
        with p4p.Context("pva", conf=conf, useenv=False) as context:
            axis.poll()
            yield context, axis, client, service


def test_status_error_freeze_and_enable_are_variables(variables: Any) -> None:
    context, axis, client, service = variables
    assert context.get("LAB:X:STATUS", timeout=5.0) == "ok"
    assert np.isnan(context.get("LAB:X:MODEL_ERROR"))  # nothing learnt yet
    assert (context.get("LAB:X:ENABLE"), context.get("LAB:X:FREEZE")) == (True, False)
    served = context.get("LAB:X:SERVED")

    seen: list[str] = []
    watching = context.monitor("LAB:X:STATUS", lambda value: seen.append(value.raw.value))
    context.put("LAB:X:FREEZE", True, timeout=5.0)
    assert client.status()["frozen"]
    assert context.get("LAB:X:STATUS") == "frozen"
    context.put("LAB:X:FREEZE", False, timeout=5.0)
    assert not client.status()["frozen"]
    eventually(lambda: seen[-1:] == ["ok"] and "frozen" in seen)
    watching.close()

    context.put("LAB:X:ENABLE", False, timeout=5.0)
    assert client.status()["served"] == context.get("LAB:X:SERVED") == "linear"
    context.put("LAB:X:ENABLE", True, timeout=5.0)
    assert client.status()["served"] == served

    # The samples of a stage make an error, in percent with its unit.
    k = np.arange(3000)
    y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * 1e-3)
    for part in np.split(k, 30):
        client.samples(part, part * 1e-3, (y[part] - 1.0) / (11.0 * 0.95), y[part])
    eventually(
        lambda: axis.poll() == "ok" and context.get("LAB:X:SAMPLE") == 2999 and context.get("LAB:X:MODEL_ERROR") > 0.0
    )
    shown = context.get("LAB:X:MODEL_ERROR")
    assert float(shown) == pytest.approx(client.status()["quality"]["recent_rms_error_pct"], rel=0.5)
    assert shown.raw.display.units == "%"
    assert 0.0 < context.get("LAB:X:TRUST") <= 1.0

    # Without its service the axis is invalid, and a command is refused with the reason.
    service.kill()
    assert axis.poll() == "no_service"
    gone = context.get("LAB:X:STATUS")
    assert (gone.raw.value, gone.severity) == ("no_service", 3)
    assert context.get("LAB:X:TRUST").severity == 3
    with pytest.raises(Exception, match=r"no reply|closed|session"):
        context.put("LAB:X:FREEZE", True, timeout=5.0)


def test_the_network_is_reached_only_by_those_who_say_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["epics", "--prefix", "LAB:X", "--interface", "0.0.0.0"]) == 2
    assert "--interface: got '0.0.0.0'" in capsys.readouterr().err
    assert main(["epics", "--prefix", "LAB:X", "--every", "0"]) == 2
