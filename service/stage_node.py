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
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from service import wire
from service.errors import FieldError
from service.keys import Keys
from service.stage_commands import CommandBuffer
from service.stage_sender import SampleRing, Sender
from sim.stage import Stage, StageConfig

STATUS_S = 1.0


def status_key(stage: str, axis: str) -> str:
    """Where a stage node says how it is, 1 Hz: JSON. Apart from ``.../status``, which is the service's."""
    return f"{Keys(stage, axis).base}/stage_status"


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """What a stage node does.

    Attributes
    ----------
    stage : the simulated stage, its changes included. name : of the stage on the wire.
    units : axis names on the wire, one twin each.
    batch : samples per message; more where the wire is slow.
    ticks : how long, in ticks; None: until stopped.
    free_run : start at once instead of with the first commands.
    """

    stage: StageConfig
    name: str
    units: tuple[str, ...]
    batch: int = 1
    ticks: int | None = None
    free_run: bool = False

    def __post_init__(self) -> None:
        if not self.units or len(set(self.units)) < len(self.units):
            raise FieldError("units", ", ".join(self.units) or "none", "one or more different axis names")
        for unit in self.units:
            Keys(self.name, unit)
        if not 1 <= self.batch <= 10_000:
            raise FieldError("batch", self.batch, "1 to 10000 samples a message")
        if self.ticks is not None and self.ticks < 1:
            raise FieldError("ticks", self.ticks, "at least 1")


class _Unit:
    """One twin: its state, its commands, its samples on their way, its publishers."""

    def __init__(self, config: NodeConfig, stage: Stage, axis: str, session: zenoh.Session) -> None:
        keys = Keys(config.name, axis)
        self.axis = axis
        self.stage = stage
        self.state = stage.initial_state()
        self.limits = (config.stage.u_min_V, config.stage.u_max_V)
        self.commands = CommandBuffer()
        # Samples must not be lost: a full channel holds the sender up, not the loop, and drops nothing.
        block = zenoh.CongestionControl.BLOCK
        self.publisher = session.declare_publisher(keys.sample, congestion_control=block, express=True)
        self.ring = SampleRing(config.stage.dt_s, self.publisher.put)
        self.status = session.declare_publisher(status_key(config.name, axis))
        self.subscriber = session.declare_subscriber(keys.command, self._received)

    def _received(self, sample: zenoh.Sample) -> None:
        self.commands.receive(sample.payload.to_bytes())

    def step(self, k: int) -> None:
        """Read, then apply: the sample's voltage is the one that the stage really gets."""
        low, high = self.limits
        u_V = min(max(self.commands.take(k), low), high)
        self.ring.write(k, u_V, self.stage.step(self.state, u_V)[0])

    def summary(self) -> dict[str, Any]:
        return {
            "published": self.ring.published,
            "lost": self.ring.lost,
            "commands": dict(self.commands.counts),
            "error": self.commands.error,
        }

    def close(self) -> None:
        self.subscriber.undeclare()  # type: ignore[no-untyped-call]
        self.publisher.undeclare()  # type: ignore[no-untyped-call]
        self.status.undeclare()  # type: ignore[no-untyped-call]


class StageNode:
    """Runs the units of a configuration on an open zenoh session; :meth:`run` returns the summary."""

    def __init__(self, config: NodeConfig, session: zenoh.Session) -> None:
        self.config = config
        self._stop = threading.Event()
        stage = Stage(config.stage)
        self._units = [_Unit(config, stage, axis, session) for axis in config.units]
        self._sender = Sender([unit.ring for unit in self._units], self._publish_status)
        self._counts: dict[str, Any] = {"state": "waiting", "tick": 0, "late": 0, "worst_late_ms": 0.0}

    def stop(self) -> None:
        """End the run at the next tick; from any thread or signal handler."""
        self._stop.set()

    def summary(self) -> dict[str, Any]:
        """What happened so far: ticks, late ones, and per unit samples published and commands counted."""
        units = {unit.axis: unit.summary() for unit in self._units}
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
            for unit in self._units:
                unit.close()
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
        while not all(unit.commands.first.is_set() for unit in self._units):
            if self._stop.is_set():
                return False
            if time.monotonic() - said >= STATUS_S:
                said = time.monotonic()
                self._sender.wake(status=True)
            missing = next((u for u in self._units if not u.commands.first.is_set()), None)
            if missing is not None:
                missing.commands.first.wait(0.02)
        return True

    def _loop(self) -> None:
        dt_s, batch, units = self.config.stage.dt_s, self.config.batch, self._units
        ticks = self.config.ticks if self.config.ticks is not None else 2**62
        status_ticks = max(1, round(STATUS_S / dt_s))
        k = late = 0
        worst_s = 0.0
        now, stopped, wake = time.perf_counter, self._stop.is_set, self._sender.wake
        start = now()
        while k < ticks and not stopped():
            due = start + k * dt_s
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
        for unit in self._units:
            # A status that does not get through is followed by another.
            with contextlib.suppress(zenoh.ZError):
                unit.status.put(json.dumps({**common, "axis": unit.axis, **unit.summary()}))
