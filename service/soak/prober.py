"""A second client of a soak as a process: asks for points and a bare echo in turns, and follows the model.

``python -m service.soak.prober CONTROL.json ENDPOINT`` prints a line of JSON every second: round trips in µs, how long
nobody answered, voltages that were not as promised, and with every query how old the followed model was.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.errors import DehystError, InputError
from service.client import Client, Point
from service.errors import ServiceError
from service.session import open_client
from service.soak.control import AXIS, STAGE, Control
from service.soak.extras import ECHO_KEY
from service.stopping import StopSignal
from service.wire_query import encode_query
from service.wire_reply import FeedforwardReply, encode_reply

#: Pause between two rounds of one query and one echo, s; and the time-out of both.
PAUSE_S, TIMEOUT_S = 0.01, 0.1


class Prober:
    """What is counted in a second, and the questions."""

    def __init__(self, control: Control, client: Client, echo: Any, payload: bytes) -> None:
        self._control, self._client, self._echo, self._payload = control, client, echo, payload
        self._last: Point | None = None
        self._answered_s = time.monotonic()
        self._clear()

    def _clear(self) -> None:
        self.told: dict[str, Any] = {
            "service_us": [], "echo_us": [], "failed": 0, "refused": 0, "unsafe": 0, "silent_s": 0.0,
            "fallback": 0, "error": "", "ages_s": [],
        }  # fmt: skip

    def ask(self) -> None:
        """One point; what is wrong with the answer is counted."""
        c, told = self._control, self.told
        y_um = 0.5 * (c.low_um + c.high_um)
        before = self._last
        begin = time.perf_counter()
        try:
            point = self._client.point(y_um, after=before)
        except InputError as error:
            told["unsafe"] += 1
            told["error"] = str(error)
            return
        except ServiceError as error:
            told["failed"] += 1
            told["error"] = str(error)
            # A memory that no longer fits is asked for anew.
            self._last = None
            return
        told["service_us"].append(round(1e6 * (time.perf_counter() - begin), 1))
        now = time.monotonic()
        told["silent_s"] = max(told["silent_s"], now - self._answered_s)
        self._answered_s = now
        told["fallback"] += point.fallback
        step_V = c.slew_V_per_s * c.dt_s
        safe = math.isfinite(point.u_V) and c.u_min_V <= point.u_V <= c.u_max_V
        if before is not None:
            safe = safe and abs(point.u_V - before.u_V) <= step_V * (1.0 + 1e-9)
        told["unsafe"] += not safe
        self._last = point

    def echo(self) -> None:
        """The bare round trip of as many bytes there and back."""
        begin = time.perf_counter()
        for reply in self._echo.get(payload=self._payload):
            if reply.ok is not None:
                reply.ok.payload.to_bytes()
                self.told["echo_us"].append(round(1e6 * (time.perf_counter() - begin), 1))

    def look(self, age_s: float) -> None:
        """At the age of the followed model, s."""
        self.told["ages_s"].append(round(age_s, 4))

    def report(self) -> str:
        """The second's line, and a new second."""
        # A silence that has not ended is told too.
        self.told["silent_s"] = round(max(self.told["silent_s"], time.monotonic() - self._answered_s), 4)
        line = json.dumps({"t_s": round(time.monotonic(), 3), **self.told})
        self._clear()
        return line


def main(argv: list[str]) -> int:
    """Entry of the process. Returns its exit status."""
    stop = StopSignal()
    sys.setswitchinterval(5e-5)
    control = Control(**json.loads(Path(argv[0]).read_text(encoding="utf-8")))
    try:
        with Client.connect(argv[1], STAGE, AXIS, timeout_s=TIMEOUT_S, retry_s=0.0, wait_s=30.0) as client:
            first = client.point(0.5 * (control.low_um + control.high_um))
            payload = encode_query([0.0], [0.0], [0.0], memory=first.memory, model=first.model)
            nothing = FeedforwardReply(
                np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.uint8), first.memory, 0, first.model
            )
            size = len(encode_reply(nothing))
            with open_client(argv[1], 10.0) as session:
                echo = session.declare_querier(f"{ECHO_KEY}/{size}", timeout=TIMEOUT_S, express=True)
                prober = Prober(control, client, echo, payload)
                follower = client.follow()
                print("ready", flush=True)
                next_s = time.monotonic() + 1.0
                while not stop.reason:
                    prober.ask()
                    prober.echo()
                    time.sleep(PAUSE_S)
                    prober.look(follower.age_s)
                    if time.monotonic() >= next_s:
                        next_s += 1.0
                        print(prober.report(), flush=True)
                echo.undeclare()  # type: ignore[no-untyped-call]
    except DehystError as error:
        print(json.dumps({"fatal": str(error)}), flush=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
