"""Hosts for a test: network namespaces on one bridge, or plain processes where the kernel does not allow those."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Any

NETWORK = "10.77.0"
#: Begins a command as the root of a network and of a process table of its own; all of it ends with the command.
ENTER = ("unshare", "-rnpf", "--mount-proc", "--kill-child")


def namespaces_missing() -> str:
    """Why network namespaces cannot be had here; empty where they can."""
    program = (
        "ip link add br0 type bridge && ip link set br0 up && "
        "unshare -n sleep 5 & sleep 0.3; "
        "ip link add v0 type veth peer name v1 netns $! && nsenter --net=/proc/$!/ns/net ip link set lo up; "
        "status=$?; kill $!; exit $status"
    )
    try:
        done = subprocess.run([*ENTER, "sh", "-c", program], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["refused"])[-1]


@dataclass
class Host:
    """A machine of its own, as far as the network goes, and what runs on it."""

    name: str
    number: int
    namespaces: bool
    running: list[subprocess.Popen[str]] = field(default_factory=list)
    _holder: subprocess.Popen[bytes] | None = None

    @property
    def address(self) -> str:
        return f"{NETWORK}.{self.number}" if self.namespaces else "127.0.0.1"

    def up(self) -> Host:
        """Make its namespace and its cable to the bridge ``hub``."""
        if not self.namespaces:
            return self
        self._holder = subprocess.Popen(["unshare", "-n", "sleep", "600"])
        net = f"/proc/{self._holder.pid}/ns/net"
        cable = f"hub-{self.name}"
        own = os.readlink("/proc/self/ns/net")
        while os.readlink(net) == own:  # until unshare has got there
            if self._holder.poll() is not None:
                raise RuntimeError("unshare -n ended")
        run("ip", "link", "add", cable, "type", "veth", "peer", "name", "eth0", "netns", str(self._holder.pid))
        run("ip", "link", "set", cable, "master", "hub", "up")
        for command in (
            ("ip", "addr", "add", f"{self.address}/24", "dev", "eth0"),
            ("ip", "link", "set", "eth0", "up"),
            ("ip", "link", "set", "lo", "up"),
        ):
            run("nsenter", f"--net={net}", *command)
        return self

    def start(self, *arguments: str, **options: Any) -> subprocess.Popen[str]:
        """``python`` with ``arguments`` on this host."""
        enter = () if self._holder is None else ("nsenter", f"--net=/proc/{self._holder.pid}/ns/net")
        process = subprocess.Popen([*enter, sys.executable, *arguments], text=True, stdout=subprocess.PIPE, **options)
        self.running.append(process)
        return process

    def lose(self) -> None:
        """The host is gone from one instant to the next: its cable is pulled first, so that it says no goodbye."""
        if self._holder is not None:
            run("ip", "link", "set", f"hub-{self.name}", "down")
        for process in self.running:
            process.kill()

    def stop(self) -> None:
        """End what runs here, and the namespace with it."""
        for process in self.running:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self.running:
            try:
                process.communicate(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
        if self._holder is not None:
            self._holder.kill()
            self._holder.wait()


def make_hub(namespaces: bool) -> None:
    """The bridge that all cables lead to."""
    if namespaces:
        run("ip", "link", "add", "hub", "type", "bridge")
        run("ip", "link", "set", "hub", "up")


def run(*command: str) -> None:
    """A command that must succeed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")
