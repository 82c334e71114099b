"""One axis of a stage node on the wire, and the configuration of the node."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from service.protocol.errors import FieldError
from service.protocol.keys import Keys
from service.protocol.samples import check_seq
from service.runtime.delivery import SURELY
from service.stage_node.commands import CommandBuffer
from service.stage_node.faults import Injector, fault_key
from service.stage_node.sender import SampleRing
from sim.stage.config import StageConfig


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
    second : axis name on the wire of the first unit's second axis; empty: that axis is held at 0 V.
    inject : take faults on command, see `service.stage_node.faults`.
    first : number of the first sample; a stage that is started anew may count from where it likes.
    slew_V_per_s : the voltage follows its commands no faster than this, V/s, as a driver limits it; a command that
    comes when its time is half over then makes no jump.
    """

    stage: StageConfig
    name: str
    units: tuple[str, ...]
    batch: int = 1
    ticks: int | None = None
    free_run: bool = False
    second: str = ""
    inject: bool = False
    first: int = 0
    slew_V_per_s: float = math.inf

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
        if not 1 <= self.batch <= 10_000:
            raise FieldError("batch", self.batch, "1 to 10000 samples a message")
        check_seq("first", self.first)
        if not self.slew_V_per_s > 0.0:
            raise FieldError("slew_V_per_s", self.slew_V_per_s, "a positive limit in V/s")
        if self.ticks is not None and self.ticks < 1:
            raise FieldError("ticks", self.ticks, "at least 1")


class Port:
    """One axis on the wire: its commands, its samples on their way, its publishers, the faults it suffers."""

    def __init__(
        self, config: NodeConfig, axis: str, session: zenoh.Session, apply: Callable[[dict[str, float]], None]
    ) -> None:
        keys = Keys(config.name, axis)
        self.axis = axis
        self.limits = (config.stage.u_min_V, config.stage.u_max_V)
        self.step_V = config.slew_V_per_s * config.stage.dt_s
        self.limited = 0
        self._u_V = 0.0
        self.commands = CommandBuffer(begin=config.first)
        self.injector = Injector(config.stage.dt_s, apply) if config.inject else None
        # Samples must not be lost: a full channel holds the sender up, not the loop, and drops nothing.
        self._publisher = session.declare_publisher(keys.sample, congestion_control=SURELY, express=True)
        self.ring = SampleRing(config.stage.dt_s, self._publisher.put, self.injector, config.first)
        self.status = session.declare_publisher(status_key(config.name, axis))
        self._subscribers = [session.declare_subscriber(keys.command, self._received)]
        if self.injector is not None:
            self._subscribers.append(session.declare_subscriber(fault_key(config.name, axis), self._hurt))

    def _received(self, sample: zenoh.Sample) -> None:
        self.commands.receive(sample.payload.to_bytes())

    def _hurt(self, sample: zenoh.Sample) -> None:
        assert self.injector is not None
        self.injector.receive(sample.payload.to_bytes())

    def take(self, k: int) -> float:
        """The voltage for tick k, V, as the stage clamps it."""
        low, high = self.limits
        wanted = min(max(self.commands.take(k), low), high)
        # What stands at the limit by round-off alone is not limited, or it would differ from its command.
        step = self.step_V * (1.0 + 1e-9)
        u_V = min(max(wanted, self._u_V - step), self._u_V + step)
        self.limited += u_V != wanted
        self._u_V = u_V
        return u_V

    def write(self, k: int, u_V: float, y_um: float) -> None:
        """Sample k: the voltage that the stage really gets, and what its sensor says."""
        self.ring.write(k, u_V, y_um if self.injector is None else self.injector.reading(k, y_um))

    def summary(self) -> dict[str, Any]:
        told = {
            "published": self.ring.published,
            "lost": self.ring.lost,
            "slew_limited": self.limited,
            "commands": dict(self.commands.counts),
            "error": self.commands.error,
        }
        if self.injector is not None:
            told["faults"] = {**self.injector.counts, "error": self.injector.error}
        return told

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._publisher.undeclare()  # type: ignore[no-untyped-call]
        self.status.undeclare()  # type: ignore[no-untyped-call]
