"""Recordings from files: one reader per format, units and periods only as stated, problems reported as data.

``read(path, mapping)`` gives a `Recording` in the project's columns, ``check`` lists its problems, ``require_usable``
refuses what cannot be used, and ``repaired`` puts the rest on a regular time grid.
"""

from dehyst.sim.recordings.columns import ColumnMap, load_map
from dehyst.sim.recordings.findings import Finding, check, require_usable
from dehyst.sim.recordings.reader import read
from dehyst.sim.recordings.recording import Recording
from dehyst.sim.recordings.repair import Repaired, repaired

__all__ = ["ColumnMap", "Finding", "Recording", "Repaired", "check", "load_map", "read", "repaired", "require_usable"]
