"""What an instance leaves behind: its checkpoints and recordings, where another one on the same host can read them.

A standby that has to take over before it was given the state of the one that served looks there for the best that is
left: the newest checkpoint of either, and the samples in the journal behind it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from adaptive.errors import ModelFileError
from service.server.axis import Axis
from service.server.axis_state import restore_axis
from service.storage.checkpoint import CheckpointFolder
from service.storage.checkpoint_keeper import learn_again
from service.storage.segments import rows_behind

#: Put behind the name of a folder that belongs to the instance started to stand by.
SUFFIX: Final = "-standby"
#: So many checkpoints are tried until one is whole and matches: somebody waits.
_TRIED: Final = 4


@dataclass(frozen=True, slots=True)
class Estate:
    """Folders of one axis of one instance; None where it keeps no such thing."""

    checkpoints: Path | None = None
    recordings: Path | None = None


def of_standby(folder: Path | None) -> Path | None:
    """Where the standby of an instance keeps what that instance keeps in ``folder``."""
    return None if folder is None else folder.with_name(folder.name + SUFFIX)


def inherit(axis: Axis, estate: Estate, stage: str, newest_seq: int) -> str:
    """Let ``axis`` go on from ``estate`` where that reaches further than its own state; what was taken, "" for nothing.

    ``newest_seq``: newest sample that has come, -1 for none. For the thread that handles samples.
    """
    if estate.checkpoints is None:
        return ""
    folder = CheckpointFolder(estate.checkpoints, stage, axis.config.name, axis.dt_s, axis.config.checkpoints_kept)
    for number in folder.numbers()[:_TRIED]:
        try:
            meta, state = folder.read(number)
            rows = None if estate.recordings is None else rows_behind(estate.recordings, meta.samples)
            reach = meta.seq if rows is None else int(rows.seq[-1])
            if not _further((reach, meta.samples + (0 if rows is None else len(rows))), axis, newest_seq):
                return ""
            restore_axis(axis, state)
        except (ModelFileError, OSError) as error:
            axis.note("checkpoint_refused", f"checkpoint {number} of the one before: {error}")
            continue
        again = learn_again(axis, estate.recordings) if estate.recordings is not None else 0
        return f"checkpoint {number} of the one before, sample {meta.seq}, and {again} samples of its journal"
    return ""


def _further(reach: tuple[int, int], axis: Axis, newest_seq: int) -> bool:
    """Whether a state that reaches to (number, count of samples) is nearer to the newest sample than that of ``axis``.

    Numbers tell it, unless the stage has begun to count anew since; then the counts do.
    """
    own = axis.handled_seq, axis.sequence.received
    comparable = newest_seq < 0 or max(reach[0], own[0]) <= newest_seq
    return reach > own if comparable else reach[1] > own[1]
