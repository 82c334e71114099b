"""A stage in lock step: its clock stands still until the voltage of a tick is there, up to a limit."""

from __future__ import annotations

import math
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.testbed.identified_stage import Rig
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import SURELY, open_client, wait_followed
from dehyst.service.stage_node.node import NodeConfig
from dehyst.sim.stage.presets import preset

PAUSE_S = 0.4


@pytest.mark.parametrize("wait_s", [math.nan, 61.0])
def test_a_wait_that_is_none_is_refused(wait_s: float) -> None:
    with pytest.raises(InputError, match="lock_step_s: got"):
        NodeConfig(preset("rich"), "t", ("x",), lock_step_s=wait_s)


@pytest.mark.e2e
@pytest.mark.parametrize(("options", "missing"), [(["--lock-step", "30"], 0), ([], 100)])
def test_a_controller_that_stalls_is_waited_for_in_lock_step_alone(
    tmp_path: Path, options: list[str], missing: int
) -> None:
    """Blocks of 20 for a controller that has seen the samples of the block before, and stalls in between."""
    n, block = 600, 20
    with Rig(tmp_path) as rig:
        where = ["--listen", rig.endpoint, "--duration", str(n * 1e-3), "--batch", "7", *options]
        stage = rig.start_stage("t", "x", *where)
        with open_client(rig.endpoint, 5.0) as session:
            seen, moved = [0], threading.Condition()

            def take(sample: object) -> None:
                with moved:
                    seen[0] = int(wire.decode_samples(sample.payload.to_bytes()).seq[-1]) + 1  # type: ignore[attr-defined]
                    moved.notify_all()

            samples = session.declare_subscriber(Keys("t", "x").sample, take)
            commands = session.declare_publisher(Keys("t", "x").command, congestion_control=SURELY)
            assert wait_followed(commands, 20.0)
            for first in range(0, n, block):
                with moved:
                    # Of the block before: the last samples fill no message of seven, and come for all that.
                    assert moved.wait_for(lambda due=first - 1: seen[0] >= due, 30.0)  # type: ignore[misc]
                if first == n // 2:
                    time.sleep(PAUSE_S)
                commands.put(wire.encode_command(first, np.full(block, first / n)))
            assert stage.wait(30.0) == 0
            samples.undeclare()  # type: ignore[no-untyped-call]
        found = stage.last_json()
    counts = found["units"]["x"]["commands"]
    assert (counts["missing"] == 0) if not missing else (counts["missing"] > missing)
    assert found["units"]["x"]["published"] == n
    assert (found["waited_s"] >= PAUSE_S - 0.05) == (not missing)
    assert found["ran_s"] >= n * 1e-3 - 1e-3 + found["waited_s"]
