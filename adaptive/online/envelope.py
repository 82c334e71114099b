"""The envelope: bounds on the learnt model around the identified one, from the physics of piezo stages.

A model outside the envelope is not served: the last good model or the identified one stays in service.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.features import FeatureMap


@dataclass(frozen=True, slots=True)
class EnvelopeConfig:
    """Bounds about the identified model.

    gain : largest factor of change of the stage's or the sensor's gain, up or down. The gain of a piezo stage changes
    by a few percent with temperature and age, by 20 to 30 % with amplitude and load.
    offset : share of the range by which the zero may move.
    shape : share of the voltage span by which the linear part and the kernel together may leave the identified linear
    part, at every point.
    jump : largest jump, as a share of the range, that is accepted from some readings at one level. A larger change is
    accepted only after motion has confirmed it.
    drift_per_s : largest share of the range, a second, by which readings may drift away from the voltage.
    follow_s : time of motion over which readings must follow the drive before they are trusted again, s.
    """

    gain: float = 1.35
    offset: float = 0.3
    shape: float = 0.25
    jump: float = 0.12
    drift_per_s: float = 0.8
    follow_s: float = 0.15

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gain) and self.gain > 1.0):
            raise InputError(f"envelope.gain: got {self.gain}, expected a factor above 1")
        for name in ("offset", "shape", "jump", "drift_per_s", "follow_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"envelope.{name}: got {value}, expected a positive finite number")

    def refuses(self, base: FeatureMap, frame: FeatureMap) -> str:
        """Why a frame is outside, or ""."""
        gain = frame.gain / base.gain
        if not 1.0 / self.gain <= gain <= self.gain:
            return f"gain {gain:.3f} of the identified, allowed {1.0 / self.gain:.3f} to {self.gain:.3f}"
        range_um = base.y_max_um - base.y_min_um
        shift_um = _at_rest(frame) - _at_rest(base)
        if not abs(shift_um) <= self.offset * range_um:
            return f"zero moved by {shift_um:.3g} µm, allowed {self.offset * range_um:.3g} µm"
        return ""

    def gain_allows(self, gain: float) -> bool:
        """Whether readings that move ``gain`` times as far as the reckoned stage can come from a sound sensor."""
        return bool(1.0 / self.gain <= gain <= self.gain)


def _at_rest(frame: FeatureMap) -> float:
    """Reading, µm, where the identified stage rests without voltage."""
    return frame.offset_um + frame.gain * frame.y_rest_um
