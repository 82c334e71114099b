"""The soak: all processes of a service under faults from a seeded schedule, judged by invariants.

`session.run` runs a plan that `fault_plan.make_plan` draws, in real time. The processes of a soak import this package
and must start fast.
"""
