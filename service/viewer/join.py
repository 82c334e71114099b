"""Pairs each sample with the reference of the same sequence number, whichever of the two comes first."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adaptive.types import FloatArray
from service.viewer.feed import IntArray, Tracking


@dataclass(slots=True)
class ReferenceRing:
    """The last ``size`` references by sequence number. A slot knows whose it is, so old values are never taken."""

    size: int = 1 << 16
    _seq: IntArray = field(init=False)
    _value_um: FloatArray = field(init=False)
    newest: int = field(init=False, default=-1)

    def __post_init__(self) -> None:
        self._seq = np.full(self.size, -1, dtype=np.int64)
        self._value_um = np.full(self.size, np.nan)

    def put(self, seq: IntArray, value_um: FloatArray) -> None:
        """Remember references; (n,) each. Negative sequence numbers are nobody's and are left out."""
        keep = seq >= 0
        seq, value_um = seq[keep][-self.size :], value_um[keep][-self.size :]
        if seq.size:
            slot = seq % self.size
            self._seq[slot] = seq
            self._value_um[slot] = value_um
            self.newest = max(self.newest, int(seq.max()))

    def get(self, seq: IntArray) -> FloatArray:
        """References of these sequence numbers, µm; NaN where there is none (any more)."""
        slot = seq % self.size
        return np.where((self._seq[slot] == seq) & (seq >= 0), self._value_um[slot], np.nan)


@dataclass(slots=True)
class UnitJoin:
    """The samples of one unit on their way to becoming `Tracking`.

    A sample waits for its reference for at most ``patience_s`` of the stage's time, as references normally run
    ahead of the samples; then it goes on without. ``fallback`` is the ring of the unit whose reference holds
    for this one too when it has none of its own.
    """

    model: str
    ring: ReferenceRing
    fallback: ReferenceRing | None = None
    patience_s: float = 0.5
    restarts: int = 0
    _rows: FloatArray = field(init=False)
    _seq: IntArray = field(init=False)
    _newest_s: float = field(init=False, default=-np.inf)

    def __post_init__(self) -> None:
        self._rows = np.empty((0, 3))
        self._seq = np.empty(0, dtype=np.int64)

    def put(self, seq: IntArray, t_s: FloatArray, u_V: FloatArray, y_um: FloatArray) -> None:
        """Take n samples, (n,) each. A stage that begins anew (time runs backwards) takes away what waited."""
        finite = np.abs(t_s) < 9e9  # What Rerun can hold, in nanoseconds; NaN is not.
        seq, t_s, u_V, y_um = seq[finite], t_s[finite], u_V[finite], y_um[finite]
        if not seq.size:
            return
        if t_s[0] < self._newest_s:
            self.restarts += 1
            self._seq, self._rows = self._seq[:0], self._rows[:0]
        self._newest_s = float(t_s[-1])
        self._seq = np.concatenate([self._seq, seq])
        self._rows = np.concatenate([self._rows, np.column_stack([t_s, u_V, y_um])])

    def take(self, everything: bool = False) -> Tracking | None:
        """What is ready, in order, or None. ``everything`` leaves nothing waiting (at the end of a run)."""
        if not self._seq.size:
            return None
        reference = self.ring.get(self._seq)
        if self.fallback is not None:
            reference = np.where(np.isnan(reference), self.fallback.get(self._seq), reference)
        late = self._rows[:, 0] < self._rows[-1, 0] - self.patience_s
        ready = ~np.isnan(reference) | late | everything
        # In order: a sample whose reference is known waits behind one whose reference may still come.
        n = int(np.argmin(ready)) if not ready.all() else ready.size
        if n == 0:
            return None
        done, seq = self._rows[:n], self._seq[:n]
        self._rows, self._seq = self._rows[n:], self._seq[n:]
        return Tracking(
            self.model, seq, np.ascontiguousarray(done[:, 0]), np.ascontiguousarray(done[:, 1]),
            np.ascontiguousarray(done[:, 2]), reference[:n],
        )  # fmt: skip
