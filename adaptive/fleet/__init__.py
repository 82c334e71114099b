"""Many learners as one batch: the same mathematics as ``adaptive.online``, for a mirror or a machine with many axes.

`in_torch` needs torch (``pip install dehyst[torch]``), the rest does not. See docs/fleet.md.
"""
