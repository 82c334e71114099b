"""A canvas that draws by Rerun, into a viewer or a whole run into an ``.rrd`` file, and the views of its curves."""

from __future__ import annotations

import os
import subprocess
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.viewer import style
from dehyst.service.viewer.plane import BOUNDS
from dehyst.service.viewer.records import Event, IntArray, Record, SceneConfig, Tracking
from dehyst.service.viewer.scene import Scene

# Drawing may block: a stream to a viewer that has gone blocks the caller once its buffers are full. Use it behind
# `service.viewer.output` where nothing may wait.

APPLICATION = "dehyst"
TIMELINE, SEQUENCE = "t_s", "seq"
DEFAULT_PORT = 9876
#: Memory of a viewer that is started here: its store, and the message buffer of its server.
VIEWER_MEMORY, SERVER_MEMORY = "1GiB", "64MiB"


class RerunSink:
    """Draws into the file ``rrd``, or without one into the viewer at ``connect``.

    Close it, or the end of the run may be missing. Raises InputError if the file cannot be written.
    """

    def __init__(
        self,
        config: SceneConfig,
        *,
        rrd: Path | None = None,
        connect: str | None = None,
        recording_id: str | None = None,
    ) -> None:
        views = blueprint(config)
        # The live stream and the file of one run have the same id, so that the viewer shows them as one.
        self._stream = rr.RecordingStream(APPLICATION, recording_id=recording_id or str(uuid.uuid4()))
        if rrd is not None:
            try:
                rrd.parent.mkdir(parents=True, exist_ok=True)
                rrd.open("ab").close()
                self._stream.save(rrd, default_blueprint=views)
            except (OSError, RuntimeError) as error:
                raise InputError(
                    f"rrd: cannot write {rrd}: {error}; name a file in a folder you may write to"
                ) from error
        else:
            self._stream.connect_grpc(connect, default_blueprint=views)
        self._stream.send_recording_name(config.title)
        for path, line in style.lines(config).items():
            self._stream.log(
                path,
                rr.SeriesLines(names=line.name, colors=[line.colour], widths=[line.width]),
                static=True,
            )

    def scalars(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None:
        indexes = [rr.TimeColumn(TIMELINE, duration=t_s), rr.TimeColumn(SEQUENCE, sequence=seq)]
        self._stream.send_columns(path, indexes, rr.Scalars.columns(scalars=values))

    def strips(
        self, path: str, t_s: float, seq: int, strips: Sequence[FloatArray], colour: style.Colour, radius: float
    ) -> None:
        self._at(t_s, seq)
        drawn = [s for s in strips if len(s) > 1]
        self._stream.log(path, rr.LineStrips2D(drawn, colors=[colour] * len(drawn), radii=[radius] * len(drawn)))

    def points(
        self,
        path: str,
        t_s: float,
        seq: int,
        positions: FloatArray,
        colour: style.Colour,
        radius: float,
        labels: Sequence[str] | None = None,
    ) -> None:
        self._at(t_s, seq)
        shown = None if labels is None else True
        self._stream.log(
            path, rr.Points2D(positions, colors=[colour], radii=[radius], labels=labels, show_labels=shown)
        )

    def text(self, path: str, t_s: float, seq: int, text: str, level: str) -> None:
        self._at(t_s, seq)
        self._stream.log(path, rr.TextLog(text, level=level))

    def document(self, path: str, t_s: float, seq: int, markdown: str) -> None:
        self._at(t_s, seq)
        self._stream.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def close(self) -> None:
        """Flush and close the file or connection; a file is complete afterwards. Raises ServiceError if it is not."""
        try:
            self._stream.flush()
        except RuntimeError as error:
            raise ServiceError(f"not everything was drawn: {error}") from error
        finally:
            self._stream.disconnect()

    def _at(self, t_s: float, seq: int) -> None:
        self._stream.set_time(TIMELINE, duration=t_s)
        self._stream.set_time(SEQUENCE, sequence=seq)


def over_time(
    name: str, paths: Iterable[str], times: rrb.VisibleTimeRange, corner: rrb.Corner2D = rrb.Corner2D.LeftTop
) -> rrb.TimeSeriesView:
    """A view of curves over time; its name states their unit."""
    contents = [f"+ /{path}" for path in paths]
    legend = rrb.PlotLegend(corner)
    return rrb.TimeSeriesView(name=name, origin="/", contents=contents, plot_legend=legend, time_ranges=times)


def plane_view(name: str, origin: str) -> rrb.Spatial2DView:
    """A view of a plane with axes (`service.viewer.plane`)."""
    x_range, y_range = map(list, BOUNDS)
    bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=[16, 16, 18], visual_bounds=bounds)


def desk(views: rrb.Container, panel: rrb.TimePanel) -> rrb.Blueprint:
    """A blueprint of these views alone, with the time panel."""
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        panel,
        auto_views=False,
    )


def blueprint(config: SceneConfig) -> rrb.Blueprint:
    """The views: tracking on the left, hysteresis in the middle, health of service and stream on the right."""
    start = (
        rrb.TimeRangeBoundary.infinite()
        if config.history_s is None
        else rrb.TimeRangeBoundary.cursor_relative(seconds=-config.history_s)
    )
    times = rrb.VisibleTimeRange(TIMELINE, start=start, end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0))
    # The curve that is drawn last lies on top.
    main, models = config.models[0], config.models[::-1]

    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        return over_time(name, paths, times)

    def tabs(*views: rrb.View) -> rrb.Tabs:
        return rrb.Tabs(*views, active_tab=0)

    tracking = rrb.Vertical(
        plot("Displacement: wanted and reached, µm", style.REFERENCE, style.displacement(main)),
        tabs(
            plot("Tracking error, µm", *map(style.error, models)),
            plot(f"{style.name(main)} alone", style.error(main)),
        ),
        tabs(
            plot(
                f"Mean |error| over {config.mae_s:g} s, log10 of % of range (0 is 1 %, -1 is 0.1 %)",
                *map(style.mean_error_log, models),
            ),
            plot("Linear, % of range", *map(style.mean_error, models)),
        ),
        tabs(
            plot("Voltage and ±2σ, V", style.voltage(main), style.BAND_HIGH, style.BAND_LOW),
            plot("σ of the voltage, mV", style.SIGMA),
            plot("Voltages of all models, V", *map(style.voltage, models)),
        ),
        row_shares=(1.0, 1.2, 1.2, 0.9),
    )
    last = f"last {config.loop_s:g} s"
    shapes = rrb.Vertical(
        plane_view(f"What is left: error over wanted, {last}", style.DEVIATION_PLANE),
        plane_view(f"Loop (u, y), {last}; amber: before the last change of the stage", style.LOOP_PLANE),
        plane_view("What the learner holds: its window", style.WINDOW_PLANE),
    )
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["LogLevel", "Body"]
    )
    health = rrb.Vertical(
        rrb.TextLogView(name="Events", origin=f"/{style.EVENTS}", columns=columns),
        tabs(
            plot("Gates: samples per second", "rate/**"),
            plot("Gates: counts", "counter/**"),
            plot("This stream: counts", "stream/**"),
        ),
        tabs(
            plot("Drift filter: gain", "drift/gain"),
            plot("Drift filter: offset, V", "drift/offset_V"),
            plot("Learner", "learner/**"),
        ),
        plot("Query latency, µs", "latency/**"),
        rrb.TextDocumentView(name="Status", origin=f"/{style.STATUS}"),
        row_shares=(1.0, 1.0, 0.8, 0.8, 1.0),
    )
    views = rrb.Horizontal(tracking, shapes, health, column_shares=(1.5, 1.0, 0.95))
    return desk(views, rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"))


def viewer_command(port: int, *, headless: bool = False, web_port: int | None = None) -> list[str]:
    """The command that starts a viewer on the loopback interface (Rerun's default is all interfaces).

    ``web_port`` : serve the viewer as a page for a browser at this port, in place of a window.
    """
    # The program itself: its Python wrapper would leave a child process behind.
    binary = Path(rr.__file__).parents[1] / "rerun_cli" / ("rerun.exe" if os.name == "nt" else "rerun")
    command = [
        str(binary), "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen",
        "--memory-limit", VIEWER_MEMORY, "--server-memory-limit", SERVER_MEMORY,
    ]  # fmt: skip
    if web_port is not None:
        return [*command, "--serve-web", "--web-viewer-port", str(web_port)]
    return [*command, "--headless"] if headless else command


def spawn_viewer(
    port: int = DEFAULT_PORT, *, headless: bool = False, web_port: int | None = None
) -> tuple[subprocess.Popen[bytes], str]:
    """Start a viewer; returns its process and the URL to stream to. It keeps running until it is ended."""
    command = viewer_command(port, headless=headless, web_port=web_port)
    return subprocess.Popen(command, start_new_session=True), f"rerun+http://127.0.0.1:{port}/proxy"


def page_of(url: str, web_port: int) -> str:
    """Address of the page that shows what is streamed to ``url``, for a browser on this machine."""
    return f"http://127.0.0.1:{web_port}/?url={quote(url, safe='')}"


# --- Draws a run that was computed: the same scene as live, from arrays.

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
    names = ("seq", "t_s", "u_V", "y_um", "reference_um", "std_V")
    columns: dict[str, Any] = {name: getattr(record, name) for name in names if getattr(record, name) is not None}
    edges = np.flatnonzero(np.diff(record.t_s // piece_s)) + 1
    for part in np.split(np.arange(len(record.seq)), edges):
        if part.size:
            yield replace(record, **{name: column[part] for name, column in columns.items()})
