"""Adapter of a National Instruments card that drives an amplifier and reads a sensor, through NI's `nidaqmx`.

**Not tried on hardware**: tested against a stand-in for `nidaqmx` whose calls are checked against the signatures of the
real library, because its driver is not on the test machine. Needs the extra ``hardware`` and NI's driver NI-DAQmx.

Sources: documentation of nidaqmx-python 1.x.
"""

from __future__ import annotations

from typing import Any

from dehyst.service.adapters.adapter import AdapterError, Closing, check_rate, load_library
from dehyst.service.protocol.errors import FieldError


class NiStage(Closing):
    """An analogue output that drives a piezo amplifier, and an analogue input that reads a sensor.

    A `service.adapters.StageAdapter` and a context manager. Reading and writing are software-timed, one sample each: a
    card on PCIe takes some 1 kHz, one on USB some hundred hertz.

    Parameters
    ----------
    output, input : physical channels, such as "Dev1/ao0" and "Dev1/ai0".
    amplifier_gain : voltage at the piezo over that at the output of the card, such as 10 for 0 to 10 V → 0 to 100 V.
    um_per_V, um_at_0V : sensitivity of the sensor, µm/V, and its position at 0 V at the input, µm.
    u_min_V, u_max_V : limits of the voltage at the piezo, V.
    rate_Hz : sample rate, Hz.
    start_V : voltage at the piezo that is applied now, V. The card cannot be asked for it.
    input_max_V : range of the input, ± V.

    Raises AdapterError if nidaqmx or its driver is missing, or the card refuses; FieldError on values that do not fit.
    """

    def __init__(
        self, output: str, input: str, *, amplifier_gain: float, um_per_V: float, u_min_V: float, u_max_V: float,
        rate_Hz: float = 500.0, um_at_0V: float = 0.0, start_V: float = 0.0, input_max_V: float = 10.0,
    ) -> None:  # fmt: skip
        self.rate_Hz = check_rate(rate_Hz)
        if amplifier_gain == 0.0 or um_per_V == 0.0:
            raise FieldError("amplifier_gain, um_per_V", f"{amplifier_gain:g}, {um_per_V:g}", "numbers other than 0")
        self.u_min_V, self.u_max_V = u_min_V, u_max_V
        self._gain, self._um_per_V, self._um_at_0V = amplifier_gain, um_per_V, um_at_0V
        self._u_V = start_V
        library = load_library("nidaqmx", "nidaqmx")
        self._tasks: list[Any] = []
        at_card_V = sorted((u_min_V / amplifier_gain, u_max_V / amplifier_gain))
        try:
            for _ in range(2):
                self._tasks.append(library.Task())
            out, inp = self._tasks
            out.ao_channels.add_ao_voltage_chan(output, min_val=at_card_V[0], max_val=at_card_V[1])
            inp.ai_channels.add_ai_voltage_chan(input, min_val=-input_max_V, max_val=input_max_V)
            inp.start()
        except Exception as error:
            self.close()
            raise AdapterError(f"{output}, {input}: {type(error).__name__}: {error}") from error

    def read_um(self) -> float:
        """The position by the sensor, µm."""
        return self._um_at_0V + self._um_per_V * float(self._tasks[1].read())

    def write_V(self, u_V: float) -> None:
        """Set the voltage at the piezo, V."""
        self._tasks[0].write(u_V / self._gain, auto_start=True)
        self._u_V = u_V

    def applied_V(self) -> float:
        """The voltage at the piezo that was written last, V; ``start_V`` before any."""
        return self._u_V

    def close(self) -> None:
        """Release the card; the output keeps its voltage."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.close()
