"""A standby's model: the samples as they come, and the state of the serving instance from which they go on.

The learner is deterministic: from one state on, the same samples give the same model to the last bit. Until the state
is there, samples are recorded and held back; those that it has seen already are left out, the others are learnt after
it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np

from adaptive.errors import ModelFileError
from service.intake.intake import Intake
from service.protocol.samples import SampleBatch
from service.server.axis import Axis
from service.server.axis_state import restore_axis
from service.storage.checkpoint import decode_checkpoint
from service.storage.checkpoint_keeper import learn_again

#: Samples that are remembered, to be learnt again behind a state that is older than they are.
KEPT: Final = 30_000
#: In a recording: what came while a standby held no state yet.
NOT_SYNCED: Final = "not_synced"


class Shadow:
    """Between the intake of a standby and its axis. All methods but :meth:`gate` run by way of ``Intake.call``.

    Parameters
    ----------
    kept : samples that are remembered.
    changed : called after the axis has gone on from another state, torn : where the samples do not follow on the state
    that was taken; both in the thread that handles samples.
    """

    def __init__(
        self,
        axis: Axis,
        intake: Intake,
        kept: int = KEPT,
        changed: Callable[[], None] = lambda: None,
        torn: Callable[[], None] = lambda: None,
    ) -> None:
        self.synced = False
        self.syncs = 0
        self._axis = axis
        self._intake = intake
        self._kept = kept
        self._changed = changed
        self._torn = torn
        #: The sample after which the first one is still to come; -1 for none.
        self._seam = -1
        self._recent: deque[SampleBatch] = deque()
        self._count = 0
        #: Whether samples that were held back are no longer remembered.
        self._forgotten = False

    def gate(self, batch: SampleBatch) -> SampleBatch | None:
        """For ``Intake.gate``: remembers the samples, and keeps them back until there is a state."""
        self._recent.append(batch)
        self._count += len(batch)
        while self._count > self._kept and len(self._recent) > 1:
            self._count -= len(self._recent.popleft())
            self._forgotten |= not self.synced
        if self.synced:
            self._look_at_seam([batch])
            return batch
        sink = self._intake.sink
        if sink is not None:
            sink.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, NOT_SYNCED)
        return None

    def take_state(self, data: bytes) -> int:
        """Go on from the serving instance's state; the sample that it had seen last.

        Raises ModelFileError where it does not match this axis; the axis is then as it was.
        """
        meta, state = decode_checkpoint(data)
        axis = self._axis
        meta.refuse_unless(meta.stage, axis.config.name, axis.dt_s)
        if meta.axis != axis.config.name:
            raise ModelFileError(f"axis is {meta.axis!r}, expected {axis.config.name!r}")
        restore_axis(axis, state)
        self.synced = True
        self._forgotten = False
        self.syncs += 1
        # All of them are in the recording.
        self._seam = meta.seq
        rest = behind(list(self._recent), meta.seq)
        self._look_at_seam(rest)
        for batch in rest:
            axis.handle(batch)
        self._rebase()
        return meta.seq

    @property
    def newest_seq(self) -> int:
        """The newest sample that has come and is remembered; -1 for none."""
        return int(self._recent[-1].seq[-1]) if self._recent else -1

    def give_up(self, inherit: Callable[[int], str] = lambda _: "") -> str:
        """There is nobody to take a state from: go on from the best there is, and learn what was held back.

        ``inherit`` is given the newest sample's number, may put another state into the axis, and says what that is.
        Returns in words from what this instance goes on; "" where it held the state already.
        """
        if self.synced:
            return ""
        self.synced = True
        axis = self._axis
        inherited = inherit(self.newest_seq)
        told = inherited or f"its own state of sample {axis.handled_seq}"
        if self._forgotten and not inherited and axis.config.recorder is not None:
            learn_again(axis, axis.config.recorder)
        held = list(self._recent)
        again = behind(held, axis.handled_seq) if inherited or self._forgotten else held
        for batch in again:
            axis.handle(batch)
        self._forgotten = False
        self._rebase()
        return f"{told}, then {sum(map(len, again))} samples that had been held back"

    def hold(self) -> None:
        """Wait for a state again: what serves now is another instance."""
        self.synced = self._forgotten = False
        self._recent.clear()
        self._count = 0

    def _look_at_seam(self, batches: list[SampleBatch]) -> None:
        """A sample that was on its way while the state was copied may be neither in the state nor behind it."""
        if self._seam < 0 or not batches:
            return
        first, seam = int(batches[0].seq[0]), self._seam
        self._seam = -1
        if first > seam + 1:
            self._torn()

    def _rebase(self) -> None:
        rebase = getattr(self._intake.sink, "rebase", None)
        if rebase is not None:
            rebase(self._axis.sequence.received)
        self._changed()


def behind(batches: list[SampleBatch], seq: int) -> list[SampleBatch]:
    """What came after sample ``seq``, in the order of arrival; where that one is not there, all with higher numbers.

    The order and not the number decides: a stage that has begun to count anew sends lower numbers than before.
    """
    for i in range(len(batches) - 1, -1, -1):
        at = np.flatnonzero(batches[i].seq == seq)
        if at.size:
            rest = _part(batches[i], slice(int(at[-1]) + 1, None))
            return [*([rest] if len(rest) else []), *batches[i + 1 :]]
    parts = [_part(batch, batch.seq > seq) for batch in batches]
    return [part for part in parts if len(part)]


def _part(batch: SampleBatch, which: slice | np.ndarray[tuple[int], np.dtype[np.bool_]]) -> SampleBatch:
    return SampleBatch(batch.seq[which], batch.t_s[which], batch.u_V[which], batch.y_um[which])
