"""A router, two service hosts and a lab host with stages and clients; one service host is lost in the middle.

Hosts are groups of processes on loopback. Everything speaks TLS with access control, made by the
project's own command, because that is what ``dehyst serve`` asks for beyond loopback.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from dehyst.service.security.access import Plan, create
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.e2e.scale_client import AXES, BEFORE_S, RATE_HZ, STAGES
from tests.service.conftest import make_models, unused_port

USERS = {
    "relay": "router", "one": "service", "two": "service", "left": "stage", "right": "stage",
    "plot": "client", "loop": "controller", "alice": "operator",
}  # fmt: skip


class Host:
    """The processes of one machine."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.running: list[subprocess.Popen[str]] = []

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """``python`` with ``arguments`` on this host."""
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen([sys.executable, *arguments], text=True, stdout=subprocess.PIPE, env=environment)
        self.running.append(process)
        return process

    def lose(self) -> None:
        """It says nothing from one instant to the next, and its connections stay open, as if its cable were pulled."""
        for process in self.running:
            process.send_signal(signal.SIGSTOP)

    def stop(self) -> None:
        """End what runs here."""
        for process in self.running:
            process.kill()
            process.communicate(timeout=20)


class Stall(threading.Thread):
    """How long this machine stood still at most: who cannot say for a lease that it lives is taken for dead."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.worst_s = 0.0
        self._ended = False
        self.start()

    def run(self) -> None:
        before = time.monotonic()
        while not self._ended:
            time.sleep(0.01)
            now = time.monotonic()
            self.worst_s, before = max(self.worst_s, now - before - 0.01), now

    def end(self) -> float:
        """The longest so far, s; it is watched no longer."""
        self._ended = True
        self.join()
        return self.worst_s


def drill(folder: Path) -> dict[str, Any]:
    """Do it; returns what was seen."""
    relay, one, two, lab = hosts = [Host(name) for name in ("relay", "one", "two", "lab")]
    try:
        router = f"tls/127.0.0.1:{unused_port()}"
        create(folder, Plan(USERS, ("127.0.0.1",), {"left": "left", "right": "right"}))
        cli = ("-m", "dehyst.lab.cli")
        route = relay.start(*cli, "router", "--listen", router, "--zenoh-config", str(folder / "relay.json5"), "--json")
        _line(route)
        # Each host serves one stage and stands by for the other: nothing is served by the router's host.
        serving = [
            (one, "left", ()), (two, "right", ()), (two, "left", ("--standby",)), (one, "right", ("--standby",)),
        ]  # fmt: skip
        roles, stall = {}, Stall()
        # First those that serve: a standby that finds nobody within three seconds serves itself.
        for group in (serving[:2], serving[2:]):
            services = {}
            for host, stage, options in group:
                config = _config(folder / f"{host.name}-{stage}", folder / f"{host.name}.json5", stage, router)
                services[host.name, stage] = host.start(*cli, "serve", "--config", str(config), "--json", *options)
            roles |= {key: _line(process) for key, process in services.items()}
        for stage in STAGES:
            lab.start(
                *cli, "stage", "--free-run", "--name", stage, "--axis", "x", "--twins", "y", "--rate", str(RATE_HZ),
                "--batch", "5", "--endpoint", router, "--zenoh-config", str(folder / f"{stage}.json5"),
            )  # fmt: skip
        client = lab.start("-m", "tests.e2e.scale_client", str(folder), router)
        _line(client)
        told = {f"{h}/{s}": ready for (h, s), ready in roles.items()}
        seen: dict[str, Any] = {
            "roles": {key: ready["role"] for key, ready in told.items()},
            "epochs": {key: ready["epoch"] for key, ready in told.items()},
            "stalled_s": stall.end(),
        }
        time.sleep(BEFORE_S)
        lost_at = time.monotonic()
        one.lose()
        assert client.stdout is not None
        seen["client"] = json.loads(client.stdout.read().splitlines()[-1])
        seen["lost_at_s"] = lost_at
        return seen
    finally:
        for host in hosts:
            host.stop()


def _config(at: Path, zenoh_config: Path, stage: str, router: str) -> Path:
    at.mkdir()
    text = f'stage = "{stage}"\nlisten = []\nconnect = ["{router}"]\nzenoh_config = "{zenoh_config}"\n'
    for axis in AXES:
        meta = BundleMeta(stage, axis, 1.0 / RATE_HZ, y_min_um=0.0, y_max_um=90.0)
        write_bundle(at / f"{axis}.npz", make_models(1.0 / RATE_HZ), meta)
        text += (
            f'[[axis]]\nname = "{axis}"\nmodel = "{axis}.npz"\nu_min_V = 0.0\nu_max_V = 10.0\nslew_V_per_s = 2000.0\n'
        )
    path = at / "serve.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _line(process: Any) -> dict[str, Any]:
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"{process.args} ended with {process.wait()}")
    data: dict[str, Any] = json.loads(line)
    return data
