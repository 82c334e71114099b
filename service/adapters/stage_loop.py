"""Runs a real stage beside a service: reads, applies, publishes, one sample each sample time."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray
from dehyst.service.adapters.adapter import AdapterError, StageAdapter, Ticks, asked, check_range
from dehyst.service.answers.guard import limit_voltage
from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import FieldError
from dehyst.service.stage_node.exchange import CommandBuffer, SampleRing, Sender

#: (sample number, reading at that instant, µm) -> voltage from that instant on, V.
Control = Callable[[int, float], float]
#: Relative difference of two sample times from which they count as different.
_SAME_RATE: Final = 1e-6


@dataclass(frozen=True, slots=True)
class LoopSummary:
    """What a run did.

    Attributes
    ----------
    samples : taken. late : sample times at which the loop was too late (by a quarter of a sample time): they are no
        samples. worst_late_ms : largest lateness of a sample time, ms.
    limited : voltages that were not finite, or changed by the limits of voltage or slew rate.
    published, lost : samples by the network.
    missing : voltages that the network had not brought in time.
    foreign : commands that were left out because another controller owns ``.../command``.
    """

    samples: int
    late: int
    worst_late_ms: float
    limited: int
    published: int
    lost: int
    missing: int
    foreign: int


class StageLoop:
    """Turns an adapter into the stage of one axis of a service.

    At each sample time the position is read, then the voltage of that sample is applied. The sample (number, time,
    applied voltage, reading) is published by a thread of its own, so that a slow network delays no reading. A sample
    that is read too late is not published, because the service would learn a position that belongs to another time.
    Every voltage is kept within the limits of the adapter and of the service, and within the slew limit from the
    voltage that was applied before the run.

    Parameters
    ----------
    adapter : the stage. Its rate must be that of the served model; raises FieldError where it is not.
    client : connected to the axis; the loop only publishes with it, so that another thread may query.
    first : number of the first sample; None continues after the last one that the service has handled.
    """

    def __init__(self, adapter: StageAdapter, client: Client, first: int | None = None) -> None:
        low_V, high_V = check_range(adapter)
        limits = client.limits
        self.dt_s = client.dt_s
        if abs(adapter.rate_Hz * self.dt_s - 1.0) > _SAME_RATE:
            raise FieldError(
                "rate_Hz", f"{adapter.rate_Hz:g} Hz", f"{1 / self.dt_s:g} Hz, the rate of the served model",
                "record and identify at the rate at which the stage runs",
            )  # fmt: skip
        self._low_V, self._high_V = max(low_V, limits.u_min_V), min(high_V, limits.u_max_V)
        if not self._low_V < self._high_V:
            raise FieldError(
                "u_min_V, u_max_V", f"{low_V:g} to {high_V:g} V of the adapter",
                f"a range that overlaps {limits.u_min_V:g} to {limits.u_max_V:g} V of the service",
            )  # fmt: skip
        self.first = int(client.status()["seq"]) + 1 if first is None else first
        self._step_V = limits.slew_V_per_s * self.dt_s
        self._adapter, self._client = adapter, client
        self._next = self.first
        self._stop = False
        self._limited = 0
        self._log = SampleRing(client.samples)
        self._commands = CommandBuffer(begin=self.first)

    def stop(self) -> None:
        """End the run before the next sample; callable from any thread or signal handler."""
        self._stop = True

    def measured(self, seq: int) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
        """(numbers, voltages V, readings µm), (n,) each, of the last samples from number ``seq`` on.

        Half a minute of them is kept at 1 kHz. For ``Follower.resynchronise``, and for a controller that closes a loop.
        """
        return self._log.since(seq)

    def run(self, control: Control | None = None, samples: int | None = None) -> LoopSummary:
        """Run until ``samples`` sample times have passed, :meth:`stop` or an error; then the last voltage stays.

        Parameters
        ----------
        control : gives the voltage of each sample. None: the voltages published on ``.../command``; until the first
            one comes, the stage keeps its voltage.

        Raises AdapterError where the stage does not answer, and what ``control`` raises. Samples taken until then are
        published.
        """
        subscriber = None if control is not None else self._client.subscribe_commands(self._commands.receive)
        sender = Sender([self._log])
        ticks = Ticks(1.0 / self.dt_s, samples, lambda: self._stop)
        begin = self._next
        gc.collect()
        try:
            u_V = asked(self._adapter.applied_V)
            if not math.isfinite(u_V):
                raise AdapterError(f"applied_V: got {u_V}, expected the voltage that is applied now, in V")
            self._commands.hold(u_V)
            for k, t_s, late in ticks:
                seq = begin + k
                y_um = asked(self._adapter.read_um)
                u_V = self._limit(self._commanded(seq) if control is None else control(seq, y_um), u_V)
                asked(self._adapter.write_V, u_V)
                self._next = seq + 1
                if not late:
                    self._log.write(seq, begin * self.dt_s + t_s, u_V, y_um)
                    sender.wake()
        finally:
            sender.close()
            if subscriber is not None:
                subscriber.undeclare()
        return LoopSummary(
            self._log.written, ticks.late, 1e3 * ticks.worst_late_s, self._limited,
            self._log.published, self._log.lost, self._commands.counts["missing"],
            0 if subscriber is None else subscriber.foreign,
        )  # fmt: skip

    def _commanded(self, seq: int) -> float:
        """The voltage that was published for sample ``seq``; where none was, the last one before."""
        for k in range(self._next, seq):
            self._commands.take(k)
        return self._commands.take(seq)

    def _limit(self, wanted_V: float, before_V: float) -> float:
        u_V, flags = limit_voltage(wanted_V, before_V, self._low_V, self._high_V, self._step_V)
        self._limited += flags != 0
        return u_V
