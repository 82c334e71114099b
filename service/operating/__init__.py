"""Operator's commands: requests over zenoh, their journal, and the table of statuses (docs/operating.md)."""
