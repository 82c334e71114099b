"""A router, two service hosts and a lab host with stages and clients; one service host is lost in the middle.

``python -m tests.e2e.scale_drill FOLDER [--processes]`` does it and prints one line of JSON. With namespaces it is to
be run inside ``unshare -rn``, where it is the root of a network of its own. Everything speaks TLS with
access control, made by the project's own command, because that is what ``dehyst serve`` asks for beyond loopback.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

from dehyst.service.security.access import Plan, create
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.e2e.scale_client import AXES, BEFORE_S, RATE_HZ, STAGES
from tests.e2e.scale_hosts import Host, make_hub
from tests.service.conftest import make_models, unused_port

USERS = {
    "relay": "router", "one": "service", "two": "service", "left": "stage", "right": "stage",
    "plot": "client", "loop": "controller", "alice": "operator",
}  # fmt: skip


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


def drill(folder: Path, namespaces: bool) -> dict[str, Any]:
    """Do it; returns what was seen."""
    make_hub(namespaces)
    relay, one, two, lab = (Host(name, 2 + i, namespaces) for i, name in enumerate(("relay", "one", "two", "lab")))
    hosts = [relay, one, two, lab]
    try:
        for host in hosts:
            host.up()
        router = f"tls/{relay.address}:{unused_port()}"
        create(folder, Plan(USERS, (relay.address,), {"left": "left", "right": "right"}))
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
        _say("services started")
        for stage in STAGES:
            lab.start(
                *cli, "stage", "--free-run", "--name", stage, "--axis", "x", "--twins", "y", "--rate", str(RATE_HZ),
                "--batch", "5", "--endpoint", router, "--zenoh-config", str(folder / f"{stage}.json5"),
            )  # fmt: skip
        client = lab.start("-m", "tests.e2e.scale_client", str(folder), router)
        _line(client)
        _say("the client is answered by every axis")
        told = {f"{h}/{s}": ready for (h, s), ready in roles.items()}
        seen: dict[str, Any] = {
            "namespaces": namespaces,
            "roles": {key: ready["role"] for key, ready in told.items()},
            "epochs": {key: ready["epoch"] for key, ready in told.items()},
            "stalled_s": stall.end(),
        }
        time.sleep(BEFORE_S)
        lost_at = time.monotonic()
        _say("host one is lost")
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


def _say(what: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {what}", file=sys.stderr, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--processes", action="store_true", help="plain processes instead of namespaces")
    args = parser.parse_args()
    print(json.dumps(drill(args.folder, not args.processes)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
