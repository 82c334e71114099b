"""The model of a standby: the state of the serving instance, and the samples since then.

The learner is deterministic: the same state and the same samples give the same model, bit by bit. Until the standby has
received the state, it records the samples and keeps them in memory. Then it learns those that the state does not
include.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from dehyst.service.operating.server import Journal
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.storage.checkpoint import (
    CheckpointFolder,
    CheckpointMeta,
    decode_checkpoint,
    learn_again,
    restore_newest,
)
from dehyst.service.storage.segments import rows_behind

if TYPE_CHECKING:
    from dehyst.service.storage.recorder import Recorder

# --- Checkpoints and recordings of the other instance on the same host, from which a standby can take over.
#
# A standby that must take over before it has received the state of the serving instance continues from the newest
# readable checkpoint of the two, and learns the samples in the journal behind it.

_STANDBY_SUFFIX: Final = "-standby"
_WHOSE: Final = " of the other instance"


@dataclass(frozen=True, slots=True)
class PeerFiles:
    """Folders of one axis of the other instance; None if it does not write them."""

    checkpoints: Path | None = None
    recordings: Path | None = None


def standby_folder(folder: Path | None) -> Path | None:
    """The folder of the standby that corresponds to ``folder`` of the other instance."""
    return None if folder is None else folder.with_name(folder.name + _STANDBY_SUFFIX)


def restore_from_peer(axis: Axis, files: PeerFiles, stage: str, newest_seq: int) -> str:
    """Restore ``axis`` from ``files`` if they reach further than its own state.

    ``newest_seq`` : number of the newest sample that has arrived, -1 for none. Returns what was restored, in words; ""
    for nothing.
    """
    if files.checkpoints is None:
        return ""
    config = axis.config
    folder = CheckpointFolder(
        files.checkpoints, stage, config.name, axis.dt_s, axis.identified, config.checkpoints_kept
    )

    def reaches_further(meta: CheckpointMeta) -> bool:
        rows = None if files.recordings is None else rows_behind(files.recordings, meta.samples, axis.owner)
        last_seq, count = (meta.seq, 0) if rows is None else (int(rows.seq[-1]), len(rows))
        return _further((last_seq, meta.samples + count), axis, newest_seq)

    switch = Journal(files.recordings or files.checkpoints).last_switch()
    number = restore_newest(axis, folder, files.recordings, switch, _WHOSE, reaches_further)
    return "" if number is None else f"checkpoint {number}{_WHOSE} and its journal, sample {axis.handled_seq}"


def _further(theirs: tuple[int, int], axis: Axis, newest_seq: int) -> bool:
    """Whether a state up to (sample number, count of samples) is newer than that of ``axis``.

    Sample numbers decide, unless the stage has restarted its count since; then the counts of samples decide.
    """
    own = axis.handled_seq, axis.sequence.received
    comparable = newest_seq < 0 or max(theirs[0], own[0]) <= newest_seq
    return theirs > own if comparable else theirs[1] > own[1]


# --- Model of a standby.

#: Samples kept in memory, to be learnt after an older state.
KEPT_SAMPLES: Final = 30_000
#: Verdict in a recording of samples that arrived before the standby had a state.
NOT_SYNCED: Final = "not_synced"


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
    state_samples : count of all samples that the last received state includes.
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
        self.state_samples = 0
        self._axis = axis
        self._sink = sink
        self._kept = kept
        self._on_restored = on_restored
        self._on_gap = on_gap
        #: Last sample of the received state while no sample after it has been learnt; else -1.
        self._state_seq = -1
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
        if self.synced:
            self._check_gap([batch])
            return batch
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
        self._state_seq, self.state_samples = meta.seq, meta.samples
        newer = newer_than(list(self._recent), meta.seq)
        self._check_gap(newer)
        for batch in newer:  # all of them are in the recording already
            axis.handle(batch)
        self._rebase()

    def take_over(self, restore: Callable[[int], str] = lambda _: "") -> str:
        """Serve from now on: without a received state, continue from the best state there is and learn the samples.

        ``restore`` gets the number of the newest sample; it may restore the axis and returns from what, in words, or
        "". Returns from what this instance continues, in words; "" if it held the state of the serving instance.
        """
        if self.synced:
            return ""
        self.synced = True
        axis = self._axis
        restored = restore(int(self._recent[-1].seq[-1]) if self._recent else -1)
        source = restored or f"its own state of sample {axis.handled_seq}"
        if self._overflowed and not restored:
            learn_again(axis, axis.config.recorder)
        unlearnt = list(self._recent)
        if restored or self._overflowed:
            unlearnt = newer_than(unlearnt, axis.handled_seq)
        for batch in unlearnt:
            axis.handle(batch)
        self._overflowed = False
        self._rebase()
        return f"{source}, then {sum(map(len, unlearnt))} samples from memory"

    def stand_down(self) -> None:
        """Wait for a state again: another instance serves."""
        self.synced = self._overflowed = False
        self.state_samples = 0
        self._recent.clear()
        self._count = 0

    def _check_gap(self, batches: list[SampleBatch]) -> None:
        """A sample in transit while the state was copied may be neither in the state nor among the samples after it."""
        if self._state_seq < 0 or not batches:
            return
        first, state_seq = int(batches[0].seq[0]), self._state_seq
        self._state_seq = -1
        if first > state_seq + 1:
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
