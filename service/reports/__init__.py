"""Reports for people: the plot style of all pictures, and the files of a diagnosis.

`figure`, `line`, `legend`, `envelope` and `save` make pictures. `write_report` writes the report of a diagnosis with
its pictures and its file for the viewer. The names are loaded on first use, because matplotlib loads slowly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.reports.diagnosis import write_report as write_report
    from dehyst.service.reports.diagnosis_page import Source as Source
    from dehyst.service.reports.plot_style import envelope as envelope
    from dehyst.service.reports.plot_style import figure as figure
    from dehyst.service.reports.plot_style import legend as legend
    from dehyst.service.reports.plot_style import line as line
    from dehyst.service.reports.plot_style import save as save

__getattr__ = lazy_names(__name__)
