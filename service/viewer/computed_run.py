"""Draws a run that was computed: the same scene as live, from arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.service.viewer.output import make_file
from dehyst.service.viewer.records import Event, Record, SceneConfig, Tracking
from dehyst.service.viewer.rerun_sink import RerunSink
from dehyst.service.viewer.scene import Scene

#: Length of the pieces that a record is cut into, s: like the batches of a live stream.
PIECE_S = 0.2


def write_recording(path: Path, config: SceneConfig, records: Iterable[Record]) -> None:
    """Write an ``.rrd`` of a whole run, overwriting ``path``.

    ``records`` may come in any order; a `Tracking` may hold a whole run. They are cut into pieces and drawn in order
    of time, as in a live stream. Raises InputError if the file cannot be written.
    """
    make_file(path)
    sink = RerunSink(config, rrd=path)
    try:
        Scene(sink, config).take_all(in_order(records))
    finally:
        sink.close()


def in_order(records: Iterable[Record]) -> list[Record]:
    """All records in order of time, long ones cut into pieces; events come before the samples of the same time."""
    pieces: list[tuple[float, int, Record]] = []
    for record in records:
        if isinstance(record, Tracking):
            pieces += [(float(p.t_s[-1]), 1, p) for p in cut(record)]
        else:
            pieces.append((record.t_s, 0 if isinstance(record, Event) else 2, record))
    return [record for _, _, record in sorted(pieces, key=lambda piece: piece[:2])]


def cut(record: Tracking, piece_s: float = PIECE_S) -> Iterator[Tracking]:
    """A long `Tracking` in pieces of at most ``piece_s``."""
    names = ("seq", "t_s", "u_V", "y_um", "reference_um", "std_V")
    columns: dict[str, Any] = {name: getattr(record, name) for name in names if getattr(record, name) is not None}
    edges = np.flatnonzero(np.diff(record.t_s // piece_s)) + 1
    for part in np.split(np.arange(len(record.seq)), edges):
        if part.size:
            yield replace(record, **{name: column[part] for name, column in columns.items()})
