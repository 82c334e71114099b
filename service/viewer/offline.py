"""Draws a run that was computed: the same scene as live, from arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from service.viewer.records import Event, Record, SceneConfig, Tracking
from service.viewer.rerun_sink import RerunSink
from service.viewer.scene import Scene

#: Length of the pieces that a record is cut into, s: like the batches of a live stream.
PIECE_S = 0.5


def write_recording(path: Path, config: SceneConfig, records: Iterable[Record]) -> None:
    """Write an ``.rrd`` of a whole run, overwriting ``path``.

    ``records`` may come in any order; a `Tracking` may hold a whole run. They are cut into pieces and drawn in order
    of time, as in a live stream. Raises InputError if the file cannot be written.
    """
    path.unlink(missing_ok=True)
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
    start = 0
    edges: Sequence[int] = [
        int(k) + 1 for k in range(len(record.seq) - 1) if record.t_s[k] // piece_s != record.t_s[k + 1] // piece_s
    ]
    for stop in [*edges, len(record.seq)]:
        if stop > start:
            part = slice(start, stop)
            yield replace(
                record,
                seq=record.seq[part],
                t_s=record.t_s[part],
                u_V=record.u_V[part],
                y_um=record.y_um[part],
                reference_um=record.reference_um[part],
                std_V=None if record.std_V is None else record.std_V[part],
            )
        start = stop
