"""Signals for simulated stages: ``voltages`` to apply, ``references`` to follow, and ``sample_times``."""

from dehyst.sim.signals.references import DemoReference, Motion, Reference, demo_reference
from dehyst.sim.signals.voltages import (
    CHAPTER_AMPLITUDE_V,
    generalisation_input,
    growing_triangles,
    minor_loops,
    multitone,
    sample_times,
    sine,
    training_input,
    triangle,
)

__all__ = [
    "CHAPTER_AMPLITUDE_V",
    "DemoReference",
    "Motion",
    "Reference",
    "demo_reference",
    "generalisation_input",
    "growing_triangles",
    "minor_loops",
    "multitone",
    "sample_times",
    "sine",
    "training_input",
    "triangle",
]
