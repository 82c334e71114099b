"""A fleet on the wire: one stage with many axes, learnt and answered as one batch. See docs/fleet.md.

`settings` and `wire` need no torch; `serving` does, and is imported only where the configuration has ``[fleet]``.
"""
