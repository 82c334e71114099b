"""Operator's commands: requests over zenoh, their journal, and the table of statuses (docs/operating.md).

`operate` sends a command and `statuses` collects the statuses of all instances; `screen` shows them. `OperationsServer`
takes the commands of one axis, runs its verbs and writes them to a `Journal`.
"""
