"""A canvas that draws by Rerun, into a viewer or a whole run into an ``.rrd`` file, and the views of its curves."""

from __future__ import annotations

import os
import subprocess
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import rerun as rr
import rerun.blueprint as rrb

from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.viewer import style
from dehyst.service.viewer.plane import BOUNDS
from dehyst.service.viewer.records import IntArray, SceneConfig

# Drawing may block: a stream to a viewer that has gone blocks the caller once its buffers are full. Use it behind
# `service.viewer.output` where nothing may wait.

APPLICATION = "dehyst"
TIMELINE, SEQUENCE = "t_s", "seq"
DEFAULT_PORT = 9876
#: Memory of a viewer that is started here: its store, and the message buffer of its server.
VIEWER_MEMORY, SERVER_MEMORY = "1GiB", "64MiB"


class RerunSink:
    """Draws into the file ``rrd``, which is there already, or without one into the viewer at ``connect``.

    Close it, or the end of the run may be missing. Times are those of the stage, s; ``seq`` is the number of the newest
    sample.
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
            self._stream.save(rrd, default_blueprint=views)
        else:
            self._stream.connect_grpc(connect, default_blueprint=views)
        self._stream.send_recording_name(config.title)
        for path, line in style.lines(config).items():
            drawn = rr.SeriesLines(names=line.name, colors=[line.colour], widths=[line.width])
            self._stream.log(path, drawn, static=True)

    def scalars(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None:
        indexes = [rr.TimeColumn(TIMELINE, duration=t_s), rr.TimeColumn(SEQUENCE, sequence=seq)]
        self._stream.send_columns(path, indexes, rr.Scalars.columns(scalars=values))

    def strips(
        self, path: str, t_s: float, seq: int, strips: Sequence[FloatArray], colour: style.Colour, radius: float
    ) -> None:
        drawn = [s for s in strips if len(s) > 1]
        self._log(path, t_s, seq, rr.LineStrips2D(drawn, colors=[colour] * len(drawn), radii=[radius] * len(drawn)))

    def points(
        self, path: str, t_s: float, seq: int, positions: FloatArray, colour: style.Colour, radius: float,
        labels: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        shown = None if labels is None else True
        drawn = rr.Points2D(positions, colors=[colour], radii=[radius], labels=labels, show_labels=shown)
        self._log(path, t_s, seq, drawn)

    def text(self, path: str, t_s: float, seq: int, text: str, level: str) -> None:
        self._log(path, t_s, seq, rr.TextLog(text, level=level))

    def document(self, path: str, t_s: float, seq: int, markdown: str) -> None:
        self._log(path, t_s, seq, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def close(self) -> None:
        """Flush and close the file or connection; a file is complete afterwards. Raises ServiceError if it is not."""
        try:
            self._stream.flush()
        except RuntimeError as error:
            raise ServiceError(f"not everything was drawn: {error}") from error
        finally:
            self._stream.disconnect()

    def _log(self, path: str, t_s: float, seq: int, drawn: Any) -> None:
        self._stream.set_time(TIMELINE, duration=t_s)
        self._stream.set_time(SEQUENCE, sequence=seq)
        self._stream.log(path, drawn)


def blueprint(config: SceneConfig) -> rrb.Blueprint:
    """The views: tracking on the left, hysteresis in the middle, health of service and stream on the right."""
    past_s, now = config.history_s, rrb.TimeRangeBoundary.cursor_relative(seconds=0.0)
    infinite = rrb.TimeRangeBoundary.infinite()
    start = infinite if past_s is None else rrb.TimeRangeBoundary.cursor_relative(seconds=-past_s)
    times = rrb.VisibleTimeRange(TIMELINE, start=start, end=now)
    main, last = config.models[0], f"last {config.loop_s:g} s"

    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        """Curves over time; the name states their unit."""
        legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)
        contents = [f"+ /{path}" for path in paths]
        return rrb.TimeSeriesView(name=name, origin="/", contents=contents, plot_legend=legend, time_ranges=times)

    def all_models(path: str) -> list[str]:
        """The curve that is drawn last lies on top."""
        return [path.format(model) for model in config.models[::-1]]

    def plane(name: str, origin: str) -> rrb.Spatial2DView:
        x_range, y_range = map(list, BOUNDS)
        bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
        return rrb.Spatial2DView(name=name, origin=f"/{origin}", background=[16, 16, 18], visual_bounds=bounds)

    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["LogLevel", "Body"]
    )
    decades = f"Mean |error| over {config.mae_s:g} s, log10 of % of range (0 is 1 %, -1 is 0.1 %)"
    tabs: list[list[tuple[float, list[rrb.View]]]] = [
        [
            (1.0, [plot("Displacement: wanted and reached, µm", style.REFERENCE, style.DISPLACEMENT.format(main))]),
            (1.2, [plot("Tracking error, µm", *all_models(style.ERROR)),
                   plot(f"{style.name(main)} alone", style.ERROR.format(main))]),
            (1.2, [plot(decades, *all_models(style.MEAN_ERROR_LOG)),
                   plot("Linear, % of range", *all_models(style.MEAN_ERROR))]),
            (0.9, [plot("Voltage and ±2σ, V", style.VOLTAGE.format(main), style.BAND_HIGH, style.BAND_LOW),
                   plot("σ of the voltage, mV", style.SIGMA),
                   plot("Voltages of all models, V", *all_models(style.VOLTAGE))]),
        ],
        [
            (1.0, [plane(f"What is left: error over wanted, {last}", style.DEVIATION_PLANE)]),
            (1.0, [plane(f"Loop (u, y), {last}; amber: before the last change of the stage", style.LOOP_PLANE)]),
            (1.0, [plane("What the learner holds: its window", style.WINDOW_PLANE)]),
        ],
        [
            (1.0, [rrb.TextLogView(name="Events", origin=f"/{style.EVENTS}", columns=columns)]),
            (1.0, [plot("Gates: samples per second", "rate/**"), plot("Gates: counts", "counter/**"),
                   plot("This stream: counts", "stream/**")]),
            (0.8, [plot("Drift filter: gain", "drift/gain"), plot("Drift filter: offset, V", "drift/offset_V"),
                   plot("Learner", "learner/**")]),
            (0.8, [plot("Query latency, µs", "latency/**")]),
            (1.0, [rrb.TextDocumentView(name="Status", origin=f"/{style.STATUS}")]),
        ],
    ]  # fmt: skip
    stacks = [
        rrb.Vertical(
            *(rrb.Tabs(*views, active_tab=0) if len(views) > 1 else views[0] for _, views in column),
            row_shares=[share for share, _ in column],
        )
        for column in tabs
    ]
    return rrb.Blueprint(
        rrb.Horizontal(*stacks, column_shares=(1.5, 1.0, 0.95)),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
    )


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
