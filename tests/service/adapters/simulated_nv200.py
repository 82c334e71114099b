"""A simulated piezosystem jena NV200 on Telnet: commands and replies as the documentation of `nv200` states them."""

from __future__ import annotations

import socket
import threading

XON, XOFF = b"\x11", b"\x13"


class SimulatedNv200:
    """At a free port of this machine; 0.8 µm/V. Use as a context manager.

    A command is echoed with its values, ``cl,0``; a read returns ``cl,0``. Each reply ends with XON.
    """

    def __init__(self, unit: str = "µm") -> None:
        self.values: dict[str, str] = {
            "cl": "1", "modsrc": "1", "set": "0.000", "avmin": "-20.000", "avmax": "130.000", "unitcl": unit,
        }  # fmt: skip
        self.seen: list[str] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> SimulatedNv200:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()
        self._thread.join(5.0)

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        with connection:
            connection.settimeout(5.0)
            waiting = b""
            while received := connection.recv(4096):
                # Telnet's negotiation (IAC, verb, option) is ignored, as a plain serial bridge does.
                waiting += received
                while b"\xff" in waiting and len(waiting) >= waiting.index(b"\xff") + 3:
                    at = waiting.index(b"\xff")
                    waiting = waiting[:at] + waiting[at + 3 :]
                *lines, waiting = waiting.split(b"\n")
                for line in lines:
                    connection.sendall(XOFF + self._answer(line.decode().strip()) + b"\r\n" + XON)

    def _answer(self, line: str) -> bytes:
        self.seen.append(line)
        name, _, value = line.partition(",")
        if not line:
            return b"NV200/D_NET>"
        if name == "meas":
            return f"meas,{0.8 * float(self.values['set']):.3f}".encode()
        if name not in self.values:
            return b"error,2"
        if value:
            self.values[name] = value
        return f"{name},{self.values[name]}".encode("latin1")
