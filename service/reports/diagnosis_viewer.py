"""A diagnosis for the Rerun viewer: an ``.rrd`` file with residuals over time, loops, and the curves of each cause."""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.reports.diagnosis_page import spaced
from dehyst.service.reports.plot_style import envelope
from dehyst.service.viewer.colours import AFTER, BEFORE, rgb
from dehyst.service.viewer.plane import HEIGHT, WIDTH, Plane, grown
from dehyst.service.viewer.rerun_sink import desk, over_time, plane_view
from dehyst.service.viewer.style import FRAME, LABEL, WHITE, Colour
from dehyst.sim.diagnosis.result import Diagnosis, picture
from dehyst.sim.pictures import MEASURED, WITH, WITHOUT, Curve, Picture

APPLICATION, TIMELINE = "dehyst-diagnosis", "t_s"
COLOURS: dict[str, Colour] = {MEASURED: WHITE, WITHOUT: rgb(BEFORE), WITH: rgb(AFTER)}
#: Points of a curve over time beyond which it is thinned to the extremes of equal stretches.
MOST_POINTS = 40_000
#: Points of the loop.
LOOP_POINTS = 6000


@dataclass(frozen=True)
class _Trace:
    """One curve over time: entity path, name, colour, values (n,)."""

    path: str
    name: str
    colour: Colour
    values: FloatArray


def write_viewer(path: Path, diagnosis: Diagnosis, title: str, page: str) -> None:
    """Write ``path``; an existing file is replaced. ``page`` is the text of report.md. Raises InputError."""
    d = diagnosis
    data = d.nominal.model.data
    scale, unit = (1e3, "nm") if float(np.quantile(np.abs(d.nominal.residual_um), 0.99)) < 1.0 else (1.0, "µm")
    traces = [
        _Trace("voltage_V", "voltage", WHITE, data.u_V),
        _Trace("reading/measured_um", "measured", WHITE, data.y_um),
        _Trace("reading/nominal_um", "nominal stage", COLOURS[WITHOUT], data.y_um - d.nominal.residual_um),
        _Trace("reading/extended_um", "extended stage", COLOURS[WITH], data.y_um - d.extended.residual_um),
        _Trace("residual/nominal", "nominal stage", COLOURS[WITHOUT], scale * d.nominal.residual_um),
        _Trace("residual/extended", "extended stage", COLOURS[WITH], scale * d.extended.residual_um),
    ]
    pictures = {f"cause/{i + 1}_{c.name}": picture(c, data, d.catalogue) for i, c in enumerate(d.causes)}
    tabs = [
        plane_view(f"{i + 1}. {spaced(c.name)}", p) for i, (c, p) in enumerate(zip(d.causes, pictures, strict=True))
    ]
    stream = rr.RecordingStream(APPLICATION, recording_id=str(uuid.uuid4()))
    path.unlink(missing_ok=True)
    try:
        stream.save(path, default_blueprint=_desk(tabs, unit))
    except (OSError, RuntimeError) as error:
        raise InputError(f"--out: cannot write {path}: {error}; name a folder you may write to") from error
    try:
        stream.send_recording_name(title)
        for trace in traces:
            t, y = envelope(data.t_s, trace.values, MOST_POINTS)
            lines = rr.SeriesLines(names=trace.name, colors=[trace.colour], widths=[1.0])
            stream.log(trace.path, lines, static=True)
            stream.send_columns(trace.path, [rr.TimeColumn(TIMELINE, duration=t)], rr.Scalars.columns(scalars=y))
        _draw(stream, "loop", _loop(d))
        for where, shown in pictures.items():
            _draw(stream, where, shown)
        # The viewer does not show the pictures: remove their lines.
        text = re.sub(r"!\[.*\]\(.*\)\n", "", page)
        stream.log("report", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    finally:
        stream.flush()
        stream.disconnect()


def _loop(d: Diagnosis) -> Picture:
    """Reading over voltage, measured and of both stages, around the largest excursion."""
    data = d.nominal.model.data
    middle = int(np.argmax(np.abs(data.y_um - data.middle_um)))
    start = int(np.clip(middle - LOOP_POINTS // 2, 0, max(0, data.n - LOOP_POINTS)))
    part = slice(start, start + LOOP_POINTS)
    u, y = data.u_V[part], data.y_um[part]
    return Picture(
        "voltage / V",
        "reading / µm",
        (
            Curve(MEASURED, u, y),
            Curve(WITHOUT, u, y - d.nominal.residual_um[part], name="nominal stage"),
            Curve(WITH, u, y - d.extended.residual_um[part], name="extended stage"),
        ),
    )


def _draw(stream: rr.RecordingStream, origin: str, shown: Picture) -> None:
    """Draw curves in a plane with axes (`service.viewer.plane`). A logarithmic axis shows log10."""
    x_name = f"log10 of {shown.x_name}" if shown.log_x else shown.x_name
    y_name = f"log10 of {shown.y_name}" if shown.log_y else shown.y_name
    curves = [(c, _scaled(c.x, shown.log_x), _scaled(c.y, shown.log_y)) for c in shown.curves]
    x_limits, y_limits = _limits(x for _, x, _ in curves), _limits(y for _, _, y in curves)
    plane = Plane(x_name, y_name, x_limits, y_limits)
    stream.log(
        f"{origin}/frame",
        rr.LineStrips2D(plane.frame(), colors=[FRAME] * len(plane.frame()), radii=[0.15]),
        static=True,
    )
    where, what = plane.labels()
    labels = rr.Points2D(where, colors=[LABEL], radii=[0.01], labels=what, show_labels=True)
    stream.log(f"{origin}/labels", labels, static=True)
    names: dict[str, Colour] = {}
    for i, (curve, x, y) in enumerate(curves):
        places = plane.points(x, y)
        names.setdefault(curve.name or curve.role, COLOURS[curve.role])
        if len(places) > 1:
            radius = 0.2 if curve.dashed else 0.35
            strip = rr.LineStrips2D([places], colors=[COLOURS[curve.role]], radii=[radius])
            stream.log(f"{origin}/curve_{i}", strip, static=True)
    for i, (text, colour) in enumerate(list(names.items())[:4]):
        place = np.array([[WIDTH - 28.0, -HEIGHT + 6.0 + 10.0 * i]])
        legend = rr.Points2D(place, colors=[colour], radii=[1.2], labels=[text], show_labels=True)
        stream.log(f"{origin}/legend_{i}", legend, static=True)


def _scaled(values: FloatArray, log: bool) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log10(values) if log else values


def _limits(arrays: Iterable[FloatArray]) -> tuple[float, float]:
    limits: tuple[float, float] | None = None
    for values in arrays:
        limits = grown(limits, values)
    return limits or (0.0, 1.0)


def _desk(causes: list[rrb.Spatial2DView], unit: str) -> rrb.Blueprint:
    """Layout: curves over time on the left, causes and loop in the middle, the report on the right."""
    whole = rrb.VisibleTimeRange(TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())

    def curves(name: str, *paths: str) -> rrb.TimeSeriesView:
        return over_time(name, paths, whole, rrb.Corner2D.RightTop)

    left = rrb.Vertical(
        curves("Voltage, V", "voltage_V"),
        curves("Reading, µm", "reading/measured_um", "reading/nominal_um", "reading/extended_um"),
        curves(f"Residual of the nominal stage, {unit}", "residual/nominal"),
        curves(f"Residual of the extended stage, {unit}", "residual/extended"),
    )
    loop = plane_view("Loop: reading over voltage", "loop")
    middle = rrb.Vertical(rrb.Tabs(*causes, active_tab=0), loop) if causes else loop
    page = rrb.TextDocumentView(name="Report", origin="/report")
    views = rrb.Horizontal(left, middle, page, column_shares=(4.0, 4.0, 3.0))
    return desk(views, rrb.TimePanel(state="collapsed", timeline=TIMELINE))
