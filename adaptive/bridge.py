"""Where the stage must be, from the voltage alone: the inverse model followed the other way round.

While readings are doubtful, the smoother's extrapolation is off by micrometres within ten samples. The inverse model is
not: at each sample the displacement is sought for which it asks for the voltage that was applied, with the hysteresis
memory going along. What the model gets wrong altogether is taken away where the bridge begins, so that only its change
over some milliseconds counts: some ten nanometres on a stage that the model has learnt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from adaptive.features import FeatureMap
from adaptive.types import FloatArray, StateDict

#: Voltage, V, that the model asks for, from basis (p,) and kernel inputs (d,).
Voltage = Callable[[FloatArray, FloatArray], float]
#: Newton's steps a sample, and the displacement over which the slope is taken, as a share of the range.
STEPS, SLOPE_SHARE = 2, 1e-5
#: A slope outside these shares of the mean one is the model's error, not the stage's.
SLOPES = (0.4, 2.5)
#: A place further from the middle of the range than this many ranges is none, and a reading no reading.
FAR_OUT = 1.5
#: Readings before the doubtful one from which the model's error is taken.
ANCHORS = 4


@dataclass(slots=True)
class Bridge:
    """Displacements, µm, in the model's own sense: ``offset_um`` is what a reading shows more.

    last_um, before_um : of the last two samples. a_um_per_s2 : acceleration, kept as it was when the bridge began.
    memory : (m,) after the last sample. path_um : way gone since the bridge began to be needed.
    """

    last_um: float
    before_um: float
    a_um_per_s2: float
    memory: FloatArray
    offset_um: float = 0.0
    path_um: float = 0.0

    @property
    def y_um(self) -> float:
        """Where a reading must be at the last sample."""
        return self.last_um + self.offset_um

    def state_dict(self) -> StateDict:
        values = (self.last_um, self.before_um, self.a_um_per_s2, self.offset_um, self.path_um)
        return {"values": np.array(values), "memory": self.memory.copy()}

    @classmethod
    def from_state(cls, values: StateDict) -> Bridge:
        last, before, a, offset, path = (float(x) for x in values["values"])
        return cls(last, before, a, np.array(values["memory"], dtype=np.float64), offset, path)


@dataclass(frozen=True)
class Bridging:
    """What a bridge is built with: the feature map that is served, the model, and the mean slope, V/µm."""

    features: FeatureMap
    voltage: Voltage
    slope_V_per_um: float
    _basis: FloatArray = field(init=False, repr=False, compare=False)
    _kernel: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_basis", np.empty(self.features.basis_size))
        object.__setattr__(self, "_kernel", np.empty(self.features.kernel_size))

    def begin(
        self, motion: tuple[float, float, float], u_V: FloatArray, y_um: FloatArray, memory: FloatArray
    ) -> Bridge:
        """From the last smoothed instant over the (n,) samples after it, with their voltages and (k,) first readings.

        ``motion`` (µm, µm/s, µm/s²) and ``memory`` (m,) are of that instant.
        """
        y, v, a = motion
        dt = self.features.dt_s
        bridge = Bridge(y, y - v * dt + 0.5 * a * dt * dt, a, memory.copy())
        off = np.empty(y_um.size)
        for i in range(u_V.size):
            self.advance(bridge, float(u_V[i]))
            if i < y_um.size:
                off[i] = y_um[i] - bridge.last_um
        bridge.offset_um = float(np.mean(off[-ANCHORS:])) if off.size else 0.0
        bridge.path_um = 0.0
        return bridge

    def advance(self, bridge: Bridge, u_V: float) -> float:
        """One sample on; returns where its reading must be, µm."""
        m, before = self.features, bridge.last_um
        low, high = (share * self.slope_V_per_um for share in SLOPES)
        h = SLOPE_SHARE * (m.y_max_um - m.y_min_um)
        middle_um = m.offset_um + m.gain * 0.5 * (m.y_max_um + m.y_min_um)
        y = 2.0 * bridge.last_um - bridge.before_um
        for _ in range(STEPS):
            there = self._voltage(bridge, y)
            slope = (self._voltage(bridge, y + h) - there) / h
            y -= (there - u_V) / min(max(slope, low), high)
        if not abs(y - middle_um) <= FAR_OUT * (m.y_max_um - m.y_min_um):
            y = before  # the model has lost its way: no stage goes there
        m.advance(y, bridge.memory)
        bridge.before_um, bridge.last_um = before, y
        bridge.path_um += abs(y - before)
        return bridge.y_um

    def _voltage(self, bridge: Bridge, y_um: float) -> float:
        """What the model asks for at a trial displacement; velocity by the second-order backward difference."""
        m = self.features
        v = (3.0 * y_um - 4.0 * bridge.last_um + bridge.before_um) / (2.0 * m.dt_s)
        memory = bridge.memory.copy()
        m.advance(y_um, memory)
        m.fill(y_um, v, bridge.a_um_per_s2, memory, self._basis, self._kernel)
        return self.voltage(self._basis, self._kernel)
