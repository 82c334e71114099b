"""Reports for people: the plot style of all pictures, and the files of a diagnosis.

`figure`, `line`, `legend`, `envelope` and `save` make pictures. `write_report` writes the report of a diagnosis with
its pictures and its file for the viewer. The names are loaded on first use, because matplotlib loads slowly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.reports.diagnosis import write_report
    from service.reports.diagnosis_page import Source
    from service.reports.plot_style import envelope, figure, legend, line, save

_MODULES = {
    "Source": "diagnosis_page",
    "envelope": "plot_style",
    "figure": "plot_style",
    "legend": "plot_style",
    "line": "plot_style",
    "save": "plot_style",
    "write_report": "diagnosis",
}
__all__ = [
    "Source",
    "envelope",
    "figure",
    "legend",
    "line",
    "save",
    "write_report",
]

__getattr__ = lazy_names(__name__, _MODULES)
