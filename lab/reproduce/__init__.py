"""``dehyst reproduce``: the chapter's tables and figures, computed again and compared with the published numbers.

`study.run_study` computes everything, `tables.tables` turns it into ``tables.json``, and `report.write_study` writes
the report, the tables and the figures.
"""
