"""Simulated stages, recordings, and what is found in them.

``stage`` and ``effects`` simulate, ``signals`` drive, ``scenarios`` disturb, ``recordings`` reads files, ``diagnosis``
names causes of errors, ``changes`` finds what changed in a running stage, and ``chapter`` repeats the chapter's
experiments. This package imports nothing by itself; import from the subpackages.
"""

from __future__ import annotations

__all__: list[str] = []
