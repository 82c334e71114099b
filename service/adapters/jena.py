"""Adapter of a piezosystem jena NV200 amplifier over Ethernet (Telnet) or USB, through its library `nv200`.

**Not tried on hardware**: tested against a simulated amplifier that answers the commands used here (``cl``, ``modsrc``,
``set``, ``meas``, ``avmin``, ``avmax``, ``unitcl``). Needs Python 3.12 or newer, as the library does, and the extra
``hardware``.

Sources: documentation and docstrings of nv200 1.6.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from dehyst.service.adapters.adapter import AdapterError, Closing, check_rate, load_library


class Nv200Stage(Closing):
    """An NV200 in open loop; a `service.adapters.StageAdapter` and a context manager.

    The library waits 10 ms before each command, to empty its input, and each sample takes two: it bounds the rate to
    some 40 samples a second. For more, drive the analogue input of the amplifier by a card (`service.adapters.ni`).

    Parameters
    ----------
    host : IP address, for Ethernet; ``serial_port`` : name such as "COM3" or "/dev/ttyUSB0", for USB. One of the two.
    rate_Hz : sample rate, Hz.
    port : TCP port of Telnet.
    adjust : let the library set the Ethernet module's flow control at the connection, as the NV200 needs once.

    Raises AdapterError if nv200 is missing, the amplifier does not answer or has no position sensor in µm.
    """

    def __init__(
        self, host: str = "", rate_Hz: float = 25.0, serial_port: str = "", port: int = 23, adjust: bool = True
    ) -> None:
        self.rate_Hz = check_rate(rate_Hz)
        if bool(host) == bool(serial_port):
            raise AdapterError("host, serial_port: expected one of the two, an IP address or a serial port")
        device_class = load_library("nv200.nv200_device", "nv200").NV200Device
        shared = load_library("nv200.shared_types", "nv200")
        if host:
            transport = load_library("nv200.telnet_protocol", "nv200").TelnetProtocol(host=host, port=port)
        else:
            transport = load_library("nv200.serial_protocol", "nv200").SerialProtocol(port=serial_port)
        self._loop = asyncio.new_event_loop()
        self._device: Any = device_class(transport)
        try:
            self._do(self._device.connect(adjust))
            self._do(self._device.pid.set_mode(shared.PidLoopMode.OPEN_LOOP))
            self._do(self._device.set_modulation_source(shared.ModulationSource.SET_CMD))
            self.u_min_V, self.u_max_V = (float(u) for u in self._do(self._device.get_voltage_range()))
            unit = self._do(self._device.get_position_unit())
            if unit not in ("µm", "μm", "um"):
                raise AdapterError(f"unit of the position: got {unit!r}, expected µm")
        except Exception as error:
            self.close()
            if isinstance(error, AdapterError):
                raise
            raise AdapterError(f"{host or serial_port}: {type(error).__name__} {error}".rstrip()) from error

    def read_um(self) -> float:
        """The position, µm (``meas``)."""
        return float(self._do(self._device.get_current_position()))

    def write_V(self, u_V: float) -> None:
        """Set the voltage, V (``set``)."""
        self._do(self._device.set_setpoint(u_V))

    def applied_V(self) -> float:
        """The voltage that was set last, V (``set``)."""
        return float(self._do(self._device.get_setpoint()))

    def close(self) -> None:
        """Close the connection; the voltage stays."""
        if not self._loop.is_closed():
            try:
                self._do(self._device.close())
            finally:
                self._do(self._loop.shutdown_asyncgens())
                self._loop.close()

    def _do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self._loop.run_until_complete(work)
