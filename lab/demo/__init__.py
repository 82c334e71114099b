"""The demonstration: one reference, five models on twin stages, a change half way, and a table at the end.

`lab.demo.session.run` runs it; `lab.demo.plan.Plan` says what it does and when.
"""
