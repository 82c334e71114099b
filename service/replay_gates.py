"""What was said of every row of a replayed recording, as a file: one line a row, in the recording's order."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Final

from service.replay import Replayed

COLUMNS: Final = ("seq", "t_s", "decision")


def write_gates(path: Path, replayed: Replayed) -> None:
    """Write ``gates.csv``. Times as they were recorded, to the last bit; ``nan`` where a row had none. Raises OSError.

    Rows and not samples of the grid: what was doubled, late or without a time was decided on too.
    """
    r = replayed
    with path.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(COLUMNS)
        decisions = (r.gates[index] for index in r.gate.tolist())
        lines.writerows(zip(r.row_seq.tolist(), r.row_t_s.tolist(), decisions, strict=True))
