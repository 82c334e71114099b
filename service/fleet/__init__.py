"""A fleet on the wire: one stage with many axes, learnt and answered as one batch. See docs/fleet.md.

`serving` and `checkpoints` are imported only where the configuration has ``[fleet]``.
"""
