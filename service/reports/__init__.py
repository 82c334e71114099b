"""Reports for people: the plot style of all pictures, and the files of a diagnosis.

`plot_style` makes, thins and saves figures; `diagnosis.write_report` writes the report of a diagnosis with its pictures
and its file for the viewer. Import from these modules: the package itself loads nothing.
"""

__all__: list[str] = []
