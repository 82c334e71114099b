"""The controller of a soak as a process: it asks for voltages ahead of time and sends them until it is stopped.

``python -m dehyst.lab.soak.controller TASK.json ENDPOINT``. If no answer comes before a block is due, the stage holds
its last voltage and the controller goes on with the next block.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import zenoh

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.lab.testbed.processes import run_client_process
from dehyst.service.client.client import Client
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import Trajectory
from dehyst.service.runtime.session import open_client
from dehyst.service.runtime.stopping import StopSignal
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.security.lease import CommandLease
from dehyst.service.stage_node.node import status_key
from dehyst.sim.signals.references import BLEND_S, DemoReference, Sequenced, Tones
from dehyst.sim.signals.voltages import sample_times

# --- The task of the soak's controller: keys, limits, and the reference.

STAGE, AXIS = "soak", "x"
SERVED = "lssvm_adaptive"


@dataclass(frozen=True, slots=True)
class ControlTask:
    """What the controller does.

    Attributes
    ----------
    dt_s : sample time, s. low_um, high_um : range of the reference, µm. seed : of the reference.
    block, lead : samples per query, and samples that it is asked ahead.
    u_min_V, u_max_V, slew_V_per_s : limits that every voltage is checked against.
    """

    dt_s: float
    low_um: float
    high_um: float
    seed: int
    u_min_V: float
    u_max_V: float
    slew_V_per_s: float
    block: int = 20
    lead: int = 60

    @property
    def range_um(self) -> float:
        """Commanded range, µm, to which all percentages refer."""
        return self.high_um - self.low_um

    def allows(self, u_V: FloatArray, before_V: float) -> bool:
        """Whether an answer, (n,) V, keeps the service's promise: finite, within limits, within slew from the voltage
        ``before_V``, NaN for none."""
        if not np.isfinite(u_V).all():
            return False
        steps = np.abs(np.diff(u_V, prepend=before_V if math.isfinite(before_V) else u_V[0]))
        within = self.u_min_V <= u_V.min() and u_V.max() <= self.u_max_V
        return bool(within and steps.max() <= self.slew_V_per_s * self.dt_s * (1.0 + 1e-9))

    def write(self, path: Path) -> None:
        """Write the task for the processes of controller and prober."""
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> ControlTask:
        """The task that `write` has written."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))


# --- The reference

PERIOD_S = 120.0


@dataclass
class SoakReference:
    """A periodic reference by tick. Each period begins and ends at rest at ``low_um``."""

    dt_s: float
    low_um: float
    high_um: float
    seed: int

    def __post_init__(self) -> None:
        moving = DemoReference(PERIOD_S, self.low_um, self.high_um, self.seed)
        period = Sequenced(((PERIOD_S - 2.0 * BLEND_S, moving), (PERIOD_S, Tones(self.low_um))))
        motion = period.at(sample_times(PERIOD_S, self.dt_s))
        self._motion = np.stack((motion.y_um, motion.v_um_per_s, motion.a_um_per_s2))

    def rows(self, first: int, n: int) -> FloatArray:
        """(3, n) y µm, v µm/s, a µm/s² from tick ``first`` on."""
        return self._motion[:, np.arange(first, first + n) % self._motion.shape[1]]


#: Timeout of a query, s. The controller asks 60 ms ahead, so it does not wait longer.
TIMEOUT_S = 0.1
REPORT_S = 1.0
#: An answer that comes less than this many ticks before its block is due is not sent: it might reach the stage in the
#: middle of the block, and the voltage would jump.
MARGIN = 10
#: A sample number further ahead of the newest one than this is wrong.
STRAY = 30_000


class StageClock:
    """The stage's newest sample number and the first one since its start; filled by zenoh's thread."""

    def __init__(self, session: zenoh.Session) -> None:
        self.newest = -1
        self.first = -1
        self._moved = threading.Condition()
        keys = Keys(STAGE, AXIS)
        self._subscribers = [
            session.declare_subscriber(keys.sample, self._sample),
            session.declare_subscriber(status_key(STAGE, AXIS), self._status),
        ]

    def _sample(self, sample: zenoh.Sample) -> None:
        try:
            batch = wire.decode_samples(sample.payload.to_bytes())
        except InputError:
            # Another client sent this. The stage's own samples follow.
            return
        with self._moved:
            # A number far ahead is wrong: of the present start of the stage, the others go on where they were.
            near = batch.seq[(batch.seq >= self.first) & (batch.seq <= self.newest + STRAY)]
            if self.first >= 0 and near.size:
                self.newest = max(self.newest, int(near[-1]))
                self._moved.notify_all()

    def _status(self, sample: zenoh.Sample) -> None:
        status = json.loads(sample.payload.to_bytes())
        with self._moved:
            # A restarted stage waits for commands; a stage that runs is followed from its present tick.
            if self.first != status["first"]:
                self.first = status["first"]
                self.newest = self.first - 1 if status["state"] == "waiting" else status["tick"]
                self._moved.notify_all()

    def wait(self, first: int, seq: int, timeout_s: float) -> bool:
        """Wait until sample ``seq`` of the stage that began at ``first`` has come, or the stage has restarted."""
        with self._moved:
            return self._moved.wait_for(lambda: self.first != first or self.newest >= seq, timeout_s)

    def before(self, seq: int) -> bool:
        """Whether a command sent now reaches the stage before sample ``seq``."""
        return self.newest < max(seq - MARGIN, self.first)

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]


class Controller:
    """Asks for blocks and sends them; `run` returns when stopped. ``counts`` is printed every second."""

    def __init__(self, control: ControlTask, client: Client, session: zenoh.Session) -> None:
        self.control = control
        self.reference = SoakReference(control.dt_s, control.low_um, control.high_um, control.seed)
        self.counts = {"blocks": 0, "given_up": 0, "retries": 0, "errors": 0, "unsafe": 0}
        self._client = client
        self._session = session
        self._commands = CommandLease(session, Keys(STAGE, AXIS), own_authenticator())
        self._last_V = math.nan
        self._error = ""

    def run(self, stop: StopSignal) -> None:
        """Follow the stage's clock until stopped."""
        clock = StageClock(self._session)
        first, begin = -1, 0
        answer: Trajectory | None = None
        reported_s = time.monotonic()
        size, lead = self.control.block, self.control.lead
        try:
            while not stop.reason:
                if time.monotonic() - reported_s >= REPORT_S:
                    reported_s = time.monotonic()
                    print(json.dumps({**self.counts, "error": self._error}), flush=True)
                if clock.first != first:
                    first, answer, self._last_V = clock.first, None, math.nan
                    # Command a waiting stage from its first sample on, a running one from a little later on.
                    ahead = 0 if clock.newest < first else clock.newest + lead - first
                    begin = first + -(-ahead // size) * size
                if first < 0 or not clock.wait(first, begin - lead, 0.2) or clock.first != first:
                    continue
                if clock.newest - begin > lead:
                    # Too far behind to catch up block by block: continue ahead of the stage.
                    begin += -(-(clock.newest - begin) // size) * size + lead
                    answer = None
                answer = self._block(first, begin, answer, clock)
                begin += size
        finally:
            clock.close()
            self._commands.undeclare()

    def _block(self, first: int, begin: int, after: Trajectory | None, clock: StageClock) -> Trajectory | None:
        """Ask for a block and send it. None if no answer came before it was due."""
        size = self.control.block
        motion = self.reference.rows(begin - first, size)
        self.counts["blocks"] += 1
        with contextlib.suppress(zenoh.ZError):
            self._client.reference(begin, motion[0])
        while clock.first == first and clock.before(begin):
            try:
                answer = self._client.trajectory(
                    motion[0], motion[1], motion[2], after=after, begin=begin, u_before_V=self._last_V
                )
            except (ServiceError, InputError) as error:
                self.counts["errors" if isinstance(error, InputError) else "retries"] += 1
                self._error = str(error)
                time.sleep(0.002)
                continue
            if not clock.before(begin):
                break
            self.counts["unsafe"] += not self.control.allows(answer.u_V, self._last_V)
            self._last_V = float(answer.u_V[-1])
            with contextlib.suppress(zenoh.ZError):
                self._commands.put(wire.encode_command(begin, answer.u_V))
            return answer
        self.counts["given_up"] += 1
        return None


def run(task: ControlTask, endpoint: str) -> int:
    """Control the stage behind ``endpoint`` until stopped."""
    stop = StopSignal()
    with Client.connect(endpoint, STAGE, AXIS, timeout_s=TIMEOUT_S, retry_s=0.0, wait_s=30.0) as client:
        client.status()
        with open_client(endpoint, 10.0) as session:
            controller = Controller(task, client, session)
            print("ready", flush=True)
            controller.run(stop)
            print(json.dumps(controller.counts), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_client_process(lambda: run(ControlTask.read(Path(sys.argv[1])), sys.argv[2])))
