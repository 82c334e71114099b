"""The task of the soak's controller: keys, limits, and the reference."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.protocol.keys import Keys
from sim.signals.references import DemoReference

STAGE, AXIS = "soak", "x"
SERVED = "lssvm_adaptive"


def dwell_key() -> str:
    """Key on which the controller is told to hold the reference: JSON {"first": tick, "ticks": n}."""
    return f"{Keys(STAGE, AXIS).base}/soak_dwell"


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

    def write(self, path: Path) -> None:
        """Write the task for the processes of controller and prober."""
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> ControlTask:
        """The task that `write` has written."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))


# --- The reference

PERIOD_S = 120.0
#: Time of the transition between motion and rest, s.
FADE_S = 0.6

#: A weight and its two derivatives, (n,) each.
Weight = tuple[FloatArray, FloatArray, FloatArray]


def fade(q: FloatArray) -> Weight:
    """Seventh-order step from 0 to 1 over ``q`` in [0, 1], and its two derivatives with respect to ``q``."""
    q = np.clip(q, 0.0, 1.0)
    s0 = q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3)
    s1 = 140.0 * q**3 * (1.0 - q) ** 3
    s2 = 420.0 * q**2 * (1.0 - q) ** 2 * (1.0 - 2.0 * q)
    return s0, s1, s2


def _towards(motion: FloatArray, level_um: float, weight: Weight, dt_s: float) -> FloatArray:
    """(3, n) motion about a level, scaled by a weight with its derivatives per tick (product rule)."""
    w0, w1, w2 = weight[0], weight[1] / dt_s, weight[2] / dt_s**2
    y, v, a = motion[0] - level_um, motion[1], motion[2]
    return np.stack((level_um + w0 * y, w0 * v + w1 * y, w0 * a + 2.0 * w1 * v + w2 * y))


@dataclass
class SoakReference:
    """A periodic reference: rows y µm, v µm/s, a µm/s² by tick. Each period begins and ends at rest at ``low_um``.

    ``dwells`` are pairs (first tick, ticks) during which the reference rests at mid-range.
    """

    dt_s: float
    low_um: float
    high_um: float
    seed: int
    dwells: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        n = round(PERIOD_S / self.dt_s)
        t_s = np.arange(n).astype(np.float64) * self.dt_s
        made = DemoReference(PERIOD_S, self.low_um, self.high_um, self.seed).at(t_s)
        motion = np.stack((made.y_um, made.v_um_per_s, made.a_um_per_s2))
        self._motion = _towards(motion, self.low_um, self._turn(np.arange(n), n - 1), self.dt_s)

    def rows(self, first: int, n: int) -> FloatArray:
        """(3, n) from tick ``first`` on."""
        k = np.arange(first, first + n)
        motion = self._motion[:, k % self._motion.shape[1]]
        middle = 0.5 * (self.low_um + self.high_um)
        for start, ticks in self.dwells:
            if start <= k[-1] and k[0] <= start + ticks:
                motion = _towards(motion, middle, self._rest(k, start, start + ticks), self.dt_s)
        return motion

    def _rest(self, k: NDArray[np.int64], start: int, stop: int) -> Weight:
        """Weight of the motion with a rest from ``start`` to ``stop``; both transitions lie inside."""
        return self._chosen(k, 0.5 * (start + stop), start, -1.0, stop, 1.0)

    def _turn(self, k: NDArray[np.int64], stop: int) -> Weight:
        """Weight of the motion with a rest at tick 0 and at ``stop``."""
        return self._chosen(k, 0.5 * stop, 0, 1.0, stop, -1.0)

    def _chosen(
        self, k: NDArray[np.int64], middle: float, first: int, sign: float, second: int, other_sign: float
    ) -> Weight:
        """Before ``middle`` a transition that begins at ``first``, after it one that ends at ``second``. Signs: in (1)
        or out (-1)."""
        width = FADE_S / self.dt_s
        early = _faded((k - first) / width, sign, width)
        late = _faded((k - second) / width + 1.0, other_sign, width)
        return tuple(np.where(k < middle, x, y) for x, y in zip(early, late, strict=True))  # type: ignore[return-value]


def _faded(q: FloatArray, sign: float, width: float) -> Weight:
    """A transition in (sign 1) or out (-1) over q from 0 to 1, ``width`` ticks long, with derivatives per tick."""
    s0, s1, s2 = fade(q)
    return (s0 if sign > 0.0 else 1.0 - s0), sign * s1 / width, sign * s2 / width**2
