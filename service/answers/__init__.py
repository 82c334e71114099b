"""Answers to queries: the model or its stand-in, from the memory of the caller, within the limits of the axis.

Nothing here knows a wire or a clock. The service and a follower in the client's process use the same functions.
"""
