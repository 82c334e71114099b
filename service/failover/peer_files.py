"""Checkpoints and recordings of the other instance on the same host, from which a standby can take over.

A standby that must take over before it has received the state of the serving instance continues from the newest
readable checkpoint of the two, and learns the samples in the journal behind it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from adaptive.errors import ModelFileError
from service.server.axis import Axis
from service.storage.checkpoint import CheckpointFolder
from service.storage.checkpoint_keeper import learn_again
from service.storage.segments import rows_behind

_STANDBY_SUFFIX: Final = "-standby"
#: Most checkpoints that are tried: a takeover must not take long.
_MAX_TRIED: Final = 4


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

    Call it in the thread that handles samples. ``newest_seq`` is the number of the newest sample that has arrived, -1
    for none. Returns what was restored, in words; "" for nothing.
    """
    if files.checkpoints is None:
        return ""
    folder = CheckpointFolder(files.checkpoints, stage, axis.config.name, axis.dt_s, axis.config.checkpoints_kept)
    for number in folder.numbers()[:_MAX_TRIED]:
        try:
            meta, state = folder.read(number)
            rows = None if files.recordings is None else rows_behind(files.recordings, meta.samples)
            last_seq = meta.seq if rows is None else int(rows.seq[-1])
            if not _further((last_seq, meta.samples + (0 if rows is None else len(rows))), axis, newest_seq):
                return ""
            axis.restore(state)
        except (ModelFileError, OSError) as error:
            axis.note("checkpoint_refused", f"checkpoint {number} of the other instance: {error}")
            continue
        count = learn_again(axis, files.recordings) if files.recordings is not None else 0
        return f"checkpoint {number} of the other instance, sample {meta.seq}, and {count} samples of its journal"
    return ""


def _further(theirs: tuple[int, int], axis: Axis, newest_seq: int) -> bool:
    """Whether a state up to (sample number, count of samples) is newer than that of ``axis``.

    Sample numbers decide, unless the stage has restarted its count since; then the counts of samples decide.
    """
    own = axis.handled_seq, axis.sequence.received
    comparable = newest_seq < 0 or max(theirs[0], own[0]) <= newest_seq
    return theirs > own if comparable else theirs[1] > own[1]
