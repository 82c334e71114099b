"""The correction of a follower: pairs the readings with what was asked for, by the numbers of their samples."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptive.correction import Correction, sensitivity
from adaptive.types import FloatArray, InverseModel
from service.answers.guard import Limits
from service.config.correction import CorrectionConfig
from service.config.schema import build_settings, keys_of
from service.protocol.errors import FieldError
from service.protocol.samples import column, sequence

_LOGGER: Final = logging.getLogger("dehyst.client")
#: Displacement, µm, velocity, µm/s, and acceleration, µm/s², (n,) each.
Motion = tuple[FloatArray, FloatArray, FloatArray]

#: Points that are kept for readings to come; older readings are left out.
_KEPT: Final = 4096
#: Standard deviations of the model's answer up to which it is corrected.
_SIGMA: Final = 4.0
#: Time after which the slope of the model is taken anew, s; points for which the largest age of the readings is kept.
_SLOPE_S: Final = 0.02
_AGE_KEPT: Final = 1000


class Correcting:
    """What a follower adds to its voltages. Raises FieldError where the axis has no displacement range.

    Attributes
    ----------
    on : False lets the correction go, over ``fade_s``. trouble : for which it is let go now, "" for none.
    correction : the integral and its state.
    age : samples from a reading to the last voltage that it changes; the largest of late.
    """

    def __init__(self, config: CorrectionConfig, limits: Limits, dt_s: float) -> None:
        self._range_um = limits.y_max_um - limits.y_min_um
        if not math.isfinite(self._range_um):
            raise FieldError("limits.y_min_um, y_max_um", "none", "the displacement range of the axis")
        self.on = True
        self.trouble = ""
        self.correction = Correction(dt_s, config.mode_Hz, config.fade_s)
        self.age = 0
        self._most_V = config.share * (limits.u_max_V - limits.u_min_V)
        self._dt_s, self._slope_every = dt_s, math.ceil(_SLOPE_S / dt_s)
        self._wanted_um = np.full(_KEPT, math.nan)
        self._numbers = np.full(_KEPT, -1, dtype=np.int64)
        self._readings: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        self._read = -1
        self._age_held = self._slope_held = 0
        self._local = 0.0, 0.0
        self._model: InverseModel | None = None

    @classmethod
    def of_status(cls, status: Mapping[str, Any], limits: Limits, dt_s: float) -> Correcting | None:
        """As the status of an axis says; None where it has no correction. Raises FieldError on impossible settings."""
        said = status.get("correction")
        if not said:
            return None
        known = {key.name for key in keys_of(CorrectionConfig)}  # a newer service may say more
        table = {name: value for name, value in dict(said).items() if name in known}
        return cls(build_settings(CorrectionConfig, table, "status.correction"), limits, dt_s)

    def read(self, seq: ArrayLike, y_um: ArrayLike) -> None:
        """Take the (n,) readings ``y_um``, µm, of the samples ``seq``, rising; those that were taken are left out.

        Raises FieldError if the lengths differ, or the numbers are not whole or do not rise; then nothing changes.
        """
        numbers, y = sequence("seq", seq), column("y_um", y_um)
        if numbers.size != y.size:
            raise FieldError("y_um", f"{y.size} values", f"{numbers.size}, as many as seq")
        if numbers.size > 1 and not (np.diff(numbers) > 0).all():
            raise FieldError("seq", f"{numbers[:5].tolist()} ...", "rising sample numbers")
        new = numbers > self._read
        self._readings.extend(zip(numbers[new].tolist(), y[new].tolist(), strict=True))
        if self._readings:
            self._read = self._readings[-1][0]

    def voltage(
        self, first: int, model: InverseModel, points: Motion, memory: FloatArray, std_V: float, trouble: str = ""
    ) -> float:
        """The correction, V, of the voltages for (n,) ``points`` from sample ``first`` on.

        memory : (m,) of ``model`` before the first one. std_V : standard deviation of the model's answer to it, V; NaN
        where it states none: then nothing is corrected. trouble : what the service has named, "" for nothing.
        """
        correction, n, self.trouble = self.correction, points[0].size, trouble
        numbers = np.arange(first, first + n)[-_KEPT:]
        self._numbers[numbers % _KEPT] = numbers
        self._wanted_um[numbers % _KEPT] = points[0][-_KEPT:]
        last, point = first + n - 1, (points[0][:1], points[1][:1], points[2][:1])
        before, self._model = self._model, model
        if before is not None and before is not model and correction.u_V and before.memory_size == memory.size:
            changed_V = model.feedforward(*point, memory).u_V.item(0) - before.feedforward(*point, memory).u_V.item(0)
            if math.isfinite(changed_V):
                correction.hand_over(changed_V)
        if self.trouble or not self.on:
            self._readings.clear()
            correction.release()
            return correction.u_V
        if not self._readings:
            correction.wait()
            return correction.u_V
        self._look_at_age(last - self._readings[0][0])
        if self._slope_held == 0:
            self._local = sensitivity(model, point[0].item(0), memory, self._range_um)
        self._slope_held = (self._slope_held + 1) % self._slope_every
        correction.set(self.age, *self._local, self._bound_V(std_V))
        halved = correction.halved
        for seq, read_um in self._readings:
            wanted_um = self._asked(seq)
            correction.take(wanted_um - read_um, (wanted_um - self._asked(seq - 1)) / self._dt_s)
        self._readings.clear()
        if correction.halved > halved:
            _LOGGER.warning(
                "the correction oscillated up to sample %d: its gain is now %g of the design; is correction.mode_Hz "
                "above the stage's first mode?", last, correction.factor,
            )  # fmt: skip
        return correction.u_V

    def begin(self, u_V: float, std_V: float) -> None:
        """Begin with the correction ``u_V``, V, as far as it is within its bound: a stage that is driven already."""
        if math.isfinite(u_V):
            self.correction.begin(u_V, self._bound_V(std_V))

    def _bound_V(self, std_V: float) -> float:
        return min(self._most_V, _SIGMA * std_V) if std_V == std_V else 0.0

    def leave_out(self, first: int, flags: NDArray[Any]) -> None:
        """Of the (n,) points from sample ``first`` on, leave out those that were answered with flags."""
        flagged = first + np.flatnonzero(flags)[-_KEPT:]
        self._wanted_um[flagged % _KEPT] = math.nan

    def _asked(self, seq: int) -> float:
        """What was asked for at sample ``seq``, µm; NaN where that is not known, or another than the model answered."""
        at = seq % _KEPT
        return self._wanted_um.item(at) if self._numbers.item(at) == seq else math.nan

    def _look_at_age(self, age: int) -> None:
        self._age_held += 1
        if age >= self.age or self._age_held >= _AGE_KEPT:
            self.age, self._age_held = max(age, 0), 0
