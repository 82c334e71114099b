"""Many learners as one batch: the same mathematics as ``adaptive.online``, for a mirror or a machine with many axes.

Needs torch (``pip install dehyst[torch]``). See docs/fleet.md.
"""
