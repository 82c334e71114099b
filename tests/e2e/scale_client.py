"""The client on the lab's host: moves the stages and asks every axis all along.

``python -m tests.e2e.scale_client FOLDER ROUTER`` prints one line of JSON when it has been answered by every axis, and
another with all that it was told. The line must answer all along.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.service.client.client import Client
from dehyst.service.operating.remote import operate, statuses
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client

STAGES = ("left", "right")
AXES = ("x", "y")
BEFORE_S, AFTER_S = 2.0, 4.0
#: What the stages are sent, at their rate in Hz: voltages for so many seconds from their first sample on.
RATE_HZ = 100
_DRIVEN_S = 120.0
#: So many samples are learnt from before the loss is prepared, and how long that may take, s.
_LEARNT = 100
_LEARNING_S = 40.0


class Asked:
    """One axis: its client, and what it was told."""

    def __init__(self, router: str, stage: str, axis: str, config: Path) -> None:
        # Queries of the stage that is lost end soon; those of the other one must never fail, however busy the machine.
        self.client = _connected(router, stage, axis, config, 0.5 if stage == STAGES[0] else 5.0)
        #: When the line was asked, how long it took, what it said, and what went wrong.
        self.told: list[tuple[float, float, float | None, str]] = []

    def line(self) -> None:
        """Ask the line, which always says the same."""
        at = time.monotonic()
        u_V, failure = None, ""
        try:
            u_V = self.client.point(40.0, model="linear").u_V
        except ServiceError as error:
            failure = type(error).__name__
        self.told.append((at, time.monotonic() - at, u_V, failure))


def drive(folder: Path, router: str) -> None:
    """Let all stages move, as a controller, until every axis has learnt from it. Raises TimeoutError."""
    t_s = np.arange(int(_DRIVEN_S * RATE_HZ)) / RATE_HZ
    u_V = 4.0 + 1.8 * np.sin(2 * np.pi * 0.9 * t_s) + 1.2 * np.sin(2 * np.pi * 2.3 * t_s)
    until = time.monotonic() + _LEARNING_S
    with contextlib.ExitStack() as open_:
        config = folder / "loop.json5"
        clients = [open_.enter_context(_connected(router, stage, axis, config)) for stage in STAGES for axis in AXES]
        # Again and again: a stage that is just starting hears none of it.
        while idle := [client for client in clients if _has_learnt(client) < _LEARNT]:
            if time.monotonic() >= until:
                raise TimeoutError(f"{idle[0].keys.base}: {_has_learnt(idle[0])} samples learnt")
            for client in idle:
                client.command(0, u_V)
            time.sleep(0.5)


def _has_learnt(client: Client) -> int:
    """Samples that an axis has learnt from, as far as it says so."""
    try:
        return int(client.status()["samples"]["learnt"])
    except ServiceError:
        return 0


def ask(folder: Path, router: str) -> int:
    """Every axis twenty times a second, from before the loss until after it."""
    config = folder / "plot.json5"
    drive(folder, router)
    axes = {f"{stage}/{axis}": Asked(router, stage, axis, config) for stage in STAGES for axis in AXES}
    with open_client(router, zenoh_config=config) as session:
        before = _short(statuses(session, timeout_s=5.0))
    print(json.dumps({"ready": True}), flush=True)
    start = time.monotonic()
    for k in range(int(20 * (BEFORE_S + AFTER_S))):
        time.sleep(max(0.0, start + k / 20 - time.monotonic()))
        for asked in axes.values():
            asked.line()
    for asked in axes.values():
        asked.client.close()
    with open_client(router, zenoh_config=config) as session:
        after = _short(statuses(session, timeout_s=5.0))
    with open_client(router, zenoh_config=folder / "alice.json5") as session:
        done = operate(session, Keys("left", "x"), "freeze", "alice")
    told = {name: asked.told for name, asked in axes.items()}
    print(json.dumps({"asked": told, "before": before, "after": after, "operated": done}), flush=True)
    return 0


def _connected(router: str, stage: str, axis: str, config: Path, timeout_s: float = 0.5) -> Client:
    """A client that has been answered once."""
    until = time.monotonic() + 20.0
    while True:
        try:
            return Client.connect(router, stage, axis, timeout_s=timeout_s, wait_s=10.0, zenoh_config=config)
        except ServiceError:
            if time.monotonic() >= until:
                raise


def _short(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"stage": s["stage"], "axis": s["axis"], "instance": s["instance"], "role": s["role"], "seq": s["seq"],
         "served": s["served"], "synced": s["synced"], "received": s["samples"]["received"],
         "learnt": s["samples"]["learnt"]}
        for s in found
    ]  # fmt: skip


if __name__ == "__main__":
    sys.exit(ask(Path(sys.argv[1]), sys.argv[2]))
