"""Does the sensor follow the drive? Asked all the time, of readings that raise no surprise.

A sensor that stands still with some noise, or whose gain creeps away, surprises no smoother. What tells it is the
voltage: the identified model is asked for the voltage of the motion that was read, and the steps p of that are compared
with the steps u of the voltage that was applied. A step is taken when one of the two has moved far enough, beyond the
noise that the readings make of p. All steps count alike, whatever their size, so that no single one decides. Steps in
a row at which the reading stood still, the slope p/u, and how straight the line through the steps is, show a fault;
``adaptive.online.sensor_trial`` then names it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from adaptive.types import StateDict

#: Steps of this share of the voltage span are compared, and of so many times the noise of p.
STEP_SHARE, STEP_SIGMA = 0.004, 8.0
#: Pairs over which that noise is averaged.
NOISE_PAIRS = 250
#: The shortest time of a step, s: over it ringing of the stage is small beside the motion.
STEP_S = 0.01
#: What one step makes of those before it; from what count of steps on they tell, and of which share of them the voltage
#: must have moved as far as the readings.
FORGET, ENOUGH, OF_VOLTAGE = 0.9, 3.4, 0.7
#: Share of the span, a second, below which a voltage that moves may hold a creeping stage in place.
CREEP_PER_S = 0.05
#: Count of steps from which on a slope is taken at its word.
ENOUGH_SLOPE = 6.0
#: Slopes outside are no change of a stage, hysteresis and a wrong model included; nor is a line less straight.
SLOPES, STRAIGHT = (0.62, 1.6), 0.35
#: A reading that moves by less than this share of the voltage's step stands still; so many steps in a row show it.
STILL, STILL_STEPS = 0.2, 4
#: Steps after which what was so far is known to have followed.
CONFIRMED = 10


@dataclass(slots=True)
class Following:
    """Sums over the last steps, each a vector (u, p) whose larger part is 1.

    u_V, p_V, steps : voltage and answer of the model where the last step ended, and pairs since. count : of steps,
    those before forgotten as in the sums. good, still : steps in a row at which the readings followed, and stood still.
    noise2 : mean square change of p beyond that of u from one pair to the next, V².
    """

    u_V: float = math.nan
    p_V: float = math.nan
    steps: int = 0
    count: float = 0.0
    driven: float = 0.0
    uu: float = 0.0
    pp: float = 0.0
    up: float = 0.0
    good: int = 0
    still: int = 0
    last_V: float = math.nan
    noise2: float = 0.0

    def forget(self) -> None:
        """Begin anew: what comes is of another time."""
        self.u_V = self.p_V = math.nan
        self.last_V = math.nan
        self.steps = self.good = self.still = 0
        self.count = self.driven = self.uu = self.pp = self.up = 0.0

    def take(self, u_V: float, p_V: float, span_V: float, dt_s: float) -> bool:
        """One pair: the voltage, and what the model asks for at the reading. Returns whether a fault shows.

        ``span_V`` : voltage over which the stage is driven. ``dt_s`` : time between two pairs, s.
        """
        self.steps += 1
        change_V, self.last_V = p_V - u_V - self.last_V, p_V - u_V
        if not math.isnan(change_V):
            self.noise2 += (min(change_V * change_V, 16.0 * self.noise2 + (STEP_SHARE * span_V) ** 2) - self.noise2) / (
                NOISE_PAIRS
            )
        step_V = max(STEP_SHARE * span_V, STEP_SIGMA * math.sqrt(self.noise2))
        du, dp = u_V - self.u_V, p_V - self.p_V
        if math.isnan(du) or math.isnan(dp):
            self.u_V, self.p_V, self.steps = u_V, p_V, 0
            return False
        size = max(abs(du), abs(dp))
        if size < step_V or self.steps * dt_s < STEP_S:
            return False
        slow = size < CREEP_PER_S * span_V * self.steps * dt_s
        self.u_V, self.p_V, self.steps = u_V, p_V, 0
        if slow:
            return False
        u, p = du / size, dp / size
        self.still = self.still + 1 if abs(p) <= STILL * abs(u) else 0
        self.count = FORGET * self.count + 1.0
        self.uu = FORGET * self.uu + u * u
        self.pp = FORGET * self.pp + p * p
        self.up = FORGET * self.up + u * p
        # Readings that move where the voltage does not are a matter of surprise, not of following.
        self.driven = FORGET * self.driven + (abs(u) >= STILL)
        if self.count < ENOUGH or self.driven < OF_VOLTAGE * self.count:
            return False
        fault = self._fault()
        self.good = 0 if fault else self.good + 1
        return fault or self.still >= STILL_STEPS

    def _fault(self) -> bool:
        slope, straight = self.up / self.uu, self.up * self.up / (self.uu * self.pp) if self.pp > 0.0 else 0.0
        if straight < STRAIGHT:
            # More motion than the drive's is something else that moves the stage.
            return self.pp <= SLOPES[1] ** 2 * self.uu
        return self.count >= ENOUGH_SLOPE and not SLOPES[0] <= slope <= SLOPES[1]

    def state_dict(self) -> StateDict:
        return asdict(self)

    @classmethod
    def from_state(cls, values: StateDict) -> Following:
        """Inverse of ``state_dict``; a state from before there was any is that of a beginning."""
        if not values:
            return cls()
        return cls(**{name: type(value)(values[name]) for name, value in asdict(cls()).items()})
