"""A simulated stage as a process: voltages in by sequence number, samples out in real time.

One process may hold several *units*: twins of one configuration and one seed, each driven by commands of its own
under its own axis name, so that models are compared on the same stage with the same noise.

Tick k is due at ``start + k dt`` by a monotonic clock, computed from k and never summed. At a tick every unit's
sensor is read, then the voltage with that sequence number is applied; where none has come in time, the last one is
held and counted. A tick that begins a full period late is counted and made up for at once: no sample is left out.
"""

from __future__ import annotations

import contextlib
import gc
import json
import math
import time
from collections.abc import Callable
from typing import Any

import zenoh

from service.protocol import samples as wire
from service.protocol.samples import MAX_SEQ
from service.stage_node.port import NodeConfig, Port, status_key
from service.stage_node.sender import Sender
from sim.stage.stage import Stage

STATUS_S = 1.0

__all__ = ["NodeConfig", "StageNode", "status_key"]


class _Unit:
    """One stage: its state, and a port for each axis that is driven."""

    def __init__(self, config: NodeConfig, stage: Stage, axis: str, second: str, session: zenoh.Session) -> None:
        self.stage = stage
        self.state = stage.initial_state()
        self.ports = [Port(config, name, session, self._change) for name in (axis, second) if name]

    def _change(self, values: dict[str, float]) -> None:
        self.state = self.stage.with_changes(self.state, values)

    def step(self, k: int) -> None:
        """Read, then apply: the sample's voltage is the one that the stage really gets."""
        if len(self.ports) == 1:
            port = self.ports[0]
            u_V = port.take(k)
            port.write(k, u_V, self.stage.step(self.state, u_V)[0])
            return
        u_V, u2_V = (port.take(k) for port in self.ports)
        for port, applied, y_um in zip(self.ports, (u_V, u2_V), self.stage.step(self.state, u_V, u2_V), strict=True):
            port.write(k, applied, y_um)


class StageNode:
    """Runs the units of a configuration on an open zenoh session; :meth:`run` returns the summary."""

    def __init__(self, config: NodeConfig, session: zenoh.Session) -> None:
        self.config = config
        self._stop = False
        stage = Stage(config.stage)
        self._units = [
            _Unit(config, stage, axis, config.second if axis == config.units[0] else "", session)
            for axis in config.units
        ]
        self._ports = [port for unit in self._units for port in unit.ports]
        self._sender = Sender([port.ring for port in self._ports], self._publish_status)
        self._counts: dict[str, Any] = {
            "state": "waiting", "first": config.first, "tick": config.first, "late": 0, "worst_late_ms": 0.0
        }  # fmt: skip

    def stop(self) -> None:
        """End the run at the next tick; from any thread or signal handler."""
        self._stop = True

    def summary(self) -> dict[str, Any]:
        """What happened so far: ticks, late ones, and per unit samples published and commands counted."""
        units = {port.axis: port.summary() for port in self._ports}
        return {
            "stage": self.config.name,
            "dt_s": self.config.stage.dt_s,
            **self._counts,
            "units": units,
        }

    def run(self, started: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Wait for the first commands of every unit (or not, in free run), then tick until the end or a stop.

        ``started`` is called when the clock starts. Returns the summary; the session stays open.
        """
        try:
            self._warm()
            if self.config.free_run or self._wait_for_commands():
                self._counts["state"] = "running"
                started()
                self._loop()
        finally:
            self._counts["state"] = "stopped"
            self._sender.wake(status=True)
            self._sender.close()
            for port in self._ports:
                port.close()
        return self.summary()

    def _warm(self) -> None:
        """Everything the loop calls is called once before the clock runs, on a state that is thrown away."""
        unit = self._units[0]
        state = unit.state.copy()
        for _ in range(50):
            unit.stage.step(state, 0.0)
        for _, values in self.config.stage.changes:
            state = unit.stage.with_changes(state, values)
        wire.encode_samples([0], [0.0], [0.0], [0.0])
        gc.collect()
        gc.freeze()

    def _wait_for_commands(self) -> bool:
        said = -math.inf
        while not all(port.commands.first.is_set() for port in self._ports):
            if self._stop:
                return False
            if time.monotonic() - said >= STATUS_S:
                said = time.monotonic()
                self._sender.wake(status=True)
            missing = next((p for p in self._ports if not p.commands.first.is_set()), None)
            if missing is not None:
                missing.commands.first.wait(0.02)
        return True

    def _loop(self) -> None:
        dt_s, batch, units = self.config.stage.dt_s, self.config.batch, self._units
        first = self.config.first
        stop = first + self.config.ticks if self.config.ticks is not None else MAX_SEQ
        status_ticks = max(1, round(STATUS_S / dt_s))
        k, late = first, 0
        worst_s = 0.0
        now, wake = time.perf_counter, self._sender.wake
        start = now()
        while k < stop and not self._stop:
            due = start + (k - first) * dt_s
            rest = due - now()
            if rest > 0.0:
                time.sleep(rest)
            behind = now() - due
            if behind > dt_s:
                late += 1
            worst_s = max(worst_s, behind)
            for unit in units:
                unit.step(k)
            k += 1
            if k % status_ticks == 0:
                self._counts.update(tick=k, late=late, worst_late_ms=1e3 * worst_s)
                wake(status=True)
            elif k % batch == 0:
                wake()
        self._counts.update(tick=k, late=late, worst_late_ms=1e3 * worst_s)

    def _publish_status(self) -> None:
        common = {"stage": self.config.name, "dt_s": self.config.stage.dt_s, **self._counts}
        for port in self._ports:
            # A status that does not get through is followed by another.
            with contextlib.suppress(zenoh.ZError):
                port.status.put(json.dumps({**common, "axis": port.axis, **port.summary()}))
