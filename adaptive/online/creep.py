"""What a stage at rest teaches: not that its model is off by a constant, but that it creeps.

To hold a creeping stage in place the voltage must creep back, and that small reversal goes into the stage's own
hysteresis. A constant that takes up the difference leaves the model's hysteresis as it was, which shows as soon as the
stage moves on. Taken for what it is, a displacement that no voltage made, it belongs into the frame of the features
(``adaptive.features``): then the displacement that the hysteresis follows creeps back as the voltage does.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, nan

from adaptive.errors import ModelFileError
from adaptive.types import StateDict

#: Steps of the filter between two moves of the frame: a new feature map for each step would cost as much as the step.
_EVERY = 10
#: Creep is slow: share of the range, a second, by which the frame may move at most, whatever the readings are.
_FASTEST_PER_S = 0.02
#: Share of the voltage span, a second, that a voltage moves at most while it holds a stage in place. A sensor that has
#: stopped shows a stage at rest too, but the voltage goes on.
_STILL_PER_S = 0.1


@dataclass(slots=True)
class Rest:
    """constant_V : of the linear part when the rest began, NaN while the stage moves. steps : of the filter since.
    u_V : the voltage at the last of them that could move the frame."""

    constant_V: float = nan
    steps: int = 0
    u_V: float = nan

    def leave(self) -> None:
        """The stage moves: what the constant is now stays with it."""
        self.constant_V, self.steps, self.u_V = nan, 0, nan

    def shift_um(
        self, constant_V: float, u_V: float, span_V: float, range_um: float, step_s: float, creep_s: float
    ) -> float:
        """By how much the frame's offset is to move, µm, after another step of the filter at rest; mostly 0.

        ``constant_V`` is that of the linear part now, ``u_V`` the voltage; ``span_V`` and ``range_um`` those of the
        model. What the constant has gained since the rest began goes over to the frame with the time constant
        ``creep_s`` (0: never).
        """
        if isnan(self.constant_V):
            self.constant_V, self.u_V = constant_V, u_V
        self.steps += 1
        if creep_s <= 0.0 or self.steps % _EVERY:
            return 0.0
        went_V, self.u_V = abs(u_V - self.u_V), u_V
        if went_V > _STILL_PER_S * span_V * _EVERY * step_s:
            self.leave()
            return 0.0
        gained_um = (constant_V - self.constant_V) * range_um / span_V
        most_um = _FASTEST_PER_S * range_um * _EVERY * step_s
        return -min(max(gained_um * min(1.0, _EVERY * step_s / creep_s), -most_um), most_um)

    def state_dict(self) -> StateDict:
        return {"constant_V": self.constant_V, "steps": self.steps, "u_V": self.u_V}

    @classmethod
    def from_state(cls, values: StateDict) -> Rest:
        """Inverse of ``state_dict``; a state from before there was any is that of a stage that moves."""
        if not values:
            return cls()
        try:
            return cls(float(values["constant_V"]), int(values["steps"]), float(values["u_V"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f"rest: entry missing or damaged: {error}") from error
