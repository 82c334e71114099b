"""The chapter's experiments on a simulated stage: its tables and the data of its figures, as arrays without plots.

`experiments.experiments` records the `Experiments`; `characterise`, `identify_forward` and `run_control`
repeat the studies on them.
"""
