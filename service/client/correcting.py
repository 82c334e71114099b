"""The corrections of a follower: pair the readings with what was asked for, by the numbers of their samples."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dehyst.adaptive.correction.integral import Correction, sensitivity
from dehyst.adaptive.correction.repetition import Repetition
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.config.schema import build_settings, keys_of
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import column, sequence

_LOGGER: Final = logging.getLogger("dehyst.client")
#: Displacement, µm, velocity, µm/s, and acceleration, µm/s², (n,) each.
Motion = tuple[FloatArray, FloatArray, FloatArray]
_Config = TypeVar("_Config", CorrectionConfig, RepetitionConfig)
#: (n,) voltages, V, and the standard deviation of the first one, V.
Answer = tuple[FloatArray, float]

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
    on : False lets the corrections go, over ``fade_s``. trouble : for which they are let go now, "" for none.
    correction : the integral and its state; None where the axis has none. repetition : the correction of motion that
    repeats; None where the axis has none. While it is active the integral stays as it is.
    age : samples from a reading to the last voltage that it changes; the largest of late.
    """

    def __init__(
        self, config: CorrectionConfig, limits: Limits, dt_s: float, repetition: RepetitionConfig | None = None
    ) -> None:
        self._range_um = limits.y_max_um - limits.y_min_um
        if not math.isfinite(self._range_um):
            raise FieldError("limits.y_min_um, y_max_um", "none", "the displacement range of the axis")
        self.on = True
        self.trouble = ""
        self.correction = Correction(dt_s, config.mode_Hz, config.fade_s) if config.on else None
        self.repetition = None
        drive_V = limits.u_max_V - limits.u_min_V
        self._most_V, self._most_repeated_V = config.share * drive_V, 0.0
        if repetition is not None and repetition.on:
            self.repetition = Repetition(dt_s, repetition.mode_Hz, repetition.fade_s)
            self._most_repeated_V = repetition.share * drive_V
        made = {"correction": self.correction, "repetition": self.repetition}
        self._each = {name: each for name, each in made.items() if each is not None}
        self.age = 0
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
        correction = _said(CorrectionConfig, status, "correction")
        repetition = _said(RepetitionConfig, status, "repetition")
        if correction is None and repetition is None:
            return None
        return cls(correction or CorrectionConfig(), limits, dt_s, repetition)

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
        self, first: int, model: InverseModel, points: Motion, memory: FloatArray, answer: Answer, trouble: str = ""
    ) -> FloatArray:
        """(n,) corrections, V, of the voltages for (n,) ``points`` from sample ``first`` on.

        memory : (m,) of ``model`` before the first one. answer : (n,) voltages that the model gives, V, and standard
        deviation of the first one, V; NaN where it states none: then nothing is corrected but motion that repeats.
        trouble : what the service has named, "" for nothing.
        """
        n, self.trouble = points[0].size, trouble
        numbers = np.arange(first, first + n)[-_KEPT:]
        self._numbers[numbers % _KEPT] = numbers
        self._wanted_um[numbers % _KEPT] = points[0][-_KEPT:]
        point = points[0][:1], points[1][:1], points[2][:1]
        before, self._model = self._model, model
        if before is not None and before is not model and self._integral_V and before.memory_size == memory.size:
            changed_V = model.feedforward(*point, memory).u_V.item(0) - before.feedforward(*point, memory).u_V.item(0)
            if math.isfinite(changed_V) and self.correction is not None:
                self.correction.hand_over(changed_V)
        u_V, std_V = answer
        if self.trouble or not self.on:
            self._readings.clear()
            for each in self._each.values():
                each.release()
            return np.full(n, sum(each.u_V for each in self._each.values()))
        if self._readings:
            self._look_at_age(first + n - 1 - self._readings[0][0])
            if self._slope_held == 0:
                self._local = sensitivity(model, point[0].item(0), memory, self._range_um)
            self._slope_held = (self._slope_held + 1) % self._slope_every
            self._take(first + n - 1, std_V)
        elif self.correction is not None:
            self.correction.wait()
        added_V = np.full(n, self._integral_V)
        if self.repetition is not None:
            added_V += [self.repetition.add(first + k, points[0].item(k), u_V.item(k)) for k in range(n)]
        return added_V

    def _take(self, last: int, std_V: float) -> None:
        """Use the readings that have come; ``last`` : sample of the last voltage that they can change."""
        correction, repetition = self.correction, self.repetition
        if correction is not None:
            correction.set(self.age, *self._local, self._bound_V(std_V))
        if repetition is not None:
            repetition.set(self.age, *self._local, self._most_repeated_V)
        halved = {name: each.halved for name, each in self._each.items()}
        for seq, read_um in self._readings:
            wanted_um = self._asked(seq)
            if repetition is not None:
                repetition.read(seq, wanted_um - read_um)
            if correction is not None and not (repetition is not None and repetition.active):
                correction.take(wanted_um - read_um, (wanted_um - self._asked(seq - 1)) / self._dt_s)
        self._readings.clear()
        for name, each in self._each.items():
            if each.halved > halved[name]:
                _LOGGER.warning(
                    "the %s grew up to sample %d: its gain is now %g of the design; is %s.mode_Hz above the stage's "
                    "first mode?", name, last, each.factor, name,
                )  # fmt: skip

    def applied(self, first: int, u_V: FloatArray) -> None:
        """Take the (n,) voltages, V, that the points from sample ``first`` on got in the end."""
        if self.repetition is not None:
            for k, value in enumerate((u_V - self._integral_V).tolist()):
                self.repetition.applied(first + k, value)

    @property
    def _integral_V(self) -> float:
        return 0.0 if self.correction is None else self.correction.u_V

    def begin(self, u_V: float, std_V: float) -> None:
        """Begin with the correction ``u_V``, V, as far as it is within its bound: a stage that is driven already."""
        if math.isfinite(u_V) and self.correction is not None:
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


def _said(kind: type[_Config], status: Mapping[str, Any], name: str) -> _Config | None:
    """Settings as a status says them; None where it says none. Raises FieldError on impossible ones."""
    said = status.get(name)
    if not said:
        return None
    known = {key.name for key in keys_of(kind)}  # a newer service may say more
    table = {key: value for key, value in dict(said).items() if key in known}
    return build_settings(kind, table, f"status.{name}")
