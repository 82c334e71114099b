"""A simulated PI controller: answers GCS commands over TCP as a piezo controller does, with a simulated stage behind.

    python -m dehyst.service.adapters.simulated_pi                      # at 127.0.0.1, port 50000; Ctrl-C ends it
    python -m dehyst.service.adapters.simulated_pi --gain-drop 60:0.06  # the gain drops by 6 % after 60 s of motion
    python -m dehyst.service.adapters.simulated_pi --fault sign         # one of the faults that `dehyst commission`
    names

For the tutorial and the tests of `service.adapters.pi`. The stage is the preset ``rich`` behind an amplifier of 10 V/V:
89 µm for 0 to 80 V, with 12 % hysteresis, creep, a mode at 450 Hz, drift and 5 nm of noise. It moves in real time.

Sources: documentation of PI's General Command Set (GCS 2.0), for the commands and the error codes used here.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import select
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

IDENTITY: Final = "simulated, E-709.CRG, 0, 1.0"
#: Error codes of GCS.
UNKNOWN_COMMAND, SERVO_IS_ON, UNKNOWN_AXIS, OUT_OF_LIMITS = 2, 5, 15, 302
#: Volts at the piezo for a volt at the simulated stage.
AMPLIFIER: Final = 10.0
#: Longest time that the stage is simulated at once, s: after a longer pause between requests it is at rest.
_CATCH_UP_S: Final = 1.0
_POLL_S: Final = 0.005
#: Travel that the controller states, µm; share of the distance that its servo goes in a step of the stage.
TRAVEL_UM: Final = 100.0
_SERVO_SHARE: Final = 0.1


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with the stage, its sensor or its controller.

    scale : of all readings. top_um : the stage stops there, µm. noise : factor of the sensor's noise. servo : it cannot
    be switched off; ``hidden`` : it answers that it is off, and takes voltages for targets. drop_s : the connection
    ends this long after the first voltage, s.
    """

    scale: float = 1.0
    top_um: float = math.inf
    noise: float = 1.0
    servo: bool = False
    hidden: bool = False
    drop_s: float = math.inf


#: Faults by name, for ``--fault`` and the tests of `service.commissioning.commission`.
FAULTS: Final = {
    "sign": Fault(scale=-1.0),
    "unit": Fault(scale=1000.0),
    "limit": Fault(top_um=60.0),
    "noise": Fault(noise=50.0),
    "servo": Fault(servo=True),
    "hidden-servo": Fault(servo=True, hidden=True),
    "disconnect": Fault(drop_s=8.0),
}


class SimulatedPi:
    """The controller: axis "1" with piezo channel 1. :meth:`answer` takes a command line and returns the reply.

    ``drop`` is the share by which the gain of the stage drops ``drop_after_s`` after the first voltage.
    """

    def __init__(self, drop_after_s: float = math.inf, drop: float = 0.0, fault: Fault | None = None) -> None:
        self._stage = Stage(preset("rich"))
        self._state = self._stage.initial_state()
        self._fault = fault or Fault()
        if self._fault.noise != 1.0:
            rms_um = 0.0065 * self._fault.noise
            self._state = self._stage.with_changes(self._state, {"sensor_noise.rms_um": rms_um})
        config = self._stage.config
        self._dt_s = config.dt_s
        self._low_V, self._high_V = AMPLIFIER * config.u_min_V, AMPLIFIER * config.u_max_V
        self._drop_after_s, self._drop = drop_after_s, drop
        self._u_V = self._held_V = self._reading_um = 0.0
        self._servo, self._error = True, 0
        self._first_s = math.inf
        self._steps, self._start_s = 0, time.perf_counter()

    def advance(self) -> None:
        """Let the stage move until now."""
        now_s = time.perf_counter()
        due = int((now_s - self._start_s) / self._dt_s)
        self._steps = max(self._steps, due - round(_CATCH_UP_S / self._dt_s))
        if self._drop and now_s - self._first_s >= self._drop_after_s:
            self._state = self._stage.with_changes(self._state, {"gain_drift.gain": -self._drop})
            self._drop = 0.0
        for _ in range(due - self._steps):
            if self._fault.hidden:
                wanted_um = TRAVEL_UM * self._u_V / self._high_V
                self._held_V += _SERVO_SHARE * (wanted_um - self._reading_um)
            drive_V = self._held_V if self._fault.hidden else self._u_V
            self._reading_um = min(self._stage.step(self._state, drive_V / AMPLIFIER)[0], self._fault.top_um)
        self._steps = max(self._steps, due)

    def dropped(self) -> bool:
        """Whether the connection ends now; it does so once."""
        ends = time.perf_counter() - self._first_s > self._fault.drop_s
        if ends:
            self._fault = Fault()
        return ends

    def answer(self, line: str) -> str | None:
        """The reply to one command without its line end; None where the command has none or is refused (``ERR?``)."""
        name, *values = line.split() or [""]
        if name.upper() == "ERR?":
            error, self._error = self._error, 0
            return str(error)
        try:
            return self._answer(name.upper(), values)
        except (ValueError, IndexError):
            self._error = UNKNOWN_COMMAND
            return None

    def _answer(self, name: str, values: list[str]) -> str | None:
        plain = {"*IDN?": IDENTITY, "CSV?": "2.0"}
        if name in plain:
            return plain[name]
        if values and values[0] != "1":
            self._error = UNKNOWN_AXIS
            return None
        if name == "POS?":
            self.advance()
        read = {
            "POS?": f"{self._fault.scale * self._reading_um:.6f}", "VOL?": f"{self._u_V:.6f}",
            "SVA?": f"{self._u_V:.6f}", "VMI?": f"{self._low_V:g}", "VMA?": f"{self._high_V:g}",
            "SVO?": f"{self._servo:d}", "PUN?": "um", "TMN?": "0", "TMX?": f"{TRAVEL_UM:g}",
        }  # fmt: skip
        if name in read:
            return f"1={read[name]}"
        if name == "SVO":
            self._servo = bool(int(values[1])) or (self._fault.servo and not self._fault.hidden)
        elif name == "SVA":
            self._set(float(values[1]))
        else:
            self._error = UNKNOWN_COMMAND
        return None

    def _set(self, u_V: float) -> None:
        if self._servo:
            self._error = SERVO_IS_ON
        elif not self._low_V <= u_V <= self._high_V:
            self._error = OUT_OF_LIMITS
        else:
            self.advance()
            self._u_V, self._first_s = u_V, min(self._first_s, time.perf_counter())


def serve(listener: socket.socket, controller: SimulatedPi) -> None:
    """Answer one connection after the other, until the process ends."""
    while True:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection, contextlib.suppress(ConnectionError):
            waiting = b""
            while True:
                ready = select.select([connection], [], [], _POLL_S)[0]
                controller.advance()
                if controller.dropped():
                    break
                if not ready:
                    continue
                received = connection.recv(4096)
                if not received:
                    break
                *lines, waiting = (waiting + received).split(b"\n")
                replies = [controller.answer(line.decode("ascii", "replace").strip()) for line in lines]
                text = "".join(f"{reply}\n" for reply in replies if reply is not None)
                if text:
                    connection.sendall(text.encode())


def main(argv: Sequence[str] | None = None) -> None:
    """Run the controller until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=50000, help="TCP port on this machine (%(default)s)")
    parser.add_argument(
        "--gain-drop", default="", metavar="S:SHARE", help="lower the gain by this share, S s after the first voltage"
    )
    parser.add_argument("--fault", choices=FAULTS, metavar="NAME", help=f"what is wrong: {', '.join(FAULTS)}")
    args = parser.parse_args(argv)
    fault = FAULTS.get(args.fault)
    controller = SimulatedPi(fault=fault)
    if args.gain_drop:
        after_s, _, share = args.gain_drop.partition(":")
        try:
            controller = SimulatedPi(float(after_s), float(share), fault)
        except ValueError:
            parser.error(f"--gain-drop: got {args.gain_drop!r}, expected S:SHARE such as 60:0.06")
    controller.advance()
    try:
        listener = socket.create_server(("127.0.0.1", args.port))
    except OSError as error:
        parser.error(
            f"port {args.port} is not free ({error.strerror}): does one run already? Stop it, or add --port, and give "
            "the same port in my_stage.py"
        )
    with listener:
        print(f"ready: simulated PI controller at 127.0.0.1, port {listener.getsockname()[1]}", flush=True)
        serve(listener, controller)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
