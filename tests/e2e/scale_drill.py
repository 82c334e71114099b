"""A router, two service hosts and a lab host with stages and clients; one service host is lost in the middle.

``python -m tests.e2e.scale_drill FOLDER [--processes]`` does it and prints one line of JSON. With namespaces it is to
be run inside ``unshare -rn``, where it is the root of a network of its own. Everything speaks TLS with passwords and
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

from service.access.files import Plan, create
from service.client import Client
from service.errors import ServiceError
from service.keys import Keys
from service.modelfile import BundleMeta, write_bundle
from service.operating.remote import operate, statuses
from service.session import open_client
from tests.e2e.scale_hosts import Host, make_hub
from tests.service.conftest import make_models, unused_port

RATE_HZ = 100
STAGES = ("left", "right")
AXES = ("x", "y")
_BEFORE_S, _AFTER_S = 2.0, 4.0
USERS = {
    "relay": "router", "one": "service", "two": "service", "left": "stage", "right": "stage",
    "plot": "client", "alice": "operator",
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
        cli = ("-m", "service.cli")
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
        client = lab.start("-m", "tests.e2e.scale_drill", str(folder), "--ask", router)
        _line(client)
        _say("the client is answered by every axis")
        told = {f"{h}/{s}": ready for (h, s), ready in roles.items()}
        seen: dict[str, Any] = {
            "namespaces": namespaces,
            "roles": {key: ready["role"] for key, ready in told.items()},
            "epochs": {key: ready["epoch"] for key, ready in told.items()},
            "stalled_s": stall.end(),
        }
        time.sleep(_BEFORE_S)
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


def ask(folder: Path, router: str) -> int:
    """The client on the lab's host: every axis twenty times a second, and what it was told."""
    config = folder / "plot.json5"
    told: dict[str, list[tuple[float, float, float | None, str]]] = {}
    clients = {(stage, axis): _connected(router, stage, axis, config) for stage in STAGES for axis in AXES}
    with open_client(router, zenoh_config=config) as session:
        before = _short(statuses(session, timeout_s=1.0))
    print(json.dumps({"ready": True}), flush=True)
    start = time.monotonic()
    for k in range(int(20 * (_BEFORE_S + _AFTER_S))):
        time.sleep(max(0.0, start + k / 20 - time.monotonic()))
        for (stage, axis), client in clients.items():
            at = time.monotonic()
            u_V, failure = None, ""
            try:
                u_V = client.point(40.0, model="linear").u_V
            except ServiceError as error:
                failure = type(error).__name__
            told.setdefault(f"{stage}/{axis}", []).append((at, time.monotonic() - at, u_V, failure))
    for client in clients.values():
        client.close()
    with open_client(router, zenoh_config=config) as session:
        after = _short(statuses(session, timeout_s=1.0))
    with open_client(router, zenoh_config=folder / "alice.json5") as session:
        done = operate(session, Keys("left", "x"), "freeze", "alice")
    print(json.dumps({"asked": told, "before": before, "after": after, "operated": done}), flush=True)
    return 0


def _connected(router: str, stage: str, axis: str, config: Path) -> Client:
    """A client that has been answered once."""
    until = time.monotonic() + 20.0
    while True:
        try:
            return Client.connect(router, stage, axis, timeout_s=0.5, wait_s=10.0, zenoh_config=config)
        except ServiceError:
            if time.monotonic() >= until:
                raise


def _short(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"stage": s["stage"], "axis": s["axis"], "instance": s["instance"], "role": s["role"], "seq": s["seq"],
         "received": s["samples"]["received"]}
        for s in found
    ]  # fmt: skip


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
    parser.add_argument("--ask", metavar="ENDPOINT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.ask:
        return ask(args.folder, args.ask)
    print(json.dumps(drill(args.folder, not args.processes)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
