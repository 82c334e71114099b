"""``dehyst reproduce``: the chapter's tables, computed again and compared with the published numbers.

`measured.run_study` computes everything, and `report.write_study` writes the report, ``tables.json`` and some figures.
"""
