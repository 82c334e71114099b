"""The corrections: pair the readings with what was asked for, by the numbers of their samples.

A follower has a `Correcting` of its own; `QueryCorrection` is that of the answers to queries.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dehyst.adaptive.correction.integral import Correction, sensitivity
from dehyst.adaptive.correction.repetition import Repetition
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.service.answers.answering import Served
from dehyst.service.answers.guard import Limits, guard
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.config.schema import build_settings, keys_of
from dehyst.service.intake.command_witness import DIFFERS_FROM, LEAST_TOLERANCE, TOLERANCE
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.query import CORRECTED, NEWEST, OUTSIDE_DOMAIN, STALE, FeedforwardQuery, Trajectory
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
    """What is added to the voltages of one controller. Raises FieldError where the axis has no displacement range.

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
        self._flagged = np.zeros(_KEPT, dtype=bool)
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
        self._wanted_um[numbers % _KEPT], self._flagged[numbers % _KEPT] = points[0][-_KEPT:], False
        point = points[0][:1], points[1][:1], points[2][:1]
        before, self._model = self._model, model
        if self.correction is not None:
            if before is not None and before is not model and before.memory_size == memory.size:
                changed_V = (model.feedforward(*point, memory).u_V - before.feedforward(*point, memory).u_V).item(0)
                if math.isfinite(changed_V):
                    self.correction.hand_over(changed_V, point[1].item(0))
            for _ in range(n):
                self.correction.let_in()
        u_V, std_V = answer
        if self.trouble or not self.on:
            self._readings.clear()
            return np.array([self._released() for _ in range(n)])
        if self._readings:
            self._look_at_age(first + n - 1 - self._readings[0][0])
            if self._slope_held == 0:
                self._local = sensitivity(model, point[0].item(0), memory, self._range_um)
            self._slope_held = (self._slope_held + 1) % self._slope_every
            self._take(first + n - 1, std_V)
        elif self.correction is not None:
            for _ in range(n):
                self.correction.wait()
        added_V = np.full(n, self.integral_V)
        if self.repetition is not None:
            added_V += [self.repetition.add(first + k, points[0].item(k), u_V.item(k)) for k in range(n)]
        return added_V

    def _released(self) -> float:
        """What is left, V, one sample later."""
        for each in self._each.values():
            each.release()
        return sum(each.u_V for each in self._each.values())

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
                if self._flagged.item(seq % _KEPT):
                    wanted_um = math.nan  # not what the model has answered
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
            for k, value in enumerate((u_V - self.integral_V).tolist()):
                self.repetition.applied(first + k, value)

    @property
    def integral_V(self) -> float:
        """The correction by the integral, V."""
        return 0.0 if self.correction is None else self.correction.u_V

    def begin(self, u_V: float, std_V: float) -> None:
        """Begin with the correction ``u_V``, V, as far as it is within its bound: a stage that is driven already."""
        if math.isfinite(u_V) and self.correction is not None:
            self.correction.begin(u_V, self._bound_V(std_V))

    def _bound_V(self, std_V: float) -> float:
        return min(self._most_V, _SIGMA * std_V) if std_V == std_V else 0.0

    def leave_out(self, first: int, flags: NDArray[Any]) -> None:
        """Of the (n,) points from sample ``first`` on, leave out of the integral those that were answered with flags.

        What repeats is learnt from them too: from the voltage that they got, whatever it came of.
        """
        self._flagged[(first + np.arange(len(flags)))[-_KEPT:] % _KEPT] = np.asarray(flags)[-_KEPT:] != 0

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


class _Read(NamedTuple):
    """A sample: its number, voltage, V, and reading, µm; NaN for a reading that is doubted."""

    seq: int
    u_V: float
    y_um: float


class QueryCorrection:
    """The correction of an axis' answers to queries that name what is under way.

    The readings are those of the samples. One controller is corrected: its queries continue the answers before, and the
    samples show the voltages of these answers. Queries that compare models get no correction, nor does a controller
    that adds something of its own, as a follower with readings does. Once the stage has passed the last answer, another
    controller may begin, at zero. ``note`` : takes the name of an event and its detail.

    Any thread may call `answer`; `read` and `forget` are for the one that handles samples. Raises FieldError where the
    axis has no displacement range.
    """

    def __init__(self, config: CorrectionConfig, limits: Limits, dt_s: float, note: Callable[[str, str], None]) -> None:
        self._made = config, limits, dt_s
        self._limits, self._note = limits, note
        span_V = limits.u_max_V - limits.u_min_V
        self._own_V, self._shown_V = LEAST_TOLERANCE * span_V, TOLERANCE * span_V
        self._lock = threading.Lock()
        self._samples: deque[_Read] = deque(maxlen=_KEPT)
        self._begin()

    def _begin(self) -> None:
        """Correct nobody: from zero."""
        self._correcting = Correcting(*self._made)
        # By the number of the sample: what was answered for it, and how much of that is the correction, V.
        self._numbers = np.full(_KEPT, -1, dtype=np.int64)
        self._answered_V, self._added_V = np.zeros(_KEPT), np.zeros(_KEPT)
        self._end = -1
        self._differ = 0

    def read(self, seq: int, u_V: float, y_um: float) -> None:
        """Take a sample: its voltage, V, and its reading, µm; NaN for one that is not to be believed."""
        self._samples.append(_Read(seq, u_V, y_um))

    def forget(self) -> None:
        """The stage has begun another count."""
        with self._lock:
            self._samples.clear()
            self._begin()

    def answer(
        self, query: FeedforwardQuery, ask: Callable[[FeedforwardQuery], Trajectory], ring: Sequence[Served], seen: int
    ) -> Trajectory:
        """The answer of ``ask`` to ``query``, which has samples under way, with the correction.

        ring : snapshots that ``ask`` answers from. seen : number of the last sample that was handled.
        """
        assert query.pending is not None
        first, way_V = query.pending.first + query.pending.u_V.size, query.pending.u_V.copy()
        with self._lock:
            self._take(seen if query.as_of == NEWEST else query.as_of)
            before_V = self._before(first, way_V.item(-1), seen)
        if before_V is None:
            return ask(query)
        # The correction is no part of what the models say: what fades at the beginning is the rest.
        way_V[-1] -= before_V
        pending = query.pending._replace(u_V=way_V)
        got = ask(query._replace(pending=pending, u_before_V=query.u_before_V - before_V))
        # A snapshot has seen all that it will see; the correction has not before the last reading has come.
        got = got._replace(behind=got.behind or seen < query.as_of)
        served = next(one for one in reversed(ring) if one.seq == got.snapshot_seq)
        with self._lock:
            return self._added(query, got, served, first)

    def _added(self, query: FeedforwardQuery, got: Trajectory, served: Served, first: int) -> Trajectory:
        """The answer ``got``, whose first point is for sample ``first``, with the correction."""
        model, trouble = served.models[got.model], served.trouble or ("stale" if got.flags[-1] & STALE else "")
        points = query.y_um, query.v_um_per_s, query.a_um_per_s2
        answer = got.u_V, got.std_V.item(0)
        if got.behind:  # asked again later: time has not gone on
            added_V = np.full(got.u_V.size, self._correcting.integral_V)
        else:
            added_V = self._correcting.voltage(first, model, points, served.memories[got.model], answer, trouble)
        inside = (got.flags & OUTSIDE_DOMAIN) == 0
        u_V, flags = guard(got.u_V + added_V, inside, model.dt_s, self._limits, query.u_before_V)
        flags |= got.flags
        self._correcting.leave_out(first, flags)
        self._end = first + u_V.size
        numbers = np.arange(first, self._end)[-_KEPT:]
        at = numbers % _KEPT
        self._numbers[at], self._answered_V[at], self._added_V[at] = numbers, u_V[-_KEPT:], added_V[-_KEPT:]
        flags[added_V != 0.0] |= CORRECTED
        return got._replace(u_V=u_V, flags=flags)

    def _before(self, first: int, last_V: float, seen: int) -> float | None:
        """The correction, V, in ``last_V``, which is under way before sample ``first``; None for who is not corrected.

        seen : number of the last sample that was handled.
        """
        last = min(first, self._end) - 1  # what was answered last is held
        if (
            self._numbers.item(last % _KEPT) == last
            and abs(last_V - self._answered_V.item(last % _KEPT)) <= self._own_V
        ):
            return self._added_V.item(last % _KEPT)
        if self._end > seen:
            return None
        self._begin()
        self._note("correction_begun", f"of the answers to a controller, from sample {first} on and from zero")
        return 0.0

    def _take(self, until: int) -> None:
        """Hand on the samples up to ``until`` whose voltages were answered here."""
        numbers, readings_um = [], []
        while self._samples and self._samples[0].seq <= until:
            seq, u_V, y_um = self._samples.popleft()
            near = np.arange(seq - 1, seq + 2)
            near_V = self._answered_V[near[self._numbers[near % _KEPT] == near] % _KEPT]
            if not near_V.size:
                continue
            shown = near_V.min() - self._shown_V <= u_V <= near_V.max() + self._shown_V
            self._differ = 0 if shown else self._differ + 1
            numbers.append(seq)
            readings_um.append(y_um if shown else math.nan)
        if self._differ >= DIFFERS_FROM:
            self._begin()
        elif numbers:
            self._correcting.read(numbers, readings_um)

    def status(self) -> dict[str, Any]:
        """``state`` in words, size ``u_V``, V, gain, 1/s, age, samples, and counts, as JSON values; for any thread."""
        correcting = self._correcting
        correction = correcting.correction
        assert correction is not None
        let_go = f"let go: {correcting.trouble}" if correcting.trouble else "corrects"
        return {
            "state": let_go if self._end >= 0 else "nobody is corrected",
            "u_V": correction.u_V,
            "gain_per_s": correction.factor * correction.loop.gain_per_s,
            "age": correcting.age,
            "halved": correction.halved,
            "doubted": correction.doubted,
        }
