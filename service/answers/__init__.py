"""Answers to queries: voltages from the model or its stand-in, within the limits of the axis.

`answer` answers a query from `Served` snapshots; `answer_safely` computes the voltages from a model and the memory of
the caller, under `Rules`, and never raises. `Limits` bounds positions and voltages. Nothing here uses the wire or a
clock: the service and a follower in the client's process call the same functions.
"""
