"""Compares the voltage of each sample with the one that was commanded for it.

A controller that asks for the next voltages sends what is under way: the voltages that it has commanded, and the motion
that they are for, by the numbers of the samples (`service.protocol.query.Pending`). A sample with such a number has to
show that voltage. Where many in a row do not, the columns are exchanged, scaled or late, or the samples are those of
another stage. Commanded voltage and place then replace those of the samples, from the first such sample on: a place of
another stage would otherwise stay in the memory of the hysteresis. Until the difference is named, only a sample that
shows the voltage of the one before is believed: a stage that missed a command holds its voltage.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.query import Pending

#: Largest and least tolerance for the difference from the commanded voltage, as shares of the voltage range. A
#: converter rounds, and a voltage that is read back has noise.
TOLERANCE, LEAST_TOLERANCE = 0.01, 1e-4
#: Within these limits the tolerance is ``_SIGMA`` standard deviations of the differences in some ``_OVER`` samples.
_SIGMA: Final = 5.0
_OVER: Final = 500
#: The voltage of a sample may be that of a neighbour: sender and stage count the instant of a voltage differently.
_NEIGHBOURS: Final = 1
#: A sample that differs adds one, one that agrees takes one away. Samples differ from this count on, until it is 0.
DIFFERS_FROM: Final = 10
_MOST_DOUBT: Final = 2 * DIFFERS_FROM
#: A controller counts only after its voltages agreed with this many samples that moved: a voltage that is read back in
#: another scale, or that of a client that does not move the stage, never agrees.
_CREDIT: Final = 50
#: Queries that are kept: at one a sample, more than samples wait in messages and queue.
_KEPT: Final = 256


class CommandWitness:
    """Compares the voltages of samples with those commanded.

    `note` may be called from any thread, all else from the one that handles samples. Without a controller that names
    what is under way nothing is compared. It is no part of the state: a replay does not know what was commanded.

    Parameters
    ----------
    span_V : range of the voltages that may be commanded, V.
    """

    def __init__(self, span_V: float) -> None:
        self._most_V, self._least_V = TOLERANCE * span_V, LEAST_TOLERANCE * span_V
        self._differences_V2 = (self._most_V / _SIGMA) ** 2
        # Newest last. A tuple that is replaced as a whole: two threads at once may lose a query, and no more.
        self._claims: tuple[Pending, ...] = ()
        self._doubt = 0
        self._credit = 0
        self._moved_V = self._shown_V = float("nan")
        #: What the last one that differed showed, in words; "" while the samples agree.
        self.why = ""

    @property
    def doubts(self) -> bool:
        """Whether a sample has differed lately: such ones teach nothing, so nothing has to be undone later."""
        return self._doubt > 0 and self._credit >= _CREDIT

    @property
    def tolerance_V(self) -> float:
        """Difference from what was commanded up to which a voltage agrees, V."""
        return min(max(_SIGMA * math.sqrt(self._differences_V2), self._least_V), self._most_V)

    def note(self, pending: Pending, y_um: FloatArray, u_V: FloatArray) -> None:
        """Keep what a controller has commanded, and the (n,) voltages, V, for ``y_um``, µm, that are its answer."""
        claim = Pending(pending.first, np.concatenate([pending.y_um, y_um]), np.concatenate([pending.u_V, u_V]))
        self._claims = (*self._claims[1 - _KEPT :], claim)

    def take(self, seq: int, u_V: float) -> tuple[float, float] | None:
        """(voltage, V, and displacement, µm) commanded for sample ``seq``, where its ``u_V`` is not to be believed.

        None where it is, and where nothing is known.
        """
        known: tuple[float, float] | None = None
        tolerance_V = self.tolerance_V
        for claim in reversed(self._claims):
            k = seq - claim.first
            if not 0 <= k < claim.u_V.size:
                continue
            near_V = claim.u_V[max(0, k - _NEIGHBOURS) : k + 1 + _NEIGHBOURS]
            if near_V.min() - tolerance_V <= u_V <= near_V.max() + tolerance_V:
                self._agrees(u_V, float(np.abs(near_V - u_V).min()))
                return self._stands_in(known, u_V)
            known = known or (float(claim.u_V[k]), float(claim.y_um[k]))
        if known is not None:
            self._differs(seq, u_V, known[0])
        elif self._claims or self._doubt:
            # What is over is dropped: otherwise each later sample would look through all of it.
            self._claims = tuple(claim for claim in self._claims if claim.first + claim.u_V.size > seq)
            self._believe()
        return self._stands_in(known, u_V)

    def _stands_in(self, known: tuple[float, float] | None, u_V: float) -> tuple[float, float] | None:
        """What is to be believed in place of a sample, of which ``known`` was commanded; None for the sample itself."""
        if known is None or not self.doubts:
            self._shown_V = u_V
            return None
        held = not self.why and not abs(u_V - self._shown_V) > self.tolerance_V
        return None if held else known

    def _agrees(self, u_V: float, difference_V: float) -> None:
        self._differences_V2 += (difference_V**2 - self._differences_V2) / _OVER
        # A stage at rest agrees with every client that has asked for its place.
        if not abs(u_V - self._moved_V) <= self._most_V:
            self._moved_V = u_V
            self._credit = min(self._credit + 1, _CREDIT)
        self._believe()

    def _believe(self) -> None:
        self._doubt = max(self._doubt - 1, 0)
        if not self._doubt:
            self.why = ""

    def _differs(self, seq: int, u_V: float, commanded_V: float) -> None:
        self._doubt = min(self._doubt + 1, _MOST_DOUBT)
        if self._doubt >= DIFFERS_FROM and self._credit >= _CREDIT:
            self.why = f"sample {seq} shows {u_V:.6g} V, {commanded_V:.6g} V were commanded for it"
