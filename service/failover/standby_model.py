"""The model of a standby: the state of the serving instance, and the samples since then.

The learner is deterministic: the same state and the same samples give the same model, bit by bit. Until the standby has
received the state, it records the samples and keeps them in memory. Then it learns those that the state does not
include.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.storage.checkpoint import decode_checkpoint, learn_again

if TYPE_CHECKING:
    from dehyst.service.storage.recorder import Recorder

_STANDBY_SUFFIX: Final = "-standby"
#: Samples kept in memory, to be learnt after an older state.
KEPT_SAMPLES: Final = 30_000
#: Verdict in a recording of samples that arrived before the standby had a state.
NOT_SYNCED: Final = "not_synced"


def standby_folder(folder: Path | None) -> Path | None:
    """The folder of the standby that corresponds to ``folder`` of the other instance."""
    return None if folder is None else folder.with_name(folder.name + _STANDBY_SUFFIX)


class StandbyModel:
    """Stands between the queue of a standby and its axis. Call all methods in the thread that handles samples.

    Parameters
    ----------
    kept : samples kept in memory.
    on_restored : called after the axis has continued from another state.
    on_gap : called if samples are missing between the received state and the samples since then.

    Attributes
    ----------
    synced : True if the axis holds the model of the serving instance.
    """

    def __init__(
        self,
        axis: Axis,
        sink: Recorder | None,
        kept: int = KEPT_SAMPLES,
        on_restored: Callable[[], None] = lambda: None,
        on_gap: Callable[[], None] = lambda: None,
    ) -> None:
        self.synced = False
        self._axis = axis
        self._sink = sink
        self._kept = kept
        self._on_restored = on_restored
        self._on_gap = on_gap
        #: The last sample that has arrived, and the last one of the received state while none after it has; else -1.
        self._last_seq = self._state_seq = -1
        self._recent: deque[SampleBatch] = deque()
        self._count = 0
        #: Whether samples were dropped from memory before they were learnt.
        self._overflowed = False

    def gate(self, batch: SampleBatch) -> SampleBatch | None:
        """For ``AxisLoop.set_gate``: keep the samples in memory; pass them on once the state has come, else None."""
        self._recent.append(batch)
        self._count += len(batch)
        while self._count > self._kept and len(self._recent) > 1:
            self._count -= len(self._recent.popleft())
            self._overflowed |= not self.synced
        last_seq, self._last_seq = self._last_seq, int(batch.seq[-1])
        if self.synced:
            return self._behind_state(batch, last_seq)
        if self._sink is not None:
            self._sink.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, NOT_SYNCED)
        return None

    def take_state(self, data: bytes) -> None:
        """Continue from the state of the serving instance.

        Raises ModelFileError if the state does not match this axis, which is then unchanged.
        """
        meta, state = decode_checkpoint(data)
        axis = self._axis
        meta.refuse_unless(meta.stage, axis.config.name, axis.dt_s, axis.identified)
        axis.restore(state)
        self.synced = True
        self._overflowed = False
        self._state_seq = meta.seq
        for batch in newer_than(list(self._recent), meta.seq):  # all of them are in the recording already
            self._note_gap(batch)
            axis.handle(batch)
        self._rebase()

    def take_over(self) -> str:
        """Serve from now on: without a received state, continue from its own state and learn the samples since.

        Returns from what this instance continues, in words; "" if it held the state of the serving instance.
        """
        if self.synced:
            return ""
        self.synced = True
        axis = self._axis
        source = f"its own state of sample {axis.handled_seq}" if axis.handled_seq >= 0 else "the model file"
        unlearnt = list(self._recent)
        if self._overflowed:
            learn_again(axis, axis.config.recorder)
            unlearnt = newer_than(unlearnt, axis.handled_seq)
        for batch in unlearnt:
            axis.handle(batch)
        self._overflowed = False
        self._rebase()
        return f"{source}, then {sum(map(len, unlearnt))} samples from memory"

    def stand_down(self) -> None:
        """Wait for a state again: another instance serves."""
        self.synced = self._overflowed = False
        self._recent.clear()
        self._count = 0

    def _behind_state(self, batch: SampleBatch, last_seq: int) -> SampleBatch | None:
        """The samples of ``batch`` that the received state does not include: it may overtake its last samples.

        Those go on from ``last_seq``, the last sample that arrived before; others are of a stage that began anew.
        """
        if self._state_seq < 0:
            return batch
        included = (batch.seq > last_seq) & (batch.seq <= self._state_seq)
        before = batch.where(included)
        if self._sink is not None and len(before):
            self._sink.put_aside(before.seq, before.t_s, before.u_V, before.y_um, NOT_SYNCED)
        batch = batch.where(~included)
        if not len(batch):
            return None
        self._note_gap(batch)
        return batch

    def _note_gap(self, batch: SampleBatch) -> None:
        """A sample in transit while the state was copied may be neither in the state nor among those after it."""
        first, state_seq, self._state_seq = int(batch.seq[0]), self._state_seq, -1
        if 0 <= state_seq < first - 1:
            self._on_gap()

    def _rebase(self) -> None:
        if self._sink is not None:
            self._sink.rebase(self._axis.sequence.received)
        self._on_restored()


def newer_than(batches: list[SampleBatch], seq: int) -> list[SampleBatch]:
    """The samples that arrived after sample ``seq``; if that one is not among them, all with higher numbers.

    The order of arrival decides, not the number: a stage that restarts its count sends lower numbers than before.
    """
    for i in range(len(batches) - 1, -1, -1):
        at = np.flatnonzero(batches[i].seq == seq)
        if at.size:
            parts = [batches[i].where(np.arange(len(batches[i])) > at[-1]), *batches[i + 1 :]]
            break
    else:
        parts = [batch.where(batch.seq > seq) for batch in batches]
    return [part for part in parts if len(part)]
