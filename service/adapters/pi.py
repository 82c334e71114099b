"""Adapter of a piezo controller of Physik Instrumente (PI) that speaks GCS over TCP/IP, through PI's `pipython`.

**Not tried on hardware**: tested against a simulated controller that answers the GCS commands used here (``*IDN?``,
``SVO``, ``SVA``, ``SVO?``, ``POS?``, ``VOL?``, ``VMI?``, ``VMA?``, ``PUN?``, ``TMN?``, ``TMX?``, ``ERR?``). Needs the
extra ``hardware``.

Sources: documentation of PI's General Command Set (GCS 2.0), docstrings of pipython 2.11.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from dehyst.service.adapters.adapter import AdapterError, Closing, Stated, check_rate, load_library

_PORT = 50_000


class PiStage(Closing):
    """One axis of a PI controller in open loop; a `service.adapters.StageAdapter` and a context manager.

    The servo of the axis is switched off: the voltage is set by ``SVA``, whose unit is the volt for piezo axes. Each
    sample is a query of the position (``POS?``, µm) and one ``SVA``; that many round trips bound the rate (some hundred
    hertz over a network). ``Client.limits`` of the service bounds the voltage further.

    Parameters
    ----------
    host, port : address of the controller, and its TCP port. axis : name of the axis. channel : its piezo output.
    rate_Hz : sample rate, Hz.
    check_errors : ask the controller for its error (``ERR?``) after each command. It costs a round trip each, and
        reports a refused voltage at once.

    Raises AdapterError if pipython is missing or the controller does not answer.
    """

    def __init__(
        self, host: str, axis: str = "1", channel: int = 1, rate_Hz: float = 200.0, port: int = _PORT,
        check_errors: bool = True,
    ) -> None:  # fmt: skip
        self.rate_Hz = check_rate(rate_Hz)
        self._axis, self._channel = axis, channel
        library = load_library("pipython", "pipython")
        sockets = load_library("pipython.pidevice.interfaces.pisocket", "pipython")

        class ClosedOnce(sockets.PISocket):  # type: ignore[misc,name-defined]
            """The library closes its socket again when the device is collected, which raises."""

            def close(self) -> None:
                if not self.connected:
                    return
                try:
                    super().close()
                except OSError:  # the controller has closed it, and the library stops half way
                    self._socket.close()
                    self.call_connection_status_changed_callback(self)

        try:
            gateway = ClosedOnce(host=host, port=port)
        except OSError as error:
            raise AdapterError(f"{host}, port {port}: no controller answers there ({error})") from error
        self._device: Any = library.GCSDevice(gateway=gateway)
        try:
            #: What the controller calls itself.
            self.identity = str(self._device.qIDN()).strip()
            self._device.errcheck = check_errors
            self._device.SVO(axis, False)
            self.u_min_V = float(self._device.qVMI(channel)[channel])
            self.u_max_V = float(self._device.qVMA(channel)[channel])
        except Exception as error:
            self.close()
            raise AdapterError(f"{host}, axis {axis!r}, channel {channel}: {error}") from error

    def read_um(self) -> float:
        """The position, µm (``POS?``)."""
        return float(self._device.qPOS(self._axis)[self._axis])

    def write_V(self, u_V: float) -> None:
        """Set the voltage, V (``SVA``)."""
        self._device.SVA(self._axis, u_V)

    def applied_V(self) -> float:
        """The voltage of the piezo output, V (``VOL?``)."""
        return float(self._device.qVOL(self._channel)[self._channel])

    def stated(self) -> Stated:
        """Servo (``SVO?``), unit of the positions (``PUN?``) and travel (``TMX?`` - ``TMN?``) by the controller."""
        device = self._device
        servo = bool(device.qSVO(self._axis)[self._axis])
        unit = str(self._said(device.qPUN) or "").strip()
        low, high = self._said(device.qTMN), self._said(device.qTMX)
        return Stated(servo, unit, math.nan if low is None or high is None else float(high) - float(low))

    def _said(self, query: Callable[[str], Any]) -> Any:
        """The reply to a query; None from a controller that does not know it.

        A lost connection is raised by the next reading.
        """
        try:
            return query(self._axis)[self._axis]
        except Exception:
            return None

    def close(self) -> None:
        """Close the connection; the voltage stays."""
        # As at the end of its `with`: closing alone leaves the device registered with the next connection.
        self._device.__exit__(None, None, None)
