"""A simulated stage as a process: voltages in by sequence number, samples out in real time.

One process may hold several units: twins of one configuration and one seed, each with its own axis name and commands,
so that models are compared on the same stage with the same noise.

Tick k is due at ``start + k dt`` of a monotonic clock, computed from k and not summed. At each tick the sensor of
every unit is read, then the voltage with that sequence number is applied; if none came in time, the last one is held
and counted. A tick that begins a full period late is counted, and the loop catches up at once: no sample is left out.

In lock step the clock stands still while a voltage is missing, up to a limit. What controls the stage then gets the
same samples on a busy machine as on an idle one, only later.
"""

from __future__ import annotations

import contextlib
import gc
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import zenoh

from dehyst.service.answers.guard import limit_voltage
from dehyst.service.config.schema import Setting, check_bounds
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import LIMITED_SLEW
from dehyst.service.protocol.samples import MAX_SEQ, check_seq
from dehyst.service.runtime.session import SURELY
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.security.lease import CommandGate
from dehyst.service.stage_node.exchange import CommandBuffer, SampleRing, Sender
from dehyst.service.stage_node.faults import Injector, fault_key, sound_key
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage

# --- The node.

# --- One axis on the wire


def status_key(stage: str, axis: str) -> str:
    """Key of the stage node's own status, JSON at 1 Hz. The service's status is on ``.../status``."""
    return f"{Keys(stage, axis).base}/stage_status"


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """What a stage node does.

    Attributes
    ----------
    stage : the simulated stage with its changes. name : of the stage in keys.
    units : axis names in keys, one twin each.
    batch : samples per message; more if the network is slow.
    ticks : length of the run in ticks; None: until stopped.
    free_run : start at once instead of with the first commands.
    second : axis name in keys of the first unit's second axis; empty: that axis is held at 0 V.
    inject : accept faults on command, see `service.stage_node.faults`.
    first : number of the first sample; a restarted stage may begin at any number.
    slew_V_per_s : slew limit of the voltage, V/s, as a driver has one: a command that comes in the middle of its block
    then makes no jump.
    lock_step_s : longest time, s, for which the clock stands still until the voltages of a tick are there; then they
    count as missing, and the clock waits for the next ones only after a further command. 0: the clock never waits.

    Raises FieldError on values that do not fit.
    """

    stage: StageConfig
    name: str
    units: tuple[str, ...]
    batch: Annotated[int, Setting(low=1, high=10_000)] = 1
    ticks: Annotated[int | None, Setting(low=1)] = None
    free_run: bool = False
    second: str = ""
    inject: bool = False
    first: int = 0
    slew_V_per_s: float = math.inf
    lock_step_s: Annotated[float, Setting(unit="s", low=0.0, high=60.0)] = 0.0

    def __post_init__(self) -> None:
        if not self.units or len(set(self.units)) < len(self.units):
            raise FieldError("units", ", ".join(self.units) or "none", "one or more different axis names")
        for unit in self.units:
            Keys(self.name, unit)
        if self.second:
            Keys(self.name, self.second)
            if self.second in self.units:
                raise FieldError("second", self.second, "another name than those of the units")
            if self.stage.second_axis is None:
                raise FieldError("second", self.second, f"nothing: stage {self.stage.name!r} has one axis")
        check_bounds(self)
        check_seq("first", self.first)
        if not self.slew_V_per_s > 0.0:
            raise FieldError("slew_V_per_s", self.slew_V_per_s, "a positive limit in V/s")


class AxisPort:
    """One axis in the network: its commands, samples, publishers and faults."""

    def __init__(
        self, config: NodeConfig, axis: str, session: zenoh.Session, apply: Callable[[dict[str, float]], None]
    ) -> None:
        keys = Keys(config.name, axis)
        self.axis = axis
        self.limits = (config.stage.u_min_V, config.stage.u_max_V)
        # A step that equals the limit up to round-off is not limited, or it would differ from its command.
        self.step_V = config.slew_V_per_s * config.stage.dt_s * (1.0 + 1e-9)
        self.limited = 0
        self._u_V = 0.0
        self.commands = CommandBuffer(begin=config.first)
        self.injector = Injector(config.stage.dt_s, apply) if config.inject else None
        self._dt_s = config.stage.dt_s
        # Samples must not be lost: a full channel blocks the sender thread, not the loop, and drops nothing.
        publisher = session.declare_publisher(keys.sample, congestion_control=SURELY, express=True)
        by = own_authenticator()

        def put(*rows: Any) -> None:
            payload = wire.encode_samples(*rows)
            publisher.put(payload, attachment=by.published(keys.sample, payload))

        self.status = session.declare_publisher(status_key(config.name, axis))
        self.gate = CommandGate(session, keys, by, self.commands.receive)
        self._declared: list[Any] = [self.gate, publisher, self.status]
        self.rings = [SampleRing(put)]
        if self.injector is not None:
            receive = self.injector.receive
            self.rings = [SampleRing(put, self.injector.deliver, self.injector.flush)]
            sound = session.declare_publisher(sound_key(config.name, axis), express=True)
            self.rings.append(SampleRing(lambda *rows: sound.put(wire.encode_samples(*rows))))
            faults = session.declare_subscriber(fault_key(config.name, axis), lambda s: receive(s.payload.to_bytes()))
            self._declared += [faults, sound]

    def take(self, k: int) -> float:
        """The voltage for tick k, V, within range and slew limit."""
        self._u_V, flags = limit_voltage(self.commands.take(k), self._u_V, *self.limits, self.step_V)
        self.limited += bool(flags & LIMITED_SLEW)
        return self._u_V

    def write(self, k: int, u_V: float, y_um: float) -> None:
        """Write sample k: the voltage that the stage gets, and its reading."""
        ring, *sound = self.rings
        ring.write(k, k * self._dt_s, u_V, y_um if self.injector is None else self.injector.reading(k, y_um))
        for other in sound:
            other.write(k, k * self._dt_s, u_V, y_um)

    def summary(self) -> dict[str, Any]:
        summary: dict[str, Any] = {
            "published": self.rings[0].published,
            "lost": self.rings[0].lost,
            "slew_limited": self.limited,
            "commands": dict(self.commands.counts),
            "command": self.gate.to_json(),
            "error": self.commands.error,
        }
        if self.injector is not None:
            summary["faults"] = {**self.injector.counts, "error": self.injector.error}
        return summary

    def close(self) -> None:
        for declared in self._declared:
            declared.undeclare()


# --- The node

STATUS_S = 1.0


class _Unit:
    """One twin: the state of its stage, and a port for each axis that is driven."""

    def __init__(self, config: NodeConfig, stage: Stage, axis: str, second: str, session: zenoh.Session) -> None:
        self.stage = stage
        self.state = stage.initial_state()
        self.ports = [AxisPort(config, name, session, self._change) for name in (axis, second) if name]

    def _change(self, values: dict[str, float]) -> None:
        self.state = self.stage.with_changes(self.state, values)

    def step(self, k: int) -> None:
        """Read, then apply. The sample holds the voltage that the stage really gets."""
        applied_V = [port.take(k) for port in self.ports]
        # Of a stage with two axes of which one is driven, the other reading goes nowhere.
        readings_um = self.stage.step(self.state, *applied_V)
        for port, u_V, y_um in zip(self.ports, applied_V, readings_um, strict=False):
            port.write(k, u_V, y_um)


class StageNode:
    """Runs the units of a configuration on an open zenoh session; `run` returns the summary."""

    def __init__(self, config: NodeConfig, session: zenoh.Session) -> None:
        self.config = config
        self._stop = False
        stage = Stage(config.stage)
        self._units = [
            _Unit(config, stage, axis, config.second if axis == config.units[0] else "", session)
            for axis in config.units
        ]
        self._ports = [port for unit in self._units for port in unit.ports]
        self._sender = Sender([ring for port in self._ports for ring in port.rings], self._publish_status)
        self._counts: dict[str, Any] = {
            "state": "waiting", "first": config.first, "tick": config.first, "late": 0, "worst_late_ms": 0.0,
            "waited_s": 0.0,
        }  # fmt: skip

    def stop(self) -> None:
        """End the run at the next tick; callable from any thread or signal handler."""
        self._stop = True

    def summary(self) -> dict[str, Any]:
        """Ticks, late ticks, and per unit the counts of samples and commands so far."""
        return {**self._common(), "units": {port.axis: port.summary() for port in self._ports}}

    def _common(self) -> dict[str, Any]:
        return {"stage": self.config.name, "dt_s": self.config.stage.dt_s, **self._counts}

    def run(self, started: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Wait for the first commands of every unit (not in free run), then tick until the end or a stop.

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
        """Call everything that the loop calls once before the clock runs, on a state that is thrown away."""
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
        worst_s = waited_s = 0.0
        now, wake = time.perf_counter, self._sender.wake

        def count() -> None:
            self._counts.update(tick=k, late=late, worst_late_ms=1e3 * worst_s, waited_s=waited_s)

        start = now()
        while k < stop and not self._stop:
            due = start + waited_s + (k - first) * dt_s
            rest = due - now()
            if rest > 0.0:
                time.sleep(rest)
            behind = now() - due
            late += behind > dt_s
            worst_s = max(worst_s, behind)
            if self.config.lock_step_s:
                waited_s += self._wait_for_voltages(k)
            for unit in units:
                unit.step(k)
            k += 1
            if k % status_ticks == 0:
                count()
                wake(status=True)
            elif k % batch == 0:
                wake()
        count()
        self._counts["ran_s"] = now() - start

    def _wait_for_voltages(self, k: int) -> float:
        """Stand still until the voltages of tick ``k`` are there, up to the limit. Returns the time that took, s."""
        begin = time.perf_counter()
        for port in self._ports:
            while port.commands.lacks(k, begin + self.config.lock_step_s) and not self._stop:
                self._sender.wake()  # the controller may wait for the samples of a message that is not full yet
        return time.perf_counter() - begin

    def _publish_status(self) -> None:
        for port in self._ports:
            # A lost status is followed by another.
            with contextlib.suppress(zenoh.ZError):
                port.status.put(json.dumps({**self._common(), "axis": port.axis, **port.summary()}))
