"""A simulated PI controller: answers GCS commands over TCP as a piezo controller does, with a simulated stage behind.

    python examples/simulated_pi.py                      # at 127.0.0.1, port 50000; Ctrl-C ends it
    python examples/simulated_pi.py --gain-drop 60:0.06  # the gain drops by 6 % after 60 s of motion

The stage is that of examples/plant.py (60 µm over 0 to 100 V); it moves in real time.
"""

import argparse
import contextlib
import select
import socket
import time

import numpy as np
from plant import Stage

IDENTITY = "simulated, E-709.CRG, 0, 1.0"
#: Error codes of GCS: parameter out of range, unknown command, wrong axis, voltage out of limits, servo is on.
UNKNOWN_COMMAND, UNKNOWN_AXIS, OUT_OF_LIMITS, SERVO_IS_ON = 2, 15, 302, 5


class Controller:
    """One axis "1" with piezo channel 1. `answer` takes one command line and returns the reply, or None."""

    def __init__(self, drop_after_s: float = np.inf, drop: float = 0.0) -> None:
        self.stage = Stage()
        self.u_V, self.reading_um, self.servo, self.error = 0.0, 0.0, True, 0
        self.drop_at, self.drop = drop_after_s / self.stage.dt_s, drop
        self.steps, self.start_s = 0, time.perf_counter()

    def advance(self) -> None:
        """Let the stage move until now."""
        due = int((time.perf_counter() - self.start_s) / self.stage.dt_s)
        if due - self.steps > 1000:  # nobody has looked for a second: at rest meanwhile
            self.steps = due - 1000
        if due > self.steps:
            if self.drop and due >= self.drop_at:
                self.stage.weight, self.drop = self.stage.weight * (1.0 - self.drop), 0.0
            self.reading_um = float(self.stage.run(np.full(due - self.steps, self.u_V))[1][-1])
            self.steps = due

    def answer(self, line: str) -> str | None:
        name, *values = line.split() or [""]
        try:
            return self._answer(name.upper(), values)
        except (ValueError, IndexError):
            self.error = UNKNOWN_COMMAND
            return None

    def _answer(self, name: str, values: list[str]) -> str | None:
        if name == "ERR?":
            error, self.error = self.error, 0
            return f"{error}"
        if name == "*IDN?":
            return IDENTITY
        if name == "CSV?":
            return "2.0"
        if values and values[0] != "1":
            self.error = UNKNOWN_AXIS
            return None
        if name == "POS?":
            self.advance()
            return f"1={self.reading_um:.6f}"
        if name in ("VOL?", "SVA?"):
            return f"1={self.u_V:.6f}"
        if name == "VMI?":
            return f"1={self.stage.u_min_V:g}"
        if name == "VMA?":
            return f"1={self.stage.u_max_V:g}"
        if name == "SVO?":
            return f"1={int(self.servo)}"
        if name == "SVO":
            self.servo = bool(int(values[1]))
            return None
        if name == "SVA":
            u_V = float(values[1])
            if self.servo:
                self.error = SERVO_IS_ON
            elif not self.stage.u_min_V <= u_V <= self.stage.u_max_V:
                self.error = OUT_OF_LIMITS
            else:
                self.advance()
                self.u_V = u_V
            return None
        self.error = UNKNOWN_COMMAND
        return None


def serve(listener: socket.socket, controller: Controller) -> None:
    """Answer one connection after the other until the listener is closed."""
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection:
            waiting = b""
            try:
                while True:
                    ready, _, _ = select.select([connection], [], [], 0.005)
                    controller.advance()
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
            except ConnectionError:
                continue


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=50000, help="TCP port on this machine (%(default)s)")
    parser.add_argument(
        "--gain-drop", default="", metavar="S:SHARE", help="lower the gain by this share after S seconds"
    )
    args = parser.parse_args()
    after_s, _, share = args.gain_drop.partition(":")
    controller = Controller(float(after_s), float(share)) if args.gain_drop else Controller()
    with socket.create_server(("127.0.0.1", args.port)) as listener:
        print(f"ready: simulated PI controller at 127.0.0.1, port {listener.getsockname()[1]}", flush=True)
        serve(listener, controller)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
