"""What the samples of a stage and the voltages sent to it show, second by second.

Seconds are kept, not samples, so that a run of days fits into memory. A stage limits what it is sent, so that what it
applied says nothing about who sent it: both are looked at.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from lab.soak.processes.control import Control
from service.protocol import samples as wire

# --- Which sample numbers have been seen, as few intervals as they make.


class Intervals:
    """A set of integers that come mostly in order; memory grows with the number of gaps only."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._stops: list[int] = []

    def __len__(self) -> int:
        return sum(stop - start for start, stop in zip(self._starts, self._stops, strict=True))

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The intervals, in order, as (first, one past the last)."""
        return list(zip(self._starts, self._stops, strict=True))

    def add(self, start: int, stop: int) -> None:
        """Take the numbers from ``start`` to ``stop`` - 1."""
        if stop <= start:
            return
        i = bisect_right(self._starts, start)
        # All that touch the new one are joined with it.
        first = i - 1 if i and self._stops[i - 1] >= start else i
        last = first
        while last < len(self._starts) and self._starts[last] <= stop:
            start, stop = min(start, self._starts[last]), max(stop, self._stops[last])
            last += 1
        self._starts[first:last] = [start]
        self._stops[first:last] = [stop]

    def add_all(self, numbers: NDArray[np.int64]) -> None:
        """Take numbers in any order."""
        if not numbers.size:
            return
        if numbers[-1] - numbers[0] + 1 == numbers.size and (np.diff(numbers) == 1).all():
            self.add(int(numbers[0]), int(numbers[-1]) + 1)
            return
        distinct = np.unique(numbers)
        breaks = np.flatnonzero(np.diff(distinct) != 1)
        for start, stop in zip(np.r_[0, breaks + 1], np.r_[breaks, distinct.size - 1], strict=True):
            self.add(int(distinct[start]), int(distinct[stop]) + 1)

    def minus(self, other: Intervals) -> list[tuple[int, int]]:
        """What is here and not in ``other``, as (first, one past the last)."""
        missing = []
        for start, stop in self.spans:
            at = start
            for other_start, other_stop in other.spans:
                if other_stop <= at or other_start >= stop:
                    continue
                if other_start > at:
                    missing.append((at, other_start))
                at = max(at, other_stop)
            if at < stop:
                missing.append((at, stop))
        return missing


#: Samples for which the reference and the voltages sent are remembered.
_RING = 16_384
#: Numbers further apart than this are those of two lives of the stage.
OTHER_LIFE = 10_000_000
#: What stands at the slew limit by round-off alone is not beyond it.
ROUND_OFF = 1.0 + 1e-6
#: Blocks that wait for the sample that they begin with.
_MAX_WAITING = 64


@dataclass(slots=True)
class Second:
    """One second of samples: how many, the sums and worst of |error| in µm, and of the voltages what was worst.

    ``held`` samples had no command of their own in time: the stage held the last one. ``step_max_V``, ``beyond_V`` and
    ``not_finite`` are of the voltages that the stage applied; ``sent_``... the same of those that it was sent.
    ``resumed_V`` is the step with which a block began where none was seen for the samples before it.
    """

    t_s: float
    seq: int = 0
    samples: int = 0
    judged: int = 0
    error_sum_um: float = 0.0
    error_max_um: float = 0.0
    step_max_V: float = 0.0
    beyond_V: float = 0.0
    held: int = 0
    not_finite: int = 0
    sent_step_V: float = 0.0
    sent_beyond_V: float = 0.0
    sent_not_finite: int = 0
    resumed_V: float = 0.0

    @property
    def mae_um(self) -> float:
        """Mean |error|, µm; NaN where nothing could be judged."""
        return self.error_sum_um / self.judged if self.judged else math.nan


@dataclass
class Track:
    """Fed with references, commands and batches of samples, in the order of arrival.

    ``clock`` tells the time of a batch, s, on the axis of the report.
    """

    control: Control
    clock: Callable[[], float]
    seconds: list[Second] = field(default_factory=list)
    seen: Intervals = field(default_factory=Intervals)

    def __post_init__(self) -> None:
        self._wanted = np.full(_RING, np.nan)
        self._wanted_seq = np.full(_RING, -1, dtype=np.int64)
        self._commanded_V = np.full(_RING, np.nan)
        self._commanded_seq = np.full(_RING, -1, dtype=np.int64)
        self._u_V, self._seq = math.nan, -2
        #: The voltage sent for the furthest sample, and its number.
        self._sent_V, self._sent_seq = math.nan, -2
        #: By its first sample, a block that began too far from the last one sent: its voltage there, and that step.
        self._resumed: dict[int, tuple[float, float]] = {}
        self.newest = -1
        self.received = 0
        self.repeated = 0

    def want(self, first: int, y_um: FloatArray) -> None:
        """The reference from sample ``first`` on, µm."""
        numbers = np.arange(first, first + y_um.size)
        self._wanted[numbers % _RING] = y_um
        self._wanted_seq[numbers % _RING] = numbers

    def command(self, first: int, u_V: FloatArray) -> None:
        """Voltages sent for the samples from ``first`` on, V: as they are, whatever the stage will make of them.

        The first of them follows what was last sent for the sample before it, also where a block replaces another.
        """
        second = self._second()
        finite = np.isfinite(u_V)
        second.sent_not_finite += int(np.count_nonzero(~finite))
        if finite.any():
            second.sent_beyond_V = max(second.sent_beyond_V, self._beyond_V(u_V[finite]))
        slot = (first - 1) % _RING
        before_V = float(self._commanded_V[slot]) if self._commanded_seq[slot] == first - 1 else math.nan
        with np.errstate(invalid="ignore"):
            steps = np.abs(np.diff(u_V, prepend=before_V))
        known = steps[np.isfinite(steps)]
        if known.size:
            second.sent_step_V = max(second.sent_step_V, float(known.max()))
        if math.isnan(before_V) and finite[0]:
            self._resume(first, float(u_V[0]))
        numbers = np.arange(first, first + u_V.size)
        self._commanded_V[numbers % _RING] = u_V
        self._commanded_seq[numbers % _RING] = numbers
        if not 0 < self._sent_seq - int(numbers[-1]) < OTHER_LIFE:
            self._sent_V, self._sent_seq = float(u_V[-1]), int(numbers[-1])

    def refuse_command(self) -> None:
        """A command that could not be read: no voltage that anybody may apply came of it."""
        self._second().sent_not_finite += 1

    def take(self, batch: wire.SampleBatch) -> None:
        """Samples as they came."""
        second = self._second()
        seq, u_V = batch.seq, batch.u_V
        self.received += len(batch)
        fresh = seq > self.newest if abs(int(seq[0]) - self.newest) < OTHER_LIFE else np.ones(len(batch), dtype=bool)
        self.repeated += len(batch) - int(np.count_nonzero(fresh))
        self.seen.add_all(seq)
        second.samples += len(batch)
        second.seq = int(seq[-1])
        slots = seq % _RING
        in_time = (self._commanded_seq[slots] == seq) & (self._commanded_V[slots] == u_V)
        second.held += len(batch) - int(np.count_nonzero(in_time))
        finite = np.isfinite(u_V)
        second.not_finite += int(np.count_nonzero(~finite))
        if finite.any():
            second.beyond_V = max(second.beyond_V, self._beyond_V(u_V[finite]))
        if fresh.all():
            # The step is that of samples that follow one another; what lies between others nobody saw.
            before = np.concatenate(([self._u_V], u_V[:-1]))
            follows = np.diff(seq, prepend=self._seq) == 1
            if follows.any():
                second.step_max_V = max(second.step_max_V, float(np.max(np.abs(u_V - before)[follows])))
            if self._resumed:
                self._judge_resumed(second, seq, np.where(follows, before, np.nan))
            self._u_V, self._seq = float(u_V[-1]), int(seq[-1])
            self.newest = int(seq[-1])
        known = (self._wanted_seq[seq % _RING] == seq) & np.isfinite(batch.y_um)
        if known.any():
            error = np.abs(self._wanted[seq % _RING] - batch.y_um)[known]
            second.judged += error.size
            second.error_sum_um += float(error.sum())
            second.error_max_um = max(second.error_max_um, float(error.max()))

    def _second(self) -> Second:
        """The second that is under way. One that no sample has come in ends with the number of the one before."""
        now = self.clock()
        if not self.seconds or now - self.seconds[-1].t_s >= 1.0:
            self.seconds.append(Second(math.floor(now), self.seconds[-1].seq if self.seconds else 0))
        return self.seconds[-1]

    def _beyond_V(self, u_V: FloatArray) -> float:
        return max(float(u_V.max()) - self.control.u_max_V, self.control.u_min_V - float(u_V.min()))

    def _resume(self, first: int, u_V: float) -> None:
        """A block for which none was seen before: its controller gave one up, or what it sent did not come here.

        A stage without a command holds the last one, so the block has to begin where that ended; where it does not, the
        voltage that the stage applies until then decides. Where neither is known, as at the beginning of a stage's
        life, there is nothing to begin from.
        """
        control = self.control
        follows = 0 < first - self._sent_seq < OTHER_LIFE and math.isfinite(self._sent_V)
        step_V = abs(u_V - self._sent_V) if follows else math.inf
        if step_V > control.slew_V_per_s * control.dt_s * ROUND_OFF:
            self._resumed[first] = u_V, step_V
            if len(self._resumed) > _MAX_WAITING:
                self._resumed.pop(next(iter(self._resumed)))

    def _judge_resumed(self, second: Second, seq: NDArray[np.int64], before_V: FloatArray) -> None:
        """``before_V``: by sample, the voltage applied before it; NaN where that sample was not seen."""
        for first in [first for first in self._resumed if seq[0] <= first <= seq[-1] or first < seq[0] < first + _RING]:
            u_V, step_V = self._resumed.pop(first)
            at = np.flatnonzero((seq == first) & np.isfinite(before_V))
            if at.size:
                step_V = min(step_V, abs(u_V - float(before_V[at[0]])))
            if math.isfinite(step_V):
                second.resumed_V = max(second.resumed_V, step_V)
