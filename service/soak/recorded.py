"""Which samples are in the recordings of a soak: nothing that reached the services may be missing in all of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyarrow import parquet

from service.recorder_files import close_left_open, segments
from service.soak.intervals import Intervals


def recorded(folders: list[Path]) -> tuple[Intervals, int]:
    """The numbers in the Parquet segments below ``folders``, and how many rows there are."""
    found, rows = Intervals(), 0
    for folder in folders:
        if not folder.is_dir():
            continue
        # What a killed process left open is whole but for its end.
        close_left_open(folder)
        for path in segments(folder):
            column = parquet.read_table(path, columns=["seq"]).column("seq").to_numpy()
            rows += column.size
            found.add_all(np.unique(column.astype(np.int64)))
    return found, rows
